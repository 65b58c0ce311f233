"""Filters of censored sensors after long silence and from priors far larger than the noise."""

from typing import Any

import numpy as np
import pytest
from reference_digits import largest_errors
from structured_systems import flaw

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task

MATRICES = [[[1.0, 0.3], [-0.2, 1.0]], [[1.0, -2.3], [0.2, 1.0]]]
UNKNOWN = {
    "initial_covariance": ((1e10, 9.9e9), (9.9e9, 1e10)),
    "measurement_matrices": MATRICES,
    "measurement_variance": 1e4,
}
DECAYS = {"transition": [[0.5, 0.0], [0.0, 0.5]], "process_variance": 2.0}
DIES = {"transition": [[0.0, 1.0], [0.0, 0.0]], "process_variance": 2.0}


def make(**options: Any) -> Task:
    return fusion_gym.make_task(
        "fusion_gym/TobitOscillator-v1", tokens="unlimited", horizon=250, **options
    )


@pytest.mark.parametrize("kind", ["paper", "tobit", "adf"])
@pytest.mark.parametrize("plant", [{}, UNKNOWN, DECAYS, DIES])
def test_long_silence_leaves_estimates_and_covariances_sound(kind: str, plant: Any) -> None:
    """Where P - P Cᵀ S⁻¹ C P loses all its digits: in one of twenty runs."""
    task = make(filter=kind, **plant)
    batch, draw = EpisodeBatch.seeded(task, 200, 0), np.random.default_rng(5)
    for _ in range(250):
        outcome = batch.step(draw.random((task.sensors, 200)) < 0.02)
        assert flaw(batch, outcome.reward, ()) is None


@pytest.mark.parametrize(
    ("kind", "threshold"),
    [("tobit", -np.inf), ("kalman", -np.inf), ("adf", -np.inf), ("tobit", 0.0)],
)
def test_the_first_look_from_an_unknown_start(kind: str, threshold: float) -> None:
    """P₀ is 10⁶ times R; uncensored, all three are the Kalman filter."""
    task = make(filter=kind, censoring_threshold=threshold, **UNKNOWN)
    assert max(largest_errors(task, 40, 5, censored=threshold == 0.0)) < 1e-8
