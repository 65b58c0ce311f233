"""The claims on Tobit Kalman fusion with a token bucket, on synthetic runs."""

import numpy as np
import pytest
from synthetic_claims import about, check, verdicts

from agents.papers import tobit_token_bucket_claims as module
from agents.papers.claims import HOLDS, MISPRINT
from agents.papers.tobit_token_bucket_claims import claims

LOCAL = about(0.2, 0.3, 0.25, 0.3, 0.25, 0.5).reshape(3, 2, -1)
EIGENVALUES = np.full((4, 50), 0.5)
ONE = np.ones(20)
SYNTHETIC = {
    "network": {
        "lowest": 0.0, "highest": 20.0, "capacity": 20.0, "poor_grants": 0, "uncalled_grants": 0,
        "grants": 1000, "needed": 9.0, "rich_refusals": 0, "rate_requested": about(0.5, 0.6, 0.7),
        "rate": 5.0, "wanted": about(6)[0], "spent": about(4)[0], "mse": about(0.5)[0],
        "mse_unlimited": about(0.4)[0],
    },
    "estimates": {
        "local_change": LOCAL, "fused_change": about(0.1, 0.1), "change_censored": about(0.4)[0],
        "change_uncensored": about(0.3)[0], "moved": about(0.1)[0], "single_moved": about(1, 2, 3),
        "mse": about(0.4)[0], "single_mse": about(0.5, 0.6, 0.7), "single_rate": [0.3, 0.4, 0.5],
        "rate": 0.4,
    },
    "errors": {
        "share_trace": np.ones((3, 20)), "by_fused_trace": about(4)[0],
        "by_fused_error": about(0.4)[0], "by_local_error": about(0.5, 0.6, 0.7),
        "share_error": about(0.6, 0.7, 0.8), "rough_fused_error": about(0.1)[0],
        "rough_local_error": about(0.2, 0.3, 0.4),
    },
    "theorems": {
        "eigenvalue": EIGENVALUES, "eigenvalue_error": 0.01 * np.ones((4, 50)), "gain_larger": ONE,
        "gain_difference": 1e-12 * ONE, "gain_counted": ONE, "holds_delivered": ONE,
        "holds_silent": ONE, "least_silent": 0.9 * ONE, "growth": ONE, "holds": ONE,
        "limit_ratio": 2.0, "windows": about(1, 1, 1, 1, 1), "traces": about(2, 2, 2, 2, 2),
        "healthy": about(0.5)[0], "failed": about(0.51, 0.52, 0.53), "silent": about(2)[0],
    },
    "readings": {
        "fused": about(0.4, 0.4, 0.4, 0.4, 0.41), "local": np.stack([about(0.5, 0.6, 0.7)]),
        "extended": about(0.5)[0], "unscented": about(0.6)[0], "ci": about(0.5)[0],
        "sci": about(0.6)[0], "ignoring": about(0.8)[0],
    },
}  # fmt: skip
ABOVE = EIGENVALUES + np.eye(4, 50) * 0.6  # one step of each estimate
FUSED_ABOVE = EIGENVALUES + np.eye(1, 50) * 0.6
CHANGES = {
    "A measurement is sent only if its event occurs and there are tokens for it.": {
        "network.highest": 21.0
    },
    "The event trigger saves communication.": {"network.rate_requested": about(0.5, 0.6, 1.1)},
    "An event trigger alone does not keep the network from being overused; the bucket does.": {
        "network.wanted": about(4.5)[0]
    },
    "Denied packets cost accuracy: the bucket affects the filtering error.": {
        "network.mse": about(0.3)[0]
    },
    "Censoring makes the local estimates fluctuate, most of all the second state at node 3.": {
        "estimates.change_censored": about(0.2)[0]
    },
    "The fused estimate, fed back, smooths the local filters' fluctuations.": {
        "estimates.single_moved": about(1, 0.05, 3)
    },
    "The fusion scheme is effective: better than its nodes without fusion.": {
        "estimates.mse": about(0.55)[0]
    },
    "The trace of the fused bound is smaller than the trace of every node.": {
        "errors.share_trace": np.full((3, 20), 0.999)
    },
    "In most cases the squared error of the fused estimate is smaller than the local one.": {
        "errors.share_error": about(0.6, 0.4, 0.8)
    },
    "Fusion improves the mean squared error of every node.": {
        "errors.by_fused_error": about(0.55)[0]
    },
    "The fused error's curve is relatively smooth.": {"errors.rough_fused_error": about(0.25)[0]},
    "The local bound is above the covariance of the local error.": {"theorems.eigenvalue": ABOVE},
    "The fused bound is above the covariance of the fused error.": {
        "theorems.eigenvalue": FUSED_ABOVE
    },
    "The gain (37) minimises the trace of the bound (30).": {"theorems.gain_larger": 0.99 * ONE},
    "Condition (42) holds in the example, and the error is bounded in mean square.": {
        "theorems.windows": about(1, 1, 1, 1, 2)
    },
    "(43) exists, and the error's covariance stays below it.": {"theorems.limit_ratio": 0.9},
    "If a sensor fails, the others' data keep the filters good.": {
        "theorems.failed": about(0.51, 0.6, 0.53)
    },
    "The centre obtains an optimal estimate from the local ones.": {
        "readings.fused": about(0.4, 0.4, 0.4, 0.4, 0.3)
    },
    "The Tobit Kalman filter surpasses the extended and the unscented one.": {
        "readings.unscented": about(0.3)[0]
    },
    "Federated fusion has the smallest burden and the highest accuracy.": {
        "readings.sci": about(0.3)[0]
    },
    "Traditional Kalman filtering cannot handle censored measurements; the Tobit filter can.": {
        "readings.ignoring": about(0.3)[0]
    },
}
OPERATIONS = "Algorithm 1 takes the printed number of operations."


def test_each_claim_holds_where_it_is_true_and_fails_where_it_is_not() -> None:
    others = type(claims)(claim for claim in claims if claim.text != OPERATIONS)
    check(others, SYNTHETIC, CHANGES)


def test_another_number_of_operations_is_a_misprint(monkeypatch: pytest.MonkeyPatch) -> None:
    assert verdicts(claims, SYNTHETIC)[OPERATIONS] == MISPRINT
    monkeypatch.setattr(module, "count_operations", lambda: module.PRINTED_OPERATIONS)
    assert verdicts(claims, SYNTHETIC)[OPERATIONS] == HOLDS
