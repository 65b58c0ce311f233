"""The claims on fusion of Markov jump systems, on synthetic runs."""

import numpy as np
from synthetic_claims import about, changed, check, verdicts

from agents.papers.claims import DEPENDS, HOLDS
from agents.papers.markov_jump_claims import claims

SENT = np.ones((10, 3), np.bool_)
LATE = SENT.copy()
LATE[:2] = False  # not at the start
SQUARES = np.stack([about(0.1, 0.2), about(0.2, 0.3), about(0.3, 0.4), about(0.4, 0.5)])
SCHEDULES = [
    {"m": 0.9, "packets": 3, "paper": about(0.21)[0], "best": about(0.2)[0]},
]
SYNTHETIC = {
    "schedule": {
        "m": [0.0, 0.9, 1.3, 1.5], "labels": ["m = 0", "m = 0.9", "m = 1.3", "m = 1.5"],
        "packets": np.array([3.0, 2.0, 1.5, 1.0]), "shares": np.ones((4, 3)), "literal": SENT,
        "at_ends": [1.0, 0.0], "range": [0.5, 1.6], "larger": np.ones(3),
        "settled": np.array([0.1, 0.2, 0.3, 0.4]), "fused_periods": np.array([6, 6, 6, 6]),
        "own_periods": np.array([1, 2, 3]), "periods": np.array([1, 2, 3]),
        "radii": [0.9, 0.95], "square_radius": 0.96,
    },
    "tracking": {
        "m": [0.0, 0.9, 1.3, 1.5], "squares": SQUARES, "silent": about(1, 2),
        "top": np.array([0.9, 0.8]), "few_top": np.array([0.9, 0.8]),
    },
    "theorems": {
        "m": [0.0, 0.9], "iterated": [1e-12, 1e-12, 1e-12], "moment": about(2)[0],
        "moment_claimed": 2.0, "local": about(0.5, 0.6, 0.7), "claimed": np.array([0.5, 0.6, 0.7]),
        "fused": about(0.3, 0.4), "traces": [0.3, 0.4], "difference": [1e-12, 1e-13],
        "least": [0.0, 0.0], "ci": about(0.35)[0],
    },
    "others": {
        "m": [0.9], "shares": np.array([0.6]), "paper": about(0.21), "chance": about(0.3),
        "sent": about(0.2)[0], "schedules": SCHEDULES, "far": np.array([0.0]),
        "centralised": about(0.1)[0], "modes": about(0.09)[0],
    },
}  # fmt: skip
CHANGES = {
    "A larger threshold sends less.": {"schedule.packets": np.array([3.0, 2.0, 2.0, 1.0])},
    "At m = 0 all local estimates are sent.": {"schedule.literal": ~SENT},
    "Thresholds that make a difference lie between the least and the largest tr P_i - tr P_d; "
    "below the least everything is sent.": {"schedule.at_ends": [0.9, 0.0]},
    "The larger the threshold, the larger the trace of the fused covariance.": {
        "schedule.larger": np.array([1.0, 0.9, 1.0])
    },
    "The fused covariances are periodically stable.": {
        "schedule.fused_periods": np.array([6, 0, 6, 6])
    },
    "A local filter's covariance is periodic with its own sampling period.": {
        "schedule.own_periods": np.array([1, 2, 6])
    },
    "Dummy measurements and an iterated state equation give the same accuracy.": {
        "theorems.iterated": [1e-12, 1e-3, 1e-12]
    },
    "Every mode of the example is stable, ρ(Φ) < 1, and so is the system.": {
        "schedule.square_radius": 1.01
    },
    "The algorithm tracks position and velocity at every threshold.": {
        "tracking.silent": about(0.3, 2)
    },
    "The tracking becomes worse as the threshold grows.": {"tracking.squares": SQUARES[::-1]},
    "The RMSE curve of m = 1.5 is at the top.": {"tracking.top": np.array([0.9, 0.4])},
    "At m = 0 the accuracy is best.": {"tracking.squares": SQUARES[[1, 0, 2, 3]]},
    "(10) is the second moment of the state.": {"theorems.moment_claimed": 2.1},
    "The local filters know the covariance of their errors.": {
        "theorems.claimed": np.array([0.5, 0.6, 0.8])
    },
    "The fused covariance is the covariance of the fused error, for all transmissions.": {
        "theorems.traces": [0.3, 0.5]
    },
    "(46)-(50) are the cross-covariances of local estimates at the centre.": {
        "theorems.least": [0.0, -0.1]
    },
    "Matrix weights give the optimal distributed estimate: better than every node, and than fusion "
    "without the cross-covariances.": {"theorems.ci": about(0.29)[0]},
    "The trigger reduces the transmission of redundant data and so saves the network.": {
        "others.chance": about(0.15)
    },
    "An appropriate threshold saves communication and keeps the accuracy that is required.": {
        "others.far": np.array([1.0])
    },
    "Centralised fusion is globally optimal, distributed fusion suboptimal.": {
        "others.centralised": about(0.3)[0]
    },
}


def test_each_claim_holds_where_it_is_true_and_fails_where_it_is_not() -> None:
    check(claims, SYNTHETIC, CHANGES)


def test_a_claim_that_holds_after_the_start_depends_on_the_reading() -> None:
    text = "At m = 0 all local estimates are sent."
    assert verdicts(claims, SYNTHETIC)[text] == HOLDS
    assert verdicts(claims, changed(SYNTHETIC, {"schedule.literal": LATE}))[text] == DEPENDS
