"""Verdicts of the papers are of intervals."""

import numpy as np

from agents.papers.numbers import below
from agents.papers.round_robin_tobit_runs import always_below

NOISE = np.array([-3.0, 1.0, -2.0, 3.5])


def test_a_mean_below_another_is_not_yet_below() -> None:
    assert NOISE.mean() < 0.0
    assert np.isnan(below(NOISE, np.zeros(4)))
    assert below(NOISE - 10.0, np.zeros(4)) == 1.0
    error = np.full((3, 5), 0.1)
    assert np.isnan(always_below(np.stack([-0.5 * error, error]))[0])
    assert always_below(np.stack([-5.0 * error, error]))[0] == 1.0
