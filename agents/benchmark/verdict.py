"""Tests of policies, bounds of their cost, and their cost relative to the searched rule's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from scipy import stats

from agents.benchmark.jobs import Job
from agents.benchmark.settings import Case
from fusion_gym import seeds
from fusion_gym.arrays import Array
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import run_several
from fusion_gym.policies.registry import make_policy
from fusion_gym.solvers.silence import cost_bound
from fusion_gym.validation import ConfigurationError

LEVEL = 0.95
FALSE_DISCOVERIES = 0.05
RESAMPLES = 2000  # of the bootstrap


@dataclass(frozen=True)
class TestJob(Job):
    """A policy at each price, on the test episodes or others from ``seed``.

    ``content`` is the text of all policies, or the hash of an agent's file. An agent runs in the
    class's environment for agents, whose price range is ``class_prices``; a rule runs in the
    environment for rules.
    """

    __test__: ClassVar[bool] = False
    policies: tuple[str, ...] = field(metadata={"key": False})
    prices: tuple[float, ...]
    class_prices: tuple[float, ...]
    episodes: int
    content: str
    agent: bool = False
    case: Case | None = None
    seed: int = seeds.TEST.start
    weight: ClassVar[float] = 8.0

    def task(self) -> Task:
        """Return the task of the test."""
        if not self.agent:
            return self.setting.task(self.name, self.case)
        span = min(self.class_prices), max(self.class_prices)
        options = self.setting.agent_environment(self.name, span, self.case)
        return make_task(self.setting.environment, **options)


@dataclass(frozen=True)
class TestResult:
    """A policy at a price: error and tokens per step of each episode, MSE and rate."""

    policy: str
    price: float
    error: Array
    tokens: Array
    mse: float
    rate: float

    @property
    def cost(self) -> Array:
        """Return error + price · tokens of each episode."""
        return self.error + self.price * self.tokens


def run_test(job: TestJob) -> tuple[TestResult, ...]:
    """Return the result of each policy at its price."""
    task, result = job.task(), []
    policies = [make_policy(text, task) for text in job.policies]
    every = run_several(task, policies, job.episodes, job.seed)
    for text, price, results in zip(job.policies, job.prices, every, strict=True):
        rate, mse = float(results.rate.mean()), float(results.mse.mean())
        result.append(TestResult(text, price, results.error_cost, results.tokens, mse, rate))
    return tuple(result)


@dataclass(frozen=True)
class Difference:
    """A mean difference in cost over a reference's cost, its interval, and its p-value."""

    mean: float
    low: float
    high: float
    p: float


def cost_difference(costs: Sequence[Array], reference: Array) -> Difference:
    """Return the relative difference of costs (E,) of one or more seeds to a reference's (E,)."""
    return _difference([(np.array(costs) - reference) / reference.mean()])


def mean_difference(
    pairs: Sequence[tuple[Sequence[Sequence[TestResult]], Sequence[TestResult]]],
) -> Difference:
    """Return the mean relative difference over classes and their prices.

    Each pair has the results of one or more seeds in a class, and its reference's results.
    """
    blocks = []
    for trained, reference in pairs:
        base = np.array([r.cost for r in reference])
        costs = np.array([[o.cost for o in outcomes] for outcomes in trained])
        blocks.append(((costs - base) / base.mean(1, keepdims=True)).mean(1))
    return _difference(blocks)


def _difference(blocks: Sequence[Array]) -> Difference:
    """Return the mean of blocks (seeds, E) of differences, and its interval.

    Seeds and episodes are crossed random factors: the variance of the mean is the variance of the
    episodes' means over their number plus each block's variance of seeds over their number, with
    Satterthwaite's degrees of freedom.
    """
    episodes = np.mean([block.mean(0) for block in blocks], axis=0)
    parts = [(float(episodes.var(ddof=1)) / len(episodes), len(episodes) - 1)]
    for block in blocks:
        if len(block) > 1:
            spread = float(block.mean(1).var(ddof=1)) / len(block)
            parts.append((spread / len(blocks) ** 2, len(block) - 1))
    variance, mean = sum(part for part, _ in parts), float(episodes.mean())
    if variance == 0.0:
        return Difference(mean, mean, mean, float(mean == 0.0))
    degrees = variance**2 / sum(part**2 / freedom for part, freedom in parts)
    reach = float(stats.t.ppf(0.5 + LEVEL / 2.0, degrees)) * variance**0.5
    p = 2.0 * float(stats.t.sf(abs(mean) / variance**0.5, degrees))
    return Difference(mean, mean - reach, mean + reach, p)


def saving(
    trained: Sequence[Sequence[TestResult]], trigger: Sequence[TestResult]
) -> tuple[float, float, float]:
    """Return the share of a trigger's cost that policies save, a mean over prices, with ends.

    The interval is a bootstrap over seeds, and over the episodes of both policies together.
    """
    costs = np.array([[result.cost for result in outcomes] for outcomes in trained])
    base = np.array([result.cost for result in trigger])
    rng, (seeds, _, episodes) = np.random.default_rng(0), costs.shape
    rows, columns = (
        rng.multinomial(size, np.full(size, 1.0 / size), RESAMPLES) / size
        for size in (seeds, episodes)
    )
    drawn = np.einsum("ds,spe,de->dp", rows, costs, columns, optimize=True) / (columns @ base.T)
    low, high = np.quantile(1.0 - drawn.mean(1), [0.5 - LEVEL / 2.0, 0.5 + LEVEL / 2.0]).tolist()
    return 1.0 - float((costs.mean((0, 2)) / base.mean(1)).mean()), low, high


def discoveries(p_values: Sequence[float]) -> list[bool]:
    """Return which differences count after Benjamini and Hochberg's procedure."""
    if not p_values:
        return []
    adjusted = stats.false_discovery_control(np.clip(p_values, 0.0, 1.0))
    return [bool(value <= FALSE_DISCOVERIES) for value in adjusted]


@dataclass(frozen=True)
class BoundJob(Job):
    """The proven lower bound of the cost at each price of a class."""

    prices: tuple[float, ...]
    weight: ClassVar[float] = 10.0


def run_bound(job: BoundJob) -> tuple[float, ...]:
    """Return the bound at each price, or an empty tuple where it does not apply."""
    task = job.setting.task(job.name)
    try:
        return tuple(cost_bound(task, price).lower for price in job.prices)
    except ConfigurationError:
        return ()
