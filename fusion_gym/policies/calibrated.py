"""Agents calibrated with a rule at each price of a token, as one policy and one file.

``fusion-gym calibrate`` writes the file, an archive of ``calibration.json`` and the agents.
"""

from __future__ import annotations

import copy
import json
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib import MaskablePPO, RecurrentPPO
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.policies import ActorCriticPolicy

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.system import Signals, least_covering
from fusion_gym.core.task import Task
from fusion_gym.policies.archive import read_part
from fusion_gym.policies.base import Requests
from fusion_gym.policies.loading import load_model_policy
from fusion_gym.policies.model import ModelPolicy
from fusion_gym.policies.rules.priced_threshold import PricedThreshold
from fusion_gym.validation import ConfigurationError

CALIBRATION = "calibration.json"  # the part of the archive that marks a calibrated policy


@dataclass(frozen=True)
class CalibrationPoint:
    """The calibration at a price: the agent's number, the mixture μ and the threshold c."""

    price: float
    agent: int
    mixture: float
    threshold: float


def check_logits(agent: ModelPolicy) -> None:
    """Refuse an agent without one logit for each sensor."""
    model, actions = agent.model, agent.view.actions
    separate = isinstance(actions, spaces.MultiBinary) or agent.view.rows_per_run > 1
    kinds = ActorCriticPolicy, MaskableActorCriticPolicy
    if not isinstance(model.policy, kinds) or isinstance(model, RecurrentPPO):
        allowed = "an agent with one logit for each sensor (ppo, a2c, trpo, maskable_ppo)"
        raise validation.refusal("policy", type(model).__name__, allowed)
    if not separate and agent.task.access != "single":
        raise validation.refusal("action", str(actions), "MultiBinary, or access='single'")


def request_logits(agent: ModelPolicy, signals: Signals) -> Array:
    """Return the logit (sensors, N) of each sensor's request over its silence."""
    policy: Any = agent.model.policy
    rows = torch.as_tensor(agent.rows(signals))
    with torch.no_grad():
        latent = policy.mlp_extractor.forward_actor(policy.extract_features(rows))
        values: Array = policy.action_net(latent).numpy().astype(np.float64)
    if agent.view.rows_per_run > 1:
        values = (values[:, 1] - values[:, 0]).reshape(-1, agent.view.rows_per_run)
    elif isinstance(agent.view.actions, spaces.Discrete):
        values = values[:, 1:] - values[:, :1]
    elif isinstance(agent.model, MaskablePPO):
        values = values[:, 1::2] - values[:, ::2]
    if isinstance(agent.model, MaskablePPO):
        values = np.where(signals["grantable"].T, values, -np.inf)
    return np.ascontiguousarray(values.T)


class CalibratedPolicy:
    r"""Request where a mixture of an agent's logit and a rule's log ratio reaches a threshold.

    Args:
        task: the task.
        agents: agents with one logit for each sensor.
        slopes: slope b > 0 of each agent's logit on z.
        rule: the rule, whose log ratio is z.
        points: calibrations in the order of their prices; between two prices μ and c are linear in
            the logarithm of the price, and the nearest price has the agent.
        price: price of a token; None for the price in the reward.

    Raises:
        ConfigurationError: an agent without one logit for each sensor, or agents and a rule with
            beliefs of different owners.

    Equation:
        $$
        \delta_i(t)=1\iff(1-\mu)\,\frac{\text{logit}_i}{b}+\mu\,z_i\ge c
        $$

        μ = 1 and c = 0 is the rule, μ = 0 and c = 0 the agent's likeliest action.
    """

    deterministic, stateless = True, True

    def __init__(
        self,
        task: Task,
        agents: Sequence[ModelPolicy],
        slopes: Sequence[float],
        rule: PricedThreshold,
        points: Sequence[CalibrationPoint],
        price: float | None = None,
    ) -> None:
        for agent in agents:
            check_logits(agent)
        owners = {item.memory_owner or "scheduler" for item in agents}
        if rule.memory_owner is not None:
            owners.add(rule.memory_owner)
        if len(owners) != 1:
            raise ConfigurationError(
                f"rule = {rule!r} is not allowed with these agents: all must use the beliefs of "
                f"one owner, not of {sorted(owners)}"
            )
        self.task, self.agents, self.slopes, self.rule = task, tuple(agents), tuple(slopes), rule
        self.points, self.price, self.view = tuple(points), price, agents[0].view
        self.memory_owner = agents[0].memory_owner or rule.memory_owner
        classes = [agent.knowledge for agent in agents]
        self.knowledge = least_covering([*classes, rule.knowledge])

    def reset(self, runs: int, seed: int = 0) -> None:
        """Do nothing; the policy has no memory."""

    def single_agent(self) -> ModelPolicy:
        """Return the agent at the policy's price, with the threshold in its last layer.

        Raises:
            ConfigurationError: no price, or a price at which the rule takes part.
        """
        if self.price is None:
            raise validation.refusal("price", None, "a number: model:PATH,price=…")
        (number,), (mixture,), (threshold,) = self.at(np.array([self.price]))
        if mixture > 0.0:
            why = f"0 at the price {self.price:g}: the rule reads signals that a file does not have"
            raise validation.refusal("mixture", float(mixture), why)
        agent = copy.deepcopy(self.agents[number])
        bias: Any = agent.model.policy.action_net.bias
        places = slice(None)
        if isinstance(agent.view.actions, spaces.Discrete):
            places = slice(1, None)
        elif isinstance(agent.model, MaskablePPO):
            places = slice(1, None, 2)
        with torch.no_grad():
            bias[places] -= float(threshold) * self.slopes[number]
        return agent

    def at(self, price: Array) -> tuple[NDArray[np.int64], Array, Array]:
        """Return agent, μ and c (N,) at prices (N,)."""
        logs = np.log([point.price for point in self.points])
        place = np.log(price)
        mixture, threshold = (
            np.interp(place, logs, [getattr(point, name) for point in self.points])
            for name in ("mixture", "threshold")
        )
        nearest = np.abs(place - logs[:, None]).argmin(0)
        return np.array([point.agent for point in self.points])[nearest], mixture, threshold

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        tokens = signals["tokens"]
        price = signals["price"] if self.price is None else np.full(tokens.shape, self.price)
        agent, mixture, threshold = self.at(np.asarray(price))
        score = np.zeros((self.task.sensors, len(tokens)))
        if (mixture > 0.0).any():
            score += _share(mixture, self.rule.log_ratio(signals))
        if (mixture < 1.0).any():
            logits = np.stack([request_logits(item, signals) for item in self.agents])
            logits /= np.array(self.slopes)[:, None, None]
            own = np.take_along_axis(logits, agent[None, None], 0)[0]
            score += _share(1.0 - mixture, own)
        requests: Requests = score >= threshold
        if self.task.access == "single":  # an agent names one sensor, the rule leaves the choice
            best = score.argmax(0) == np.arange(len(score))[:, None]
            requests &= best | (mixture == 1.0)
        return requests


def _share(share: Array, score: Array) -> Array:
    """Return share · score, and 0 for a share of 0, where a score may be infinite."""
    result = np.zeros(score.shape)
    some = np.broadcast_to(share > 0.0, score.shape)
    return np.multiply(share, score, out=result, where=some)


def save_calibrated(
    policy: CalibratedPolicy, rule: str, models: Sequence[bytes], path: Path
) -> None:
    """Write a policy with the text of its rule and its agents' archives."""
    content = {"rule": rule, "slopes": policy.slopes, "points": list(map(asdict, policy.points))}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(CALIBRATION, json.dumps(content, indent=1))
        for number, model in enumerate(models):
            archive.writestr(f"agent_{number}.zip", model)


def holds_calibration(path: Path) -> bool:
    """Return whether a file is a calibrated policy."""
    try:
        with zipfile.ZipFile(path) as archive:
            return CALIBRATION in archive.namelist()
    except (zipfile.BadZipFile, OSError, ValueError):
        return False


def load_calibrated(path: Path, task: Task, price: float | None, trust: bool) -> CalibratedPolicy:
    """Return the calibrated policy of a file, whose agents are read as :mod:`loading` reads them.

    Raises:
        ConfigurationError: a part is missing, or a value is not allowed.
    """
    from fusion_gym.policies.registry import make_policy

    try:
        content = json.loads(read_part(path, CALIBRATION))
        points = [CalibrationPoint(**point) for point in content["points"]]
        slopes, text = [float(slope) for slope in content["slopes"]], str(content["rule"])
        numbers = np.array([list(asdict(point).values()) for point in points], dtype=np.float64)
        sound = np.isfinite(numbers).all() and (np.diff(numbers[:, 0]) > 0.0).all()
        known = set(numbers[:, 1]) <= set(range(len(slopes)))
        if not (sound and known and 0.0 < min(slopes) <= max(slopes) < np.inf):
            raise ValueError("its numbers are not allowed")
        if text.partition(":")[0] != "priced_threshold":  # another name may run code
            raise ValueError(f"its rule {text!r} is no priced_threshold")
    except (LookupError, TypeError, ValueError) as error:
        raise ConfigurationError(f"its calibration cannot be read: {error}") from None
    agents = []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(len(slopes)):
            file = Path(folder) / f"agent_{number}.zip"
            file.write_bytes(read_part(path, file.name))
            agents.append(load_model_policy(str(file), task, True, price, trust=trust))
    rule: Any = make_policy(text if price is None else f"{text},price={price!r}", task)
    return CalibratedPolicy(task, agents, slopes, rule, points, price)
