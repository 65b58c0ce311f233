"""Optimal schedules of several sources by their ages, without use of the errors."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.errors import forbidden
from fusion_gym.solvers.single import iterate_values
from fusion_gym.solvers.source import SourceProblem
from fusion_gym.validation import ConfigurationError

_LAZINESS = 0.3  # weight of the old value, because optimal schedules are periodic
_MOST_STATES = 300_000
_TOLERANCE, _ITERATIONS = 1e-8, 100_000


@dataclass(frozen=True)
class AgeSolution:
    """The least average cost per step, between ``lower`` and ``upper``.

    ``choice`` (A, ..., A) is the set of sources to transmit, as bits, by their ages 1 to A.
    """

    cost: float
    lower: float
    upper: float
    choice: NDArray[np.int64]


def solve_ages(
    problems: tuple[SourceProblem, ...], at_most: int | None = None, longest: int | None = None
) -> AgeSolution:
    """Return the least average cost of policies that use only ages and losses.

    The method is relative value iteration. The problems' token levels are ignored.

    Args:
        problems: the sources.
        at_most: largest number of transmissions in a step; None for no limit.
        longest: largest age, which also stands for all larger ages; by default about four times the
            best period.

    Raises:
        ConfigurationError: more than one channel state, more than 300,000 combinations of ages or
            sets of sources, or no convergence.
    """
    count = len(problems)
    limit = count if at_most is None else validation.integer("at_most", at_most, at_least=1)
    if any(len(problem.drop) > 1 for problem in problems):
        reason = "the channel must lose packets independently"
        raise forbidden("channel", "gilbert_elliott", reason, "for the best schedule by ages")
    size = longest or max(_default_length(problem, count / limit) for problem in problems)
    if max(size, 2) ** count > _MOST_STATES:
        raise ConfigurationError(
            f"longest = {size} is not allowed with {count} sources: longest^sources, and the "
            f"number 2^{count} of sets of them, must be at most {_MOST_STATES}"
        )
    sets = [s for s in range(2**count) if s.bit_count() <= limit]
    costs = [_step_cost(problems, size, selected) for selected in sets]

    def decide(value: Array) -> tuple[Array, NDArray[np.int64]]:
        options = np.stack(
            [cost + _ahead(problems, value, s) for cost, s in zip(costs, sets, strict=True)]
        )
        return options.min(0), options.argmin(0)

    shape = (size,) * count
    lower, upper, best = iterate_values(decide, shape, _TOLERANCE, _ITERATIONS, _LAZINESS)
    return AgeSolution(0.5 * (lower + upper), lower, upper, np.array(sets)[best])


def _default_length(problem: SourceProblem, sharing: float) -> int:
    period = np.sqrt(2.0 * problem.price / problem.error_weight) / problem.deviation
    drop = float(problem.drop[0])
    losses = np.log(1e-6) / np.log(drop) if 0.0 < drop < 1.0 else 0.0
    return int(np.ceil(4.0 * max(period, sharing) + losses * max(sharing, 1.0))) + 6


def _step_cost(problems: tuple[SourceProblem, ...], size: int, choice: int) -> Array:
    """Return the expected cost (A, ..., A) of a step in which the sources ``choice`` transmit."""
    total = np.zeros((size,) * len(problems))
    for i, problem in enumerate(problems):
        # The errors of the ages k have the variances σ² (1 + a² + … + a^(2(k-1))).
        with np.errstate(over="ignore"):
            powers = problem.coefficient ** (2.0 * np.arange(size))
        cost = problem.error_weight * (problem.deviation**2 * np.cumsum(powers))
        if choice >> i & 1:
            cost = problem.price + problem.drop[0] * cost
        shape = [1] * len(problems)
        shape[i] = size
        total = total + cost.reshape(shape)
    return total


def _ahead(problems: tuple[SourceProblem, ...], value: Array, choice: int) -> Array:
    """Return the expected value of the next ages."""
    for i, problem in enumerate(problems):
        size = value.shape[i]
        older = value.take(np.minimum(np.arange(size) + 1, size - 1), axis=i)
        if choice >> i & 1:
            drop = problem.drop[0]
            value = drop * older + (1.0 - drop) * value.take([0], axis=i)
        else:
            value = older
    return value
