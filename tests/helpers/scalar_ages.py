"""Scalar sources with exact sensors as sources by age."""

import numpy as np

from fusion_gym.solvers.ages import AgeSource
from fusion_gym.solvers.source import SourceProblem


def by_age(problem: SourceProblem, longest: int | None = None, sharing: float = 1.0) -> AgeSource:
    """Return a source up to an age of about four times the best period."""
    period = np.sqrt(2.0 * problem.price / problem.error_weight) / problem.deviation
    drop = float(problem.drop.max())
    losses = np.log(1e-6) / np.log(drop) if 0.0 < drop < 1.0 else 0.0
    usual = int(np.ceil(4.0 * max(period, sharing) + losses * max(sharing, 1.0))) + 6
    with np.errstate(over="ignore"):
        powers = problem.coefficient ** (2.0 * np.arange(longest or usual))
    errors = problem.error_weight * problem.deviation**2 * np.cumsum(powers)
    costs = np.concatenate((np.zeros(1), errors))
    return AgeSource(costs, problem.price, problem.drop, problem.transition, problem.coefficient**2)
