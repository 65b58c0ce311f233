"""The claims on the adaptive innovation trigger, on synthetic runs."""

import numpy as np
from synthetic_claims import ENOUGH, about, changed, check, verdicts

from agents.papers.adaptive_innovation_claims import claims
from agents.papers.claims import FAILS, MISPRINT

STEPS = 40


PERCENT = {
    "ours": about(60, 48, 70), "printed_sign": about(3, 3, 3), "timed": np.full((3, ENOUGH), 100.0),
    "fixed": about(40, 30, 47),
}  # fmt: skip
AT = {
    "mse": about(0.4, 0.3), "conservative": about(0.9, 0.5),
    "square": np.full((2, 3, ENOUGH), 0.001), "level": np.full((2, 3, ENOUGH), 1.0),
    "mse_steps": np.full((2, STEPS), 0.4), "conservative_steps": np.full((2, STEPS), 0.9),
    "beats": np.ones((2, 3, ENOUGH)),
}  # fmt: skip
SYNTHETIC = {
    "rates": {
        "percent": PERCENT, "agree": [True, True, True], "falls": [True, True],
        "changes": about(0.9, 0.1), "unmoved": 0.0,
    },
    "fusion": {
        "at": AT, "relative": about(1, 2), "independent": about(1, 2),
        "inside": np.full((2, 3, 3), 0.998), "ordered": np.ones((2, 3)), "node_share": 1.0,
        "gap": 1e-15, "reached": True, "bounded": np.array([[1.0, 1.0], [1.0, 1.0]]),
        "worst": [1.0, 1.0], "settings": ["at the bounds", "0.8"], "real": about(1, 1),
        "rules": ["SCI", "SICI"], "late": np.stack([np.full(STEPS, 0.4), np.full(STEPS, 0.3)]),
        "inverses": [3, 4], "node": about(9, 4, 15), "plane": np.ones((2, 3)),
        "whole": np.ones((2, 3)), "price": about(20, 15), "other": about(0.5, 0.4),
    },
}  # fmt: skip
NEVER = np.zeros((2, 3))
CHANGES = {
    "The mechanism reduces the communication burden.": {"rates.percent.ours": about(60, 48, 120)},
    "The rates of the three sensors are 60.67, 48.5, 70.67 %.": {
        "rates.agree": [True, True, False]
    },
    "The threshold is a decreasing function of the innovation.": {"rates.falls": [False, False]},
    "The thresholds adapt to the innovations.": {"rates.changes": about(0, 0.1)},
    "The threshold changes when the sensor is not triggered.": {"rates.changes": about(0.9, 0)},
    "With a = 0 the mechanism is the time trigger, with c = 0 one with a fixed threshold.": {
        "rates.unmoved": 0.1
    },
    "Both fused estimates track well.": {"fusion.at.square": np.full((2, 3, ENOUGH), 0.02)},
    "The MSE is close to the trace of the actual error variance.": {
        "fusion.relative": about(1, 20)
    },
    "The MSE lies below the trace of the conservative error variance.": {
        "fusion.at.conservative": about(0.9, 0.2)
    },
    "More than 99 % of the fused errors lie within three actual standard deviations.": {
        "fusion.inside": np.full((2, 3, 3), 0.98)
    },
    "The actual deviations never exceed the robust ones, in all three groups.": {
        "fusion.ordered": np.full((2, 3), 0.9999)
    },
    "Every node's conservative variance bounds its actual one.": {"fusion.node_share": 0.999},
    "It is the least such bound: at the bounds of the variances both are equal.": {
        "fusion.gap": 0.1
    },
    "SCI's conservative variance bounds its actual one.": {"fusion.bounded": np.full((2, 2), 0.9)},
    "SICI's conservative variance bounds its actual one.": {"fusion.bounded": np.full((2, 2), 0.9)},
    "P̄ is the covariance of the actual fused errors.": {"fusion.independent": about(1, 20)},
    "SICI is more accurate than SCI.": {"fusion.at.mse": about(0.3, 0.4)},
    "SICI has higher accuracy, better tightness and better consistency than SCI.": (
        {"fusion.bounded": np.array([[0.9, 1.0], [1.0, 1.0]])},
        {"fusion.bounded": np.array([[0.9, 1.0], [0.8, 1.0]])},
    ),
    "SICI costs more than SCI, because of multiple inverses.": {"fusion.inverses": [4, 4]},
    "The robust accuracy of both fusions is higher than each sensor's.": {
        "fusion.node": about(9, 0.35, 15)
    },
    "The nodes' conservative ellipses contain the ellipses of both fusions.": {
        "fusion.whole": NEVER
    },
    "The trigger saves communication while the estimation stays effective.": {
        "fusion.other": about(0.3, 0.2)
    },
}


def test_each_claim_holds_where_it_is_true_and_fails_where_it_is_not() -> None:
    check(claims, SYNTHETIC, CHANGES)


def test_a_formula_that_holds_with_the_other_sign_is_a_misprint() -> None:
    text = "The threshold is a decreasing function of the innovation."
    for falls, verdict in (([False, True], MISPRINT), ([False, False], FAILS)):
        runs = changed(SYNTHETIC, {"rates.falls": falls})
        assert verdicts(claims, runs)[text] == verdict
