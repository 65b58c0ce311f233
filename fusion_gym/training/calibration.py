"""Calibrate agents with a rule at each price of a token, by tuning episodes.

At each price a mixture μ of agent and rule and a threshold c are chosen at the cost of the
benchmark, error + price · tokens, on episodes that neither training nor validation nor tests use.
The rule stays unless another candidate is cheaper by two standard errors.
"""

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fusion_gym import seeds
from fusion_gym.arrays import Array
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import run_priced, seeded
from fusion_gym.evaluation.rule_search import class_of, search_of_class
from fusion_gym.output.files import replacing
from fusion_gym.output.progress import progress_bar
from fusion_gym.policies.base import decide
from fusion_gym.policies.saved import (
    CalibratedPolicy,
    CalibrationPoint,
    Mixing,
    calibration_rule,
    load_model_policy,
    save_calibrated,
)

MIXTURES = 0.0, 0.5, 1.0
THRESHOLDS = -2.4, -0.8, -0.3, -0.1, 0.1, 0.3, 0.8
BEST = 4  # candidates of the last round
ERRORS = 2.0  # standard errors by which another candidate must be cheaper than the rule
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
    """A calibrated policy with a candidate for each run."""

    candidates: Mixing

    def at(self, price: Array) -> Mixing:
        """Return the candidate of each run."""
        return self.candidates


def calibrate(
    task: Task,
    files: Sequence[Path],
    prices: Sequence[float],
    episodes: tuple[int, int],
    output: Path,
    rule: str | None = None,
) -> list[CalibrationRow]:
    """Calibrate the agents of files, write the policy and return a row for each price.

    Args:
        task: the task.
        files: the agents.
        prices: prices of a token in increasing order; the task's price for agents of one price.
        episodes: tuning episodes of all candidates, and of the last round.
        output: the file to write.
        rule: text of a priced_threshold; by default the first agent's, or the start of a search of
            the agents' class.

    Raises:
        ConfigurationError: an agent without one logit for each sensor, or a rule of another kind.
    """
    agents = [load_model_policy(str(file), task) for file in files]
    for agent in agents:
        agent.check_logits()
    (first, last), rows = episodes, []
    rule = agents[0].rule_text if rule is None else rule
    if rule is None:
        name, count = class_of(task, agents[0].view.rows_per_run > 1), (first, max(1, last // 4))
        search = search_of_class(name, task, prices, episodes=count)
        rule = search.policy(search.first_point())
    trial = _Trial(task, agents, (), calibration_rule(rule, task), ())
    trial.slopes = fit_slopes(trial, prices, first)
    own = [(number, 0.0, 0.0) for number in range(len(agents))]
    grid = product(range(len(agents)), MIXTURES, THRESHOLDS)
    candidates = [_RULE, *own, *(item for item in grid if item[0] == 0 or item[1] < 1.0)]
    with progress_bar(len(prices), "calibrating", unit="prices") as bar:
        for price in prices:
            costs = _costs(trial, candidates, price, first, seeds.CALIBRATION.start).mean(1)
            order = [candidates[place] for place in np.argsort(costs, kind="stable")]
            finalists = list(dict.fromkeys([_RULE, *own, *order[: BEST + 1 + len(own)]]))
            results = _costs(trial, finalists, price, last, seeds.CALIBRATION[first])
            rows.append(_choice(price, finalists, results, len(own)))
            bar.update()
    with replacing(output) as partial:
        save_calibrated(rule, trial.slopes, [row.point for row in rows], files, partial)
    return rows


def fit_slopes(policy: CalibratedPolicy, prices: Sequence[float], episodes: int) -> list[float]:
    """Return each agent's slope of its logit on z; without one, the ratio of deviations."""
    start, samples = seeds.CALIBRATION.start, []
    each = start + np.tile(np.arange(episodes), len(prices))
    batch = seeded(policy.task, policy.memory_owner, each)
    batch.price = np.repeat(np.array(prices, dtype=np.float64), episodes)
    for requests in decide(policy.rule, batch, start):
        signals = batch.signals()
        logits = (agent.logits(signals) for agent in policy.agents)
        samples.append(np.stack([policy.rule.log_ratio(signals), *logits]))
        batch.step(requests)
    z, *every = np.stack(samples, axis=1).reshape(1 + len(policy.agents), -1)
    slopes = []
    for logit in every:
        some = np.isfinite(z) & np.isfinite(logit)
        (variance, cross), (_, own) = np.cov(z[some], logit[some])
        slope = cross if cross > _LEAST * variance else np.sqrt(own * variance)
        slopes.append(max(float(slope / max(variance, _LEAST)), _LEAST))
    return slopes


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
        group = np.repeat(np.array(candidates[first : first + size]), episodes, axis=0)
        trial.candidates = group[:, 0].astype(np.int64), group[:, 1], group[:, 2]
        each, prices = seed + np.arange(len(group)) % episodes, np.full(len(group), price)
        parts.append(run_priced(trial.task, trial, each, prices).cost(price))
    costs = np.nan_to_num(np.concatenate(parts), nan=_WORST, posinf=_WORST)
    return costs.reshape(len(candidates), episodes)
