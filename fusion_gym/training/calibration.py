"""Calibrate agents with a rule at each price of a token, by tuning episodes.

At each price a mixture μ of agent and rule and a threshold c are chosen at the cost of the
benchmark, error + price · tokens, on episodes that neither training nor validation nor tests use.
The rule stays unless another candidate is cheaper by two standard errors.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.core.system import KNOWLEDGE, Knowledge, Signals
from fusion_gym.core.task import Task
from fusion_gym.evaluation.policy_batch import run_priced
from fusion_gym.evaluation.rule_search import ClassName, search_of_class
from fusion_gym.output.files import replacing
from fusion_gym.policies.base import Requests
from fusion_gym.policies.calibrated import (
    CalibratedPolicy,
    CalibrationPoint,
    check_logits,
    request_logits,
    save_calibrated,
)
from fusion_gym.policies.loading import load_model_policy
from fusion_gym.policies.model import ModelPolicy
from fusion_gym.policies.registry import make_policy
from fusion_gym.policies.rules.priced_threshold import PricedThreshold
from fusion_gym.validation import refusal

MIXTURES = 0.0, 0.5, 1.0
THRESHOLDS = -2.4, -0.8, -0.3, -0.1, 0.1, 0.3, 0.8
EPISODES = 16, 400  # of all candidates, and of the best, the rule and the agents
BEST = 4  # candidates of the last round
ERRORS = 2.0  # standard errors by which another candidate must be cheaper than the rule
SEED = 800_000_000  # of the first tuning episode
_LANES = 4096  # runs in one batch
_LEAST = 1e-6  # slope
_WORST = 1e30  # the cost of an error that is no number
_RULE = (0, 1.0, 0.0)

Candidate = tuple[int, float, float]  # agent, μ, c


class CalibrationRow(NamedTuple):
    """A price: the chosen point, and costs on the tuning episodes of it, rule and best agent."""

    point: CalibrationPoint
    cost: float
    rule_cost: float
    agent_cost: float


class _Trial(CalibratedPolicy):
    """A calibrated policy with a candidate for each run; it collects logits and log ratios."""

    knowledge: Knowledge = KNOWLEDGE[-1]

    def place(self, candidates: Sequence[Candidate]) -> None:
        """Set the candidate of each run."""
        agent, *numbers = np.array(candidates).T
        self._candidates = agent.astype(np.int64), *numbers

    def at(self, price: Array) -> tuple[NDArray[np.int64], Array, Array]:
        """Return the candidate of each run."""
        agent, mixture, threshold = self._candidates
        return agent, mixture, threshold


class _Recorder:
    """The rule as a policy, which records its log ratios and the agents' logits."""

    knowledge: Knowledge = KNOWLEDGE[-1]

    def __init__(self, rule: PricedThreshold, agents: Sequence[ModelPolicy]) -> None:
        self.rule, self.agents, self.samples = rule, agents, list[Array]()
        self.memory_owner = agents[0].memory_owner or rule.memory_owner

    def reset(self, runs: int, seed: int = 0) -> None:
        """Do nothing; the rule has no memory."""

    def __call__(self, signals: Signals) -> Requests:
        """Return the rule's requests."""
        ratio = self.rule.log_ratio(signals)
        logits = (request_logits(agent, signals) for agent in self.agents)
        self.samples.append(np.stack([ratio, *logits]).reshape(1 + len(self.agents), -1))
        requests: Requests = ratio >= 0.0
        return requests

    def slopes(self) -> list[float]:
        """Return each agent's slope of its logit on z; without one, the ratio of deviations."""
        z, *every = np.concatenate(self.samples, axis=1)
        result = []
        for logit in every:
            some = np.isfinite(z) & np.isfinite(logit)
            (variance, cross), (_, own) = np.cov(z[some], logit[some])
            slope = cross if cross > _LEAST * variance else np.sqrt(own * variance)
            result.append(max(float(slope / max(variance, _LEAST)), _LEAST))
        return result


def start_rule(
    task: Task, local: bool, prices: Sequence[float], episodes: tuple[int, int] = EPISODES
) -> str:
    """Return the rule with which a search of the agents' class begins, as text."""
    name: ClassName = "centre" if task.information == "centre" else "scheduler"
    count = episodes[0], max(1, episodes[1] // 4)
    search = search_of_class("local" if local else name, task, prices, episodes=count)
    return search.rule(search.first_point())


def calibrate_files(
    task: Task,
    files: Sequence[Path],
    prices: Sequence[float],
    episodes: tuple[int, int],
    output: Path,
    rule: str | None = None,
    progress: Callable[[int], Any] | None = None,
) -> list[CalibrationRow]:
    """Calibrate the agents of files, write the policy and return a row for each price.

    Args:
        task: the task, whose price is drawn.
        files: the agents.
        prices: prices of a token in increasing order.
        episodes: tuning episodes of all candidates, and of the last round.
        output: the file to write.
        rule: text of a priced_threshold; by default the start of a search.
        progress: function that receives 1 after each price.

    Raises:
        ConfigurationError: an agent without one logit for each sensor, or a rule of another kind.
    """
    agents = [load_model_policy(str(file), task) for file in files]
    for agent in agents:
        check_logits(agent)
    text = rule or start_rule(task, agents[0].view.rows_per_run > 1, prices, episodes)
    if not text.startswith("priced_threshold"):
        raise refusal("rule", text, "a priced_threshold")
    threshold_rule: Any = make_policy(text, task)
    policy, rows = calibrate(task, agents, threshold_rule, prices, episodes, progress=progress)
    with replacing(output) as partial:
        save_calibrated(policy, text, [file.read_bytes() for file in files], partial)
    return rows


def calibrate(
    task: Task,
    agents: Sequence[ModelPolicy],
    rule: PricedThreshold,
    prices: Sequence[float],
    episodes: tuple[int, int] = EPISODES,
    seed: int = SEED,
    progress: Callable[[int], Any] | None = None,
) -> tuple[CalibratedPolicy, list[CalibrationRow]]:
    """Return the calibrated policy, and a row for each price.

    Args:
        task: the task, whose price is drawn.
        agents: agents that observe the price, with one logit for each sensor.
        rule: the rule.
        prices: prices of a token in increasing order.
        episodes: tuning episodes of all candidates, and of the last round.
        seed: seed of the first tuning episode.
        progress: function that receives 1 after each price.
    """
    recorder = _Recorder(rule, agents)
    first, last = episodes
    run_priced(
        task, recorder, seed + np.tile(np.arange(first), len(prices)), np.repeat(prices, first)
    )
    trial = _Trial(task, agents, recorder.slopes(), rule, ())
    own = [(number, 0.0, 0.0) for number in range(len(agents))]
    grid: list[Candidate] = [
        (number, mixture, threshold)
        for number in range(len(agents))
        for mixture in MIXTURES[: None if number == 0 else -1]
        for threshold in THRESHOLDS
    ]
    rows = []
    for price in prices:
        candidates = [_RULE, *own, *grid]
        costs = _costs(trial, candidates, price, first, seed).mean(1)
        order = [candidates[place] for place in np.argsort(costs, kind="stable")]
        finalists = list(dict.fromkeys([_RULE, *own, *order[: BEST + 1 + len(own)]]))
        results = _costs(trial, finalists, price, last, seed + first)
        rows.append(_choice(price, finalists, results, len(own)))
        if progress is not None:
            progress(1)
    points = [row.point for row in rows]
    return CalibratedPolicy(task, agents, trial.slopes, rule, points), rows


def _choice(
    price: float, finalists: Sequence[Candidate], costs: Array, agents: int
) -> CalibrationRow:
    """Return the cheapest candidate if it is cheaper than the rule, the first, beyond doubt."""
    means = costs.mean(1)
    best = int(means.argmin())
    difference = costs[best] - costs[0]
    error = difference.std(ddof=1) / np.sqrt(len(difference))
    chosen = best if difference.mean() + ERRORS * error < 0.0 else 0
    point = CalibrationPoint(float(price), *finalists[chosen])
    return CalibrationRow(point, means[chosen], means[0], means[1 : 1 + agents].min())


def _costs(
    trial: _Trial, candidates: Sequence[Candidate], price: float, episodes: int, seed: int
) -> Array:
    """Return the costs (candidates, episodes) at a price, on the same episodes."""
    size, parts = max(1, _LANES // episodes), []
    for first in range(0, len(candidates), size):
        group = candidates[first : first + size]
        trial.place([item for item in group for _ in range(episodes)])
        seeds = seed + np.tile(np.arange(episodes), len(group))
        prices = np.full(len(seeds), price)
        parts.append(run_priced(trial.task, trial, seeds, prices).cost(prices))
    costs = np.nan_to_num(np.concatenate(parts), nan=_WORST, posinf=_WORST)
    return costs.reshape(len(candidates), episodes)
