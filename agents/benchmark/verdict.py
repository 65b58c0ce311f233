"""Tests of policies, and their cost relative to the searched rule at equal price."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from scipy import stats

from agents.benchmark.jobs import Job
from agents.benchmark.settings import Case
from fusion_gym.arrays import Array
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy

LEVEL = 0.95
FALSE_DISCOVERIES = 0.05


@dataclass(frozen=True)
class TestJob(Job):
    """A policy at each price, on episodes from a first seed.

    ``content`` is the text of all policies, or the hash of an agent's file. An agent runs in the
    class's environment for agents, whose price range is ``class_prices``; a rule runs in the
    environment for rules.
    """

    __test__: ClassVar[bool] = False
    policies: tuple[str, ...] = field(metadata={"key": False})
    prices: tuple[float, ...]
    class_prices: tuple[float, ...]
    episodes: int
    seed: int
    content: str
    agent: bool = False
    memory: bool | None = None
    case: Case | None = None
    weight: ClassVar[float] = 20.0

    def task(self) -> Task:
        """Return the task of the test."""
        if not self.agent:
            return self.setting.task(self.name, self.memory, self.case)
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
    for text, price in zip(job.policies, job.prices, strict=True):
        policy = make_policy(text, task)
        results = run_episodes(task, policy, job.episodes, job.seed)
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
    """Return the relative difference of costs (E,) of one or more seeds to a reference's (E,).

    Seeds and episodes are crossed random factors: the variance of the mean is the seed means'
    variance over their number plus the episode means' over theirs, with Satterthwaite's degrees of
    freedom.
    """
    values = (np.array(costs) - reference) / reference.mean()
    seeds, episodes = values.shape
    parts = [float(values.mean(0).var(ddof=1)) / episodes]
    freedom = [episodes - 1]
    if seeds > 1:
        parts.append(float(values.mean(1).var(ddof=1)) / seeds)
        freedom.append(seeds - 1)
    variance, mean = sum(parts), float(values.mean())
    if variance == 0.0:
        return Difference(mean, mean, mean, float(mean == 0.0))
    degrees = variance**2 / sum(part**2 / df for part, df in zip(parts, freedom, strict=True))
    reach = float(stats.t.ppf(0.5 + LEVEL / 2.0, degrees)) * variance**0.5
    p = 2.0 * float(stats.t.sf(abs(mean) / variance**0.5, degrees))
    return Difference(mean, mean - reach, mean + reach, p)


def over_prices(
    outcomes: Sequence[Sequence[TestResult]], reference: Sequence[TestResult]
) -> Difference:
    """Return the mean relative difference over the prices, of one or more seeds."""
    relative = [
        np.mean([o.cost / r.cost.mean() for o, r in zip(seed, reference, strict=True)], axis=0)
        for seed in outcomes
    ]
    base = np.mean([r.cost / r.cost.mean() for r in reference], axis=0)
    return cost_difference(relative, base)


def discoveries(p_values: Sequence[float]) -> list[bool]:
    """Return which differences count after Benjamini and Hochberg's procedure."""
    if not p_values:
        return []
    adjusted = stats.false_discovery_control(np.clip(p_values, 0.0, 1.0))
    return [bool(value <= FALSE_DISCOVERIES) for value in adjusted]
