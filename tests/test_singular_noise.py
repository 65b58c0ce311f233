"""Plants whose covariances become singular: estimates against arithmetic of 50 digits."""

from typing import Any

import mpmath
import numpy as np
import pytest
from reference_tobit import exact_float, exact_matrix

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task

TOBIT = "fusion_gym/TobitOscillator-v1"
TRACKING = "fusion_gym/BiasedTracking-v1"
LINEAR = "fusion_gym/LinearFusion-v1"
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
    "stochastic": {"filter": "stochastic", "stochastic_weight": [0.0, 3.0]},
    "joint": {"filter": "joint"},
    "adf": {"filter": "adf"},
}


def exact_run(task: Task, steps: int, rate: float) -> Any:
    """Mean and covariance of a run after each step, and the same in 50 digits."""
    batch, rng = EpisodeBatch.seeded(task, 1, 0), np.random.default_rng(0)
    plant, sensors = task.system.plant, task.system.centre.sensors  # type: ignore[attr-defined]
    move, noise = (
        exact_matrix(matrix[..., 0]) for matrix in (plant.transition, plant.process_covariance)
    )
    weight = getattr(getattr(task.system.centre, "filter", None), "silence", None)  # type: ignore[attr-defined]
    # The first state that is known in digits is that after the first measurements.
    start = task.system.fused(task.system.start(np.zeros((task.system.start_channels, 1))))[1]
    covariance, mean = exact_matrix(start[..., 0]), None
    for _ in range(steps):
        state = batch.state
        granted = rng.random((sensors.count, 1)) < rate
        if mean is None:
            prior = exact_matrix(state.prior_mean[:, 0])
        else:
            prior = move * mean
        covariance = move * covariance * move.T + noise
        mean, batch_mean = prior, exact_matrix(state.prior_mean[:, 0])
        expectation = state.prediction.expectation
        for sensor, part in np.ndindex(sensors.count, sensors.size):
            place = (sensor, part, 0)
            q, v = expectation.uncensored_probability[place], expectation.truncated_variance[place]
            if "Assumed" in type(task.system.centre.filter).__name__:  # type: ignore[attr-defined]
                q, v = 1.0, 1.0
            row = q * exact_matrix(sensors.measurement_matrix[sensor, part, :, 0]).T
            spread = mpmath.mpf(float(sensors.variance[sensor, part, 0])) * v
            value = state.measurement[place] - expectation.value[place]
            # What is expected moves with the mean; the small difference is that of rounding.
            innovation = value + (row * (batch_mean - prior))[0]
            if not granted[sensor, 0]:
                if weight is None or not weight[sensor, 0]:
                    continue
                spread, innovation = spread + 1 / mpmath.mpf(float(weight[sensor, 0])), 0
            cross = covariance * row.T
            variance = (row * cross)[0] + spread
            mean = mean + cross * ((innovation - (row * (mean - prior))[0]) / variance)
            covariance = covariance - cross * cross.T / variance
        batch.step(granted)
        yield task.system.fused(batch.delivered), exact_float(mean)[:, 0], exact_float(covariance)


@pytest.mark.parametrize("rate", [0.4, 1.0, 0.02])
@pytest.mark.parametrize("kind", FILTERS)
@pytest.mark.parametrize("plant", PLANTS)
def test_estimates_are_exact_where_covariances_become_singular(
    plant: str, kind: str, rate: float
) -> None:
    options = PLANTS[plant] | FILTERS[kind]
    task = fusion_gym.make_task(LINEAR, tokens="unlimited", horizon=250, **options)
    with mpmath.workdps(50):
        for (mean, covariance), exact_mean, exact in exact_run(task, 200, rate):
            deviation = np.sqrt(np.diagonal(exact))
            excess = np.abs(covariance[..., 0] - exact)
            assert (excess <= 1e-9 * np.outer(deviation, deviation)).all()
            assert (np.abs(mean[:, 0] - exact_mean) <= 1e-7 * deviation + 1e-300).all()
