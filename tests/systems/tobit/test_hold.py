"""The centre that holds the last values, against closed forms and Monte Carlo."""

from typing import Any

import numpy as np
import pytest

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.validation import ConfigurationError

LINEAR = "fusion_gym/LinearFusion-v2"
WALK = {"transition": [[1.0]], "process_covariance": [[0.3]], "measurement_matrices": [[1.0]]}
# Three sensors of two channels at most, whose held values differ in age.
MIXED = {
    "transition": [[0.9, 0.2], [-0.1, 0.8]],
    "process_covariance": [[0.4, 0.1], [0.1, 0.3]],
    "initial_mean": [2.0, -1.0],
    "measurement_matrices": [[1, 0], [[0, 1], [1, 1]], [1, -1]],
    "measurement_covariances": [0.2, [[0.3, 0.1], [0.1, 0.2]], 0.1],
}


def make(**options: Any) -> Task:
    return fusion_gym.make_task(LINEAR, filter="hold", tokens="unlimited", **options)


def test_a_random_walk_is_held_with_the_variance_of_its_age() -> None:
    batch = EpisodeBatch.seeded(make(measurement_covariances=0.25, **WALK), 3, 0)
    for step in range(1, 9):
        state = batch.state.estimate
        assert state.prior_covariance == pytest.approx(0.25 + 0.3 * state.age[None])
        sent = np.array([[step % 3 == 0, False, True]])
        batch.step(sent)
        state = batch.delivered.estimate
        np.testing.assert_array_equal(state.mean, state.held[0])
        assert state.covariance == pytest.approx(0.25 + 0.3 * state.age[None])


@pytest.mark.parametrize("options", [{}, MIXED], ids=["default", "mixed"])
def test_the_covariance_is_the_mean_squared_error_under_a_schedule(options: dict[str, Any]) -> None:
    """Four deviations of 40,000 runs; the fused state is that of generalised least squares."""
    runs, task = 40_000, make(**options)
    batch = EpisodeBatch.seeded(task, runs, 0)
    sensors = task.plant.sensors  # type: ignore[attr-defined]
    deviation = sensors.deviation.reshape(-1, 1)
    rows = sensors.stacked_matrix[..., 0] / deviation
    for step in range(12):
        periods = 3 + np.arange(task.sensors)
        due = np.broadcast_to((step % periods == 0)[:, None], (task.sensors, runs))
        batch.step(due)
        state = batch.delivered.estimate
        held = state.held.reshape(-1, runs) / deviation
        expected = np.linalg.lstsq(rows, held, rcond=None)[0]
        np.testing.assert_allclose(state.mean, expected, atol=1e-12)
        error = batch.delivered.plant.truth - state.mean
        products = error[:, None] * error
        tolerance = 4.0 * products.std(-1) / runs**0.5
        assert (abs(products.mean(-1) - state.covariance[..., 0]) <= tolerance).all()
        assert np.ptp(state.covariance, axis=-1).max() < 1e-12


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"measurement_matrices": [[1.0, 0.0]]}, ("rank 1", "all 2 states")),
        ({"censoring_threshold": 0.0}, ("filter = 'hold'", "censored")),
        ({"fusion": "ci"}, ("fusion = 'ci'", "'hold'")),
        ({"memory": True, "packet": "estimate"}, ("packet", "holds values")),
    ],
)
def test_what_does_not_fit_is_refused(options: dict[str, Any], words: tuple[str, ...]) -> None:
    with pytest.raises(ConfigurationError) as error:
        make(**options)
    assert all(word in str(error.value) for word in words)
