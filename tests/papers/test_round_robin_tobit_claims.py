"""The claims on federated Tobit filters under the round robin, on synthetic runs."""

import copy
from typing import Any

import numpy as np
from synthetic_claims import ENOUGH, Runs, changed, check, verdicts

from agents.papers.claims import DEPENDS, FAILS, MISPRINT
from agents.papers.paper import PieceData
from agents.papers.round_robin_tobit_claims import claims

STEPS = 10
NOISE = np.random.default_rng(0).normal(size=ENOUGH)
NOISE -= NOISE.mean()
LOWER = np.stack([np.full((STEPS, 3), -5.0), np.ones((STEPS, 3))])
HIGHER = LOWER * np.array([-1.0, 1.0])[:, None, None]
LARGER = {"mean": [0.2] * 3, "low": [0.1] * 3, "high": [0.3] * 3}
SMALLER = {"mean": [-0.2] * 3, "low": [-0.3] * 3, "high": [-0.1] * 3}
VALUES = np.linspace(-5.0, 5.0, 7)


def about(mean: float) -> np.ndarray[Any, Any]:
    """Return a sample of all runs with this mean."""
    return mean + 0.01 * NOISE


def rows(*rises: float) -> list[dict[str, Any]]:
    """Return the rows of a table: its first, and one for each rise."""
    result = []
    for rise in (0.0, *rises):
        ends = {end: [rise + reach] * 4 for end, reach in (("low", -0.1), ("high", 0.1))}
        item = {"mean": [1.0] * 3, "median": [1.0, 0.9, 1.1], "rise": ends}
        result.append({"paper": item, "adf": item})
    return result


def failure_shares(case: slice, bound: slice) -> np.ndarray[Any, Any]:
    """Return shares of failures of some bounds in some cases, of no others."""
    shares = np.zeros((3, 3, 7, ENOUGH))
    shares[:, case, bound] = 0.1
    return shares


CURVES = {
    "aware_armse": {"mean": [0.2, 0.2, 0.2]}, "unaware_armse": {"mean": [0.8, 0.8, 1.0]},
    "silent": [1.0, 1.0, 1.0], "floor": [0.2, 0.2, 0.2], "difference": LOWER,
}  # fmt: skip
NODES = [f"{name}_{i}" for name in ("single", "node") for i in range(2)]
SYNTHETIC: Runs = {
    "oscillator": CURVES, "target": copy.deepcopy(CURVES),
    "nodes": {f"{name}_increase": dict(LARGER) for name in NODES}
    | {f"{name}_difference": LOWER for name in NODES},
    "tables": {"table_2": rows(1.0, 1.0), "table_3": rows(-1.0, -1.0)},
    "theory": {
        "mean": VALUES, "mean_error": np.full(7, 0.01), "equation_12": VALUES,
        "equation_12_printed": VALUES, "variance": VALUES, "variance_error": np.full(7, 0.01),
        "equation_13": VALUES, "total_variance": VALUES, "oscillator_predicted": about(0.7),
        "oscillator_uncensored": about(0.7) - 0.001 * NOISE, "oscillator_sure": about(1.0),
        "oscillator_surprised": about(1.1), "oscillator_nees": about(1.0),
        "target_nees": about(1.0), "oscillator_product": NOISE, "oscillator_first": about(1.0),
        "oscillator_second": about(1.0), "target_product": NOISE, "target_first": about(1.0),
        "target_second": about(1.0), "mse_paper": about(1.0), "mse_adf": 2.0 * about(1.0),
        "mse_kalman": 2.0 * about(1.0), "armse_paper": [1.0] * 3, "armse_free": [1.0] * 3,
        "armse_calm": [1.0] * 3, "shares_gap": 0.0, "without_gap": 0.0,
    },
    "bounds": {"shares": np.zeros((3, 3, 7, ENOUGH))},
}  # fmt: skip
UPPER, BELOW = slice(4), slice(4, 7)
OFF = VALUES + 1.0
CHANGES = {
    "FTKF-DB tracks states and bias precisely.": {
        "oscillator.aware_armse.mean": [0.2, 0.4, 0.2]
    },
    "FTKF deviates considerably and cannot track the bias.": {
        "oscillator.unaware_armse.mean": [0.8, 0.8, 0.9]
    },
    "RMSE1 and RMSE2 of FTKF-DB are always smaller than with FTKF.": {
        "oscillator.difference": np.where(np.arange(STEPS)[:, None] == 3, HIGHER, LOWER)
    },
    "RMSE3 of FTKF-DB is within a satisfactory range.": {
        "oscillator.aware_armse.mean": [0.2, 0.2, 0.4]
    },
    "The fused filter outperforms both local ones in the states.": {
        f"nodes.{name}_1_increase.{end}": [SMALLER[end][0], 0.2, 0.2]
        for name in ("single", "node") for end in SMALLER
    },
    "The fused filter outperforms both local ones in the bias.": {
        f"nodes.{name}_1_increase.{end}": [0.2, 0.2, SMALLER[end][2]]
        for name in ("single", "node") for end in SMALLER
    },
    "The narrower the censoring interval, the larger the error of states and bias.": {
        "tables.table_2": rows(1.0, -1.0)
    },
    "The smaller the noise variance R, the smaller the error of states and bias.": {
        "tables.table_3": rows(-1.0, 1.0)
    },
    "RMSE of position and velocity of FTKF-DB are always smaller than with FTKF.": {
        "target.difference": HIGHER
    },
    "The bias's RMSE is within a satisfactory range.": {
        "target.aware_armse.mean": [0.2, 0.2, 0.4]
    },
    "The fused estimate is the global optimum (nothing censored).": {
        "target.aware_armse.mean": [0.2, 0.21, 0.2]
    },
    "(12) is the mean of a censored measurement.": {
        "theory.equation_12": OFF, "theory.equation_12_printed": OFF
    },
    "(13) is the variance of a censored measurement.": {"theory.equation_13": OFF},
    "(9) approximates the censoring probabilities.": {"theory.oscillator_surprised": about(3.0)},
    "(21) is the covariance of the error.": {"theory.oscillator_nees": about(1.7)},
    "The local estimate is E{ξ | y}, of least error.": {"theory.mse_adf": 0.5 * about(1.0)},
    "Errors of the prediction are uncorrelated in time (supposed).": {
        "theory.target_product": about(0.8)
    },
    "Federated fusion is the global optimum of the local estimates.": {"theory.shares_gap": 0.1},
    "Without bias and round robin it is the usual Tobit filter.": {"theory.without_gap": 0.1},
    "Censored observations, inadequately handled, impair the performance.": {
        "theory.mse_kalman": 0.5 * about(1.0)
    },
    "FTKF is insensitive to dynamical biases and censored observations.": {
        "theory.armse_calm": [1.0, 0.5, 1.0]
    },
    "P^u is an upper bound on a local filter's covariance.": {
        "bounds.shares": failure_shares(slice(1, 2), UPPER)
    },
    "P^l is a lower bound on a local filter's covariance.": {
        "bounds.shares": failure_shares(slice(1, 2), BELOW)
    },
    "The joined P^u is an upper bound on the fused covariance.": {
        "bounds.shares": failure_shares(slice(2, 3), UPPER)
    },
    "The joined P^l is a lower bound on the fused covariance.": {
        "bounds.shares": failure_shares(slice(2, 3), BELOW)
    },
}  # fmt: skip


def test_each_claim_holds_where_it_is_true_and_fails_where_it_is_not() -> None:
    check(claims, SYNTHETIC, CHANGES)


def test_an_equation_that_holds_with_the_root_is_a_misprint() -> None:
    runs = changed(SYNTHETIC, {"theory.equation_12_printed": OFF})
    assert verdicts(claims, runs)["(12) is the mean of a censored measurement."] == MISPRINT


def test_a_claim_that_one_reading_alone_meets_depends_on_it() -> None:
    text = "The fused filter outperforms both local ones in the bias."
    runs = changed(SYNTHETIC, {"nodes.node_1_increase": SMALLER})
    assert verdicts(claims, runs)[text] == DEPENDS
    (claim,) = (claim for claim in claims if claim.text == text)
    data = {name: PieceData(piece, episodes=ENOUGH) for name, piece in runs.items()}
    assert claim.judge({"": data}).region == ": holds with single filters"


def test_of_the_bounds_the_reading_that_fails_least_is_named() -> None:
    shares = failure_shares(slice(2, 3), UPPER)
    shares[:, 2, 2] = 0.01
    bounds = PieceData({"shares": shares}, episodes=ENOUGH)
    (claim,) = (claim for claim in claims if claim.text.startswith("The joined P^u"))
    judgement = claim.judge({"": {"bounds": bounds}})
    assert judgement.verdict == FAILS
    assert "of 4 readings *the bound in its own correction* fails least" in judgement.evidence
    assert judgement.evidence.count("10 % (oscillator)") == 1
    assert judgement.evidence.count("1 % (oscillator)") == 1
