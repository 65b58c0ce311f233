"""A lower bound for many sources that share tokens: each on its own, at a common price."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from fusion_gym import validation
from fusion_gym.solvers.single import solve_average, solve_finite
from fusion_gym.solvers.source import SourceProblem
from fusion_gym.validation import ConfigurationError

_TOLERANCE = 1e-3  # of the multiplier, relatively: the bound is flat there
_DOUBLINGS = 60


class DualBound(NamedTuple):
    """No policy costs less than ``cost``; ``multiplier`` is the price of a token that shows it."""

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
    """What no policy of these sources can undercut that spends ``rate`` tokens a step or fewer.

    For every multiplier μ >= 0, the sum of the sources' own optima at the prices
    price + μ · spent, less μ times the tokens there are, is a lower bound (weak duality); the
    largest is returned. ``spent`` are the tokens of one transmission; one transmission a step
    (``access="single"``) is a rate of 1 with ``spent`` of 1. The problems' own tokens must be
    unlimited.

    With ``horizon`` the cost is that of an episode, whose channels start in the problems' own
    ``initial`` laws and for which there are ``initial_tokens`` and ``rate`` after every step but
    the last; otherwise it is the average a step.

    Raises:
        ConfigurationError: a value that is not allowed.
    """
    if any(len(problem.tokens.level) > 1 for problem in problems):
        raise ConfigurationError(
            "tokens = 'limited' is not allowed in the parts of the bound: each source must be "
            "limited by its price alone"
        )
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
    best = dual(0.0)
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
    zero = dual(0.0)
    if zero >= -float(optimum.fun):
        return DualBound(zero, 0.0)
    return DualBound(float(-optimum.fun), float(np.asarray(optimum.x)))
