"""The claims on filters with unknown inputs, on synthetic runs."""

from typing import Any

import numpy as np
from synthetic_claims import check

from agents.papers.unknown_input_claims import claims

RUNS = 200
NOISE = 1.0 + np.random.default_rng(0).uniform(-0.01, 0.01, RUNS)


def about(means: Any) -> Any:
    """Return samples (..., runs) that vary by a hundredth."""
    return np.multiply.outer(means, NOISE)


def errors(state: float, others: float) -> Any:
    """Return mean squared errors (5 filters, 2 kinds, runs): ours, and the rest's."""
    return about([[state, 0.05], *([[others, others]] * 4)])


BETTER = about([[1, 1], [2, 3], [2, 3]])  # fused and two nodes, states and inputs
WORSE = about([[1, 1], [2, 3], [2, 0.9]])
ONES = np.ones((9, 3, 4))  # instants, fused and two nodes, entries
SYNTHETIC = {
    "filters": {
        "names": ["the printed example", "two carts"], "mse": [errors(0.05, 0.3)] * 2,
        "power": [about([1, 1])] * 2, "square": [0.5 * ONES] * 2, "bound": [ONES, 2 * ONES],
        "filled": [np.array([0.1, 0.2, 0.3])] * 2, "steady": [about([1, 0.9])] * 2,
        "radius": [np.array([0.1, 0.9])] * 2, "rho_range": [(0.0, 1.0, 1.0)] * 2,
        "settled": [about(7)] * 2, "within": [1.0, 1.0], "each": [BETTER] * 2,
        "rates": [about([[0.3, 0.4], [0.2, 0.3]])] * 2,
    },
    "printed": {
        "rank": 8, "columns": 8, "hidden": [[1e-9, 2e-9]], "node": about([[[1, 9], [2, 9]]]),
        "trace": about([[3, 4]]), "silent": about([3, 4]), "sent": about([2, 3]), "negative": 0.0,
        "small": 0.0002, "excess": np.zeros((2, RUNS)),
    },
}  # fmt: skip
CHANGES = {
    "The state estimates accurately track the true states.": {
        "filters.mse": [errors(0.2, 0.3), errors(0.05, 0.3)]
    },
    "The input estimates accurately track the true inputs.": {
        "filters.power": [about([1, 0.1]), about([1, 1])]
    },
    "The MSE lies below the trace of the minimum upper bound.": {
        "filters.bound": [ONES, np.array([1, 1, 1, 0.4]) * ONES]
    },
    "Ξ bounds the error covariances of every node, in the form that our filter computes.": {
        "filters.filled": [np.array([0.1, 0.2, 1.3]), np.array([0.1, 0.2, 0.3])]
    },
    "The fused estimate is consistent.": {
        "filters.filled": [np.array([0.1, 0.2, 0.3]), np.array([1.1, 0.2, 0.3])]
    },
    "The filtering error is bounded in mean square.": {
        "filters.steady": [about([1, 0.9]), about([1, 1.5])]
    },
    "The threshold increases monotonically between ρ(0) and ρ̄.": {
        "filters.rho_range": [(0.0, 1.0, 1.0), (-0.1, 1.0, 1.0)]
    },
    "A measurement without transmission differs from the last transmission by at most ρ̄.": {
        "filters.within": [1.0, 0.999]
    },
    "Fusion by covariance intersection improves the estimates.": {"filters.each": [BETTER, WORSE]},
    "The trigger significantly reduces the transmissions.": {
        "filters.rates": [about([[0.3, 0.6], [0.2, 0.3]])] * 2
    },
    "The lifted system of (3) and (4) can meet the decoupling condition (13).": {"printed.rank": 2},
    "Under (13) the input does not enter the estimation error.": {"printed.hidden": [[1e-9, 0.3]]},
    "(18) as printed, with its factor 1 - 2δ, bounds the error covariance.": {
        "printed.negative": 0.1
    },
    "The gains (19) and (20) minimise the bounds.": {"printed.excess": about([0, 0.96])},
}


def test_each_claim_holds_where_it_is_true_and_fails_where_it_is_not() -> None:
    check(claims, SYNTHETIC, CHANGES)
