"""Saved agents as policies, by their file or by their name in the model zoo; a model file is data.

The policy is rebuilt from its weights and the readable entries of Stable-Baselines3. Nothing in the
file is unpickled. With ``trust`` the loader of Stable-Baselines3 loads the file and runs code that
it contains.

``fusion-gym calibrate`` writes a file of agents that are calibrated with a rule at each price of a
token, an archive of ``calibration.json`` and the agents.
"""

import json
import pickle
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from fusion_gym import zoo
from fusion_gym.arrays import Array
from fusion_gym.core.action import ACTIONS, space_text
from fusion_gym.core.knowledge import Signals, least_covering
from fusion_gym.core.task import Task
from fusion_gym.envs.views import View, make_view
from fusion_gym.policies.archive import (
    ALGORITHMS,
    POLICIES,
    Blueprint,
    ModelView,
    NeedsTrust,
    algorithm_of,
    read_part,
    read_plain,
    read_weights,
)
from fusion_gym.policies.base import Policy, Requests, Stateless
from fusion_gym.policies.belief_rules import PricedThreshold
from fusion_gym.policies.model import ModelPolicy
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import (
    ConfigurationError,
    boolean,
    entries,
    integer,
    keys,
    number,
    refusal,
)


def load_model_policy(
    path: str,
    task: Task,
    deterministic: bool = True,
    price: float | None = None,
    normalize: str | None = None,
    *,
    trust: bool = False,
) -> ModelPolicy:
    """Return the agent saved at ``path``, checked against the task.

    Args:
        path: the file, with or without ``.zip``.
        task: the task.
        deterministic: take the likeliest action instead of a draw.
        price: price of a token, for an agent that was trained for a range of prices.
        normalize: file of ``VecNormalize.save``, for an agent that was trained under VecNormalize;
            a pickle, which needs ``trust``.
        trust: use the loader of Stable-Baselines3, which runs code of the file.

    Raises:
        ConfigurationError: no such file, no Stable-Baselines3 model, a model that its weights
            cannot rebuild (without ``trust``), or another observation layout or action space.
    """
    boolean("deterministic", deterministic)
    file = model_file(path)
    try:
        data = read_plain(file)
        observed = ModelView.read(data)
        # On-policy algorithms keep an observation before normalization under VecNormalize alone.
        normalized = "gae_lambda" in data and data.get("_last_original_obs") is not None
        if normalize is None and normalized:
            raise refusal("normalize", None, "the file of its VecNormalize statistics")
        load = _unpickled if trust else _rebuilt
        model, action = load(file, data, observed.on(task), observed)
    except NeedsTrust as error:
        raise ConfigurationError(
            f"model {path!r} is more than a card and weights: {error}; --trust, or "
            "make_policy(…, trust=True), loads it with Stable-Baselines3, which runs any code in it"
        ) from None
    except ConfigurationError as error:
        raise ConfigurationError(f"model {path!r} is not allowed: {error}") from None
    task = task.with_options(action=action)
    policy = ModelPolicy(model, task, deterministic, price, observed)
    if normalize is not None:
        policy.normalization = _statistics(normalize, policy.view, trust)
    return policy


def _statistics(path: str, view: View, trust: bool) -> VecNormalize | None:
    """Return the statistics of VecNormalize, by code of the file; ``None`` of rewards alone."""
    if not trust:
        raise refusal("normalize", path, "given with --trust: it is a pickle")
    try:
        statistics = pickle.loads(Path(path).read_bytes())
    except Exception as error:  # a pickle raises errors of any class
        raise refusal("normalize", path, f"a readable file ({error})") from None
    content = vars(statistics) if isinstance(statistics, VecNormalize) else {}
    if content.get("norm_obs") is False:
        return None
    moments = [np.asarray(getattr(content.get("obs_rms"), name, "")) for name in ("mean", "var")]
    if any(m.shape != view.space.shape or not np.isfinite(m).all() for m in moments):
        raise refusal("normalize", path, f"statistics of shape {view.space.shape}")
    return statistics


def model_file(path: str) -> Path:
    """Return the file of an agent, with or without ``.zip`` in its path."""
    file = next((p for p in (Path(path), Path(f"{path}.zip")) if p.is_file()), None)
    if file is None:
        raise ConfigurationError(f"model {path!r} is not allowed: there is no such file")
    return file


def _rebuilt(
    file: Path, data: Mapping[str, Any], task: Task, observed: ModelView
) -> tuple[BaseAlgorithm, str]:
    """Return the model from its readable entries and its weights, and its kind of action."""
    blueprint, weights = Blueprint.read(data), read_weights(file)
    action, view = _fitted(task, observed, blueprint.shape, blueprint.actions)
    # Without environment, buffers and optimiser, so it cannot learn.
    kind: Any = ALGORITHMS[blueprint.algorithm]
    base = POLICIES[blueprint.algorithm]
    model = kind(base, env=None, device="cpu", _init_setup_model=False)
    model.observation_space, model.action_space = view.space, view.action.space
    # On the meta device the declared networks take no memory before the weights fit them.
    meta = torch.device("meta")
    try:
        with meta:
            model.policy = type("Declared", (base,), {"device": meta})(
                view.space,
                view.action.space,
                lr_schedule=lambda _: 0.0,
                optimizer_class=lambda *_, **__: None,
                **blueprint.arguments,
            )
        model.policy.load_state_dict(weights, strict=True, assign=True)
    except Exception:  # a crafted file may declare anything
        raise NeedsTrust(f"its weights do not fit {blueprint.algorithm}") from None
    model.policy.__class__ = base
    if blueprint.algorithm == "dqn":  # its random decisions need the exploration rate
        rate = data.get("exploration_rate", 0.0)
        rate = number("exploration_rate", rate, at_least=0.0, at_most=1.0)
        model.exploration_rate = rate
    return model, action


def _unpickled(
    file: Path, data: Mapping[str, Any], task: Task, observed: ModelView
) -> tuple[BaseAlgorithm, str]:
    """Return the model from the loader of Stable-Baselines3, which runs code of the file."""
    problems, known = [], algorithm_of(data)
    likely = ["dqn"] if "exploration_schedule" in data else ["ppo", "a2c"]  # of an own policy
    for name in [known] if known in ALGORITHMS else likely:
        try:
            model = ALGORITHMS[name].load(file, device="cpu")
        except Exception as error:  # the file's code may raise any error
            problems.append(f"{name}: {error}")
            continue
        shape = model.observation_space.shape or ()
        return model, _fitted(task, observed, shape, space_text(model.action_space))[0]
    raise ConfigurationError(f"it cannot be loaded as {'; '.join(problems)}")


def _fitted(
    task: Task, observed: ModelView, shape: tuple[int, ...], actions: str
) -> tuple[str, View]:
    """Return the model's kind of action, and the view of the task with it."""
    view, names = make_view(task, observed.local), observed.observation_names
    trained = "it was trained for another observation layout: it expects"
    if names is not None and names != tuple(view.names):
        missing = [name for name in names if name not in view.names]
        extra = [name for name in view.names if name not in names]
        raise ConfigurationError(
            f"{trained} {len(names)} entries, the task (information={task.options.information!r}) "
            f"has {len(view.names)}; missing are {missing[:4] or 'none'}, unknown to the model "
            f"{extra[:4] or 'none'}" + ("" if missing or extra else " (the order differs)")
        )
    if shape != view.space.shape:
        raise ConfigurationError(
            f"{trained} shape {shape}, the task (information={task.options.information!r}) has "
            f"{view.space.shape}"
        )
    allowed: dict[str, tuple[str, View]] = {
        space_text(view.action.space): (task.options.action, view)
    }
    if not observed.local and task.options.access != "single":
        for kind in ACTIONS:
            with suppress(ConfigurationError):  # the kind "discrete" of many sensors
                other = make_view(task.with_options(action=kind))
                allowed[space_text(other.action.space)] = (kind, other)
    if actions not in allowed:
        raise ConfigurationError(
            f"it has the action space {actions!r}: the task has {task.sensors} sensors, so it must "
            f"be {' or '.join(allowed)}"
        )
    return allowed[actions]


CALIBRATION = "calibration.json"  # the part of the archive that marks a calibrated policy

Mixing = tuple[NDArray[np.int64], Array, Array]  # agent, μ and c of each run (N,)


class CalibrationPoint(NamedTuple):
    """The calibration at a price: the agent's number, the mixture μ and the threshold c."""

    price: float
    agent: int
    mixture: float
    threshold: float


def calibration_rule(text: str, task: Task) -> PricedThreshold:
    """Return the rule of a text, which may name no other policy, because that may run code."""
    if text.partition(":")[0] != "priced_threshold":
        raise refusal("rule", text, "a priced_threshold")
    rule: Any = make_policy(text, task)
    return rule


@dataclass(eq=False)
class CalibratedPolicy(Stateless):
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

    task: Task
    agents: Sequence[ModelPolicy]
    slopes: Sequence[float]
    rule: PricedThreshold
    points: Sequence[CalibrationPoint]
    price: float | None = None

    def __post_init__(self) -> None:
        for agent in self.agents:
            agent.check_logits()
        owners = {*(agent.memory_owner for agent in self.agents), self.rule.memory_owner} - {None}
        if any(agent.view.rows_per_run == 1 for agent in self.agents):
            owners.add("scheduler")
        if len(owners) > 1:
            raise ConfigurationError(
                f"rule = {self.rule!r} is not allowed with these agents: all must use the beliefs "
                f"of one owner, not of {sorted(map(str, owners))}"
            )
        self.memory_owner = self.agents[0].memory_owner or self.rule.memory_owner
        classes = [agent.knowledge for agent in self.agents]
        self.knowledge = least_covering([*classes, self.rule.knowledge])

    def single_agent(self) -> ModelPolicy:
        """Return the agent at the policy's price, with the threshold in its last layer.

        Raises:
            ConfigurationError: no price, or a price at which the rule takes part.
        """
        if self.price is None:
            raise refusal("price", None, "a number: model:PATH,price=…")
        (number,), (mixture,), (threshold,) = self.at(np.array([self.price]))
        if mixture > 0.0:
            why = (
                f"0 at the price {self.price:g}: the rule reads signals that a file does not have; "
                "calibrated=false gives the agent alone"
            )
            raise refusal("mixture", float(mixture), why)
        return self.agents[number].with_threshold(float(threshold) * self.slopes[number])

    def nearest_agent(self) -> ModelPolicy:
        """Return the agent of the price that is nearest to the policy's, without calibration.

        Raises:
            ConfigurationError: no price, and more than one agent.
        """
        if self.price is None and len(self.agents) > 1:
            raise refusal("price", None, "a number: the file has several agents")
        return self.agents[self.at(np.array([self.price or 1.0]))[0][0]]

    def at(self, price: Array) -> Mixing:
        """Return agent, μ and c (N,) at prices (N,)."""
        prices, agents, mixtures, thresholds = np.array(self.points).T
        place, places = np.log(np.clip(price, prices[0], prices[-1])), np.log(prices)
        nearest = np.abs(place - places[:, None]).argmin(0)
        mixture, threshold = (np.interp(place, places, part) for part in (mixtures, thresholds))
        return agents.astype(np.int64)[nearest], mixture, threshold

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        price = signals["price"]
        price = price if self.price is None else np.full(price.shape, self.price)
        agent, mixture, threshold = self.at(np.asarray(price))
        score = np.zeros((self.task.sensors, len(price)))
        if (mixture > 0.0).any():  # a share of 0 takes no part, where a score may be infinite
            score += mixture * np.where(mixture > 0.0, self.rule.log_ratio(signals), 0.0)
        if (mixture < 1.0).any():
            logits = np.stack([item.logits(signals) for item in self.agents])
            logits /= np.array(self.slopes)[:, None, None]
            own = np.take_along_axis(logits, agent[None, None], 0)[0]
            score += (1.0 - mixture) * np.where(mixture < 1.0, own, 0.0)
        requests = self.task.action.choose(score, threshold)  # the rule names any sensors
        return requests | ((score >= threshold) & (mixture == 1.0))


def save_calibrated(
    rule: str,
    slopes: Sequence[float],
    points: Sequence[CalibrationPoint],
    files: Sequence[Path],
    output: Path,
) -> None:
    """Write a calibration with the text of its rule and its agents' files, without times."""
    content = {"rule": rule, "slopes": slopes, "points": [point._asdict() for point in points]}
    parts = {f"agent_{number}.zip": file.read_bytes() for number, file in enumerate(files)}
    parts[CALIBRATION] = json.dumps(content, indent=1).encode()
    with zipfile.ZipFile(output, "w") as archive:
        for name, part in parts.items():
            archive.writestr(zipfile.ZipInfo(name), part, zipfile.ZIP_DEFLATED)


def read_calibration(file: Path) -> tuple[str, list[float], list[CalibrationPoint]]:
    """Return rule, slopes and points of a file's calibration.

    Raises:
        ConfigurationError: the file has no calibration, or a value is not allowed.
    """
    content = read_plain(file, CALIBRATION)
    keys(f"entry of {CALIBRATION}", content, ("rule", "slopes", "points"))
    rule, slopes, rows = (content.get(name) for name in ("rule", "slopes", "points"))
    if not isinstance(rule, str):
        raise refusal("rule", rule, "a text")
    slopes = [number("slopes", b, above=0.0) for b in entries("slopes", slopes, "a slope", "agent")]
    points: list[CalibrationPoint] = []
    for row in entries("points", rows, "a calibration", "price"):
        if not isinstance(row, dict) or row.keys() != {*CalibrationPoint._fields}:
            raise refusal("points", row, f"an object with {', '.join(CalibrationPoint._fields)}")
        least = points[-1].price if points else 0.0
        points.append(
            CalibrationPoint(
                number("price", row["price"], above=least),
                integer("agent", row["agent"], at_least=0, at_most=len(slopes) - 1),
                number("mixture", row["mixture"], at_least=0.0, at_most=1.0),
                number("threshold", row["threshold"]),
            )
        )
    return rule, slopes, points


def agent_files(path: Path, folder: Path) -> list[Path]:
    """Return the files of a policy's agents: its own, or the calibrated agents in a folder."""
    try:
        read_part(path, CALIBRATION)
    except ConfigurationError:
        return [path]
    _, slopes, _ = read_calibration(path)
    place = Path(tempfile.mkdtemp(dir=folder))
    files = [place / f"agent_{agent}.zip" for agent in range(len(slopes))]
    for file in files:
        file.write_bytes(read_part(path, file.name))
    return files


def load_calibrated(path: Path, task: Task, price: float | None, trust: bool) -> CalibratedPolicy:
    """Return the calibrated policy of a file, whose agents are read by :func:`load_model_policy`.

    Raises:
        ConfigurationError: a part is missing, or a value is not allowed.
    """
    text, slopes, points = read_calibration(path)
    rule = calibration_rule(text, task)
    rule.price = rule.price if price is None else price
    with tempfile.TemporaryDirectory() as folder:
        files = map(str, agent_files(path, Path(folder)))
        agents = [load_model_policy(file, task, True, price, trust=trust) for file in files]
    return CalibratedPolicy(task, agents, slopes, rule, points, price)


def saved_agent(
    task: Task,
    path: str,
    deterministic: bool = True,
    price: float | None = None,
    calibrated: bool = True,
    normalize: str | None = None,
    *,
    trust: bool = False,
) -> Policy:
    """Request by a Stable-Baselines3 agent, or by calibrated agents, from a file.

    Args:
        task: the task; a text cannot set it.
        path: the file, with or without ``.zip``.
        deterministic: take the likeliest action instead of a draw.
        price: price of a token, for an agent that was trained for a range of prices.
        calibrated: use the calibration of the file, if it has one, or the agent alone.
        normalize: file of the statistics of an agent that was trained under VecNormalize.
        trust: whether the file may run code; a text cannot set it.

    Raises:
        ConfigurationError: as :func:`load_model_policy`.
    """
    file = model_file(path)
    try:
        read_part(file, CALIBRATION)
    except ConfigurationError:
        return load_model_policy(path, task, deterministic, price, normalize, trust=trust)
    if calibrated and not deterministic:
        raise refusal("deterministic", deterministic, "true for calibrated agents")
    try:
        policy = load_calibrated(file, task, price, trust)
    except ConfigurationError as error:
        raise ConfigurationError(f"model {path!r} is not allowed: {error}") from None
    if calibrated:
        return policy
    agent = policy.nearest_agent()
    agent.deterministic = deterministic
    return agent


def zoo_agent(
    task: Task,
    name: str,
    deterministic: bool = True,
    price: float | None = None,
    calibrated: bool = True,
) -> Policy:
    """Request by an agent of the model zoo (:mod:`fusion_gym.zoo`).

    Args:
        task: the task; a text cannot set it.
        name: name of the agent.
        deterministic: take the likeliest action instead of a draw.
        price: price of a token, for an agent that was trained for a range of prices.
        calibrated: use the calibration, or the agent alone.

    Raises:
        ConfigurationError: no agent of that name, a file that differs from its card, or an agent
            that does not fit the task.
    """
    return saved_agent(task, zoo.model_path(name), deterministic, price, calibrated)
