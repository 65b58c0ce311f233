"""Agents calibrated with a rule at each price of a token, as one policy and one file.

``fusion-gym calibrate`` writes the file, an archive of ``calibration.json`` and the agents.
"""

import json
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.core.knowledge import Signals, least_covering
from fusion_gym.core.task import Task
from fusion_gym.policies.archive import read_part, read_plain
from fusion_gym.policies.base import Requests, Stateless
from fusion_gym.policies.loading import load_model_policy
from fusion_gym.policies.model import ModelPolicy
from fusion_gym.policies.registry import make_policy
from fusion_gym.policies.rules.priced_threshold import PricedThreshold
from fusion_gym.validation import ConfigurationError, entries, integer, keys, number, refusal

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
    """Return the calibrated policy of a file, whose agents are read as :mod:`loading` reads them.

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
