"""Plants whose covariances become singular: estimates against arithmetic of 50 digits."""

from typing import Any

import numpy as np
import pytest
from parts import Parts
from reference_digits import largest_errors

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch

TOBIT = "fusion_gym/TobitOscillator-v1"
TRACKING = "fusion_gym/BiasedTracking-v1"
LINEAR = "fusion_gym/LinearFusion-v2"
HALF = [[0.5, 0.0], [0.0, 0.5]]
_TURN = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
PLANTS: dict[str, dict[str, Any]] = {
    "decay": {"transition": HALF, "process_covariance": [[0.2, 0.1], [0.1, 0.05]]},
    "no noise": {"transition": [[0.9, 0.2], [0.0, 0.4]], "process_covariance": np.zeros((2, 2))},
    "offset": {
        "transition": [[1.0, 0.1, 0.1], [0.0, 1.0, 0.0], [0.0, 0.0, 0.05]],
        "process_covariance": np.diag([0.0, 0.1, 0.0]),
        "measurement_matrices": [[1.0, 0.0, 0.0], [[0.0, 1.0, 0.5], [1.0, 1.0, 1.0]]],
    },
    "turned": {
        "transition": _TURN @ np.diag([0.95, 0.5, 0.0]) @ _TURN.T,
        "process_covariance": np.outer(_TURN[:, 0], _TURN[:, 0]),
        "measurement_matrices": [[1.0, 0.0, 0.0], [0.3, -1.0, 2.0]],
    },
    "growth": {
        "transition": [[1.02, 0.3], [0.0, 0.3]],
        "process_covariance": [[0.0, 0.0], [0.0, 0.0]],
        "measurement_covariances": 1e-4,
    },
}
FILTERS: dict[str, dict[str, Any]] = {
    "kalman": {},
    "shares": {"information_shares": [0.2, 0.8]},
    "tobit": {"filter": "tobit", "censoring_threshold": -0.2},
    "stochastic": {"filter": "stochastic", "stochastic_weight": [0.5, 3.0]},
    "joint": {"filter": "joint"},
    "adf": {"filter": "adf"},
}


@pytest.mark.parametrize("silent", [False, True])
@pytest.mark.parametrize("kind", FILTERS)
@pytest.mark.parametrize("plant", PLANTS)
def test_estimates_are_exact_where_covariances_become_singular(
    plant: str, kind: str, silent: bool
) -> None:
    options = PLANTS[plant] | FILTERS[kind]
    task = fusion_gym.make_task(LINEAR, tokens="unlimited", horizon=100, **options)
    errors = largest_errors(task, 100, 5, censored=kind == "tobit", silent=silent)
    assert max(errors) <= 1e-9


def test_a_bias_that_nothing_moves_dies_out() -> None:
    """Its variance underflows after 511 steps; the observation stays finite."""
    task = fusion_gym.make_task(
        TRACKING, bias_noise_covariance=[[0.0]], bias_transition=[[0.5]], horizon=1000
    )
    batch = EpisodeBatch.seeded(task, 2, 0)
    for step in range(1000):
        assert np.isfinite(batch.observe()).all()
        batch.step(np.arange(4).reshape(2, 2) % 2 == step % 2)
    assert Parts.of(task).fused(batch.delivered)[1][2, 2].max() == 0.0


def test_the_first_estimate_uses_the_first_measurements() -> None:
    """Of a linear system; the papers' systems begin with the mean of the start."""
    task = fusion_gym.make_task(LINEAR, initial_covariance=4.0 * np.eye(2))
    state = EpisodeBatch.seeded(task, 5, 0).state.estimate
    np.testing.assert_allclose(state.mean, state.held[:, 0] * 4.0 / 4.25, rtol=1e-12)
    np.testing.assert_allclose(
        state.covariance, 4.0 * 0.25 / 4.25 * np.eye(2)[..., None] * np.ones(5), atol=1e-15
    )
    task = fusion_gym.make_task(TOBIT)
    assert (EpisodeBatch.seeded(task, 5, 0).state.estimate.mean == [[5.0], [0.0]]).all()
