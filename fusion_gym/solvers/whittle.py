"""Whittle's index of a source, from the thresholds on its error at many prices."""

import pickle
from dataclasses import replace

import numpy as np

from fusion_gym.arrays import Array
from fusion_gym.solvers.single import solve_average
from fusion_gym.solvers.source import SourceProblem
from fusion_gym.validation import ConfigurationError

_PRICES = np.geomspace(0.02, 5000.0, 32)  # prices of the solved optima, in units of w σ²

# Cache of the tables by everything but the price, for sweeps.
_cache: dict[bytes, tuple[Array, Array]] = {}


def index_table(number: int, problem: SourceProblem) -> tuple[Array, Array]:
    """Return prices (P,) and the thresholds (P, S) at these prices."""
    key = pickle.dumps(replace(problem, price=0.0))
    if key not in _cache:
        _cache[key] = _solved(number, problem)
    return _cache[key]


def _solved(number: int, problem: SourceProblem) -> tuple[Array, Array]:
    if abs(problem.coefficient) > 1.0:
        raise ConfigurationError(
            f"coefficient = {problem.coefficient:g} of source {number} is not allowed for the "
            "index: it must be from -1 to 1"
        )
    prices = _PRICES * problem.error_weight * problem.deviation**2
    solved = [solve_average(replace(problem, price=float(price))) for price in prices]
    thresholds = np.array([solution.threshold[:, 0] for solution in solved])
    worth = np.isfinite(thresholds).all(1)  # a stable source may never be worth a high price
    prices, thresholds = prices[worth], thresholds[worth]
    grows = bool((thresholds[1:] >= thresholds[:-1]).all())
    if not grows or not all(solution.ordered for solution in solved):
        raise ConfigurationError(
            f"source {number} is not allowed for the index: its thresholds must grow with the price"
        )
    return prices, thresholds
