"""Proven lower bounds of the cost of every policy in a class."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from agents.benchmark.jobs import Job
from fusion_gym.solvers.silence import cost_bound
from fusion_gym.validation import ConfigurationError


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
