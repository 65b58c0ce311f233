"""A lower bound for many sources that share tokens, by independent optima at a common price."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from fusion_gym import validation
from fusion_gym.errors import forbidden
from fusion_gym.solvers.single import solve_average, solve_finite
from fusion_gym.solvers.source import SourceProblem

_TOLERANCE = 1e-3  # relative, of the multiplier; the bound is flat at its maximum
_DOUBLINGS = 60


class DualBound(NamedTuple):
    """A lower bound ``cost`` of every policy, and its ``multiplier``, the price of a token."""

    cost: float
    multiplier: float


def lagrangian_bound(
    problems: Sequence[SourceProblem],
    spent: Sequence[float],
    rate: float,
    horizon: int | None = None,
    initial_tokens: float = 0.0,
    initial_deviation: Sequence[float] | None = None,
) -> DualBound:
    """Return a lower bound of the cost of policies that spend at most ``rate`` tokens per step.

    A multiplier μ >= 0 gives the lower bound Σᵢ Jᵢ(priceᵢ + μ · spentᵢ) - μ · supply by weak
    duality, where Jᵢ is the optimal cost of source i at a price. The function returns the largest
    of these bounds. One transmission per step (``access="single"``) is a rate of 1 with ``spent``
    of 1.

    Without ``horizon`` the cost is the average per step, and the supply is ``rate``. With
    ``horizon`` the cost is the sum over an episode, whose channels start in the problems'
    ``initial`` laws. Its supply is ``initial_tokens`` + ``rate`` · (``horizon`` - 1).

    Args:
        problems: the sources; their own tokens must be unlimited.
        spent: tokens of a transmission of each source.
        rate: tokens per step.
        horizon: number of steps; None for the average cost.
        initial_tokens: tokens at the start of an episode.
        initial_deviation: standard deviation of x(0) of each source; 0 by default.

    Raises:
        ConfigurationError: a value that is not allowed.
    """
    if any(len(problem.tokens.level) > 1 for problem in problems):
        reason = "only its price must limit each source"
        raise forbidden("tokens", "limited", reason, "in the parts of the bound")
    costs = validation.positive("spent", list(spent), (len(problems),)).tolist()
    gained = validation.number("rate", rate, at_least=0.0)
    start = list(initial_deviation or [0.0] * len(problems))
    supply = gained if horizon is None else initial_tokens + gained * (horizon - 1)

    def dual(multiplier: float) -> float:
        total = -multiplier * supply
        for problem, cost, spread in zip(problems, costs, start, strict=True):
            dearer = replace(problem, price=problem.price + multiplier * cost)
            total += (
                solve_average(dearer).lower
                if horizon is None
                else solve_finite(dearer, horizon, spread).cost
            )
        return total

    high = max(problem.price / cost for problem, cost in zip(problems, costs, strict=True))
    high = max(high, min(p.error_weight * p.deviation**2 for p in problems))
    best = zero = dual(0.0)
    for _ in range(_DOUBLINGS):
        value = dual(high)
        if value < best:
            break
        best, high = value, 2.0 * high
    optimum = minimize_scalar(
        lambda multiplier: -dual(float(multiplier)),
        bounds=(0.0, high),
        method="bounded",
        options={"xatol": _TOLERANCE * high},
    )
    if zero >= -float(optimum.fun):
        return DualBound(zero, 0.0)
    return DualBound(float(-optimum.fun), float(np.asarray(optimum.x)))
