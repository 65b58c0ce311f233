"""Plants whose covariances become singular: estimates against arithmetic of 50 digits."""

import itertools
from typing import Any

import mpmath
import numpy as np
import pytest
from parts import Parts
from reference_tobit import exact_float, exact_matrix

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.systems.tobit.tobit_filter import AssumedDensityFilter

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


def exact_run(task: Task, steps: int, rate: float) -> Any:
    """Mean and covariance of a run after each step, and the same in 50 digits."""
    batch, rng = EpisodeBatch.seeded(task, 1, 0), np.random.default_rng(0)
    plant, sensors = task.plant.dynamics, task.estimator.centre.sensors  # type: ignore[attr-defined]
    move, noise = (
        exact_matrix(matrix[..., 0]) for matrix in (plant.transition, plant.process_covariance)
    )
    centre = task.estimator.centre  # type: ignore[attr-defined]
    weight = getattr(centre.filter, "silence", None)
    exact_density = isinstance(centre.filter, AssumedDensityFilter)
    mean = exact_matrix(batch.state.estimate.mean[:, 0])
    covariance = exact_matrix(batch.state.estimate.covariance[..., 0])
    for _ in range(steps):
        state = batch.state.estimate
        granted = rng.random((sensors.count, 1)) < rate
        prior, believed = move * mean, exact_matrix(state.prior_mean[:, 0])
        mean, covariance = prior, move * covariance * move.T + noise
        expectation = state.prediction.expectation
        for sensor, part in np.ndindex(sensors.count, sensors.size):
            place = (sensor, part, 0)
            moments = expectation.uncensored_probability, expectation.truncated_variance
            q, v = (1.0, 1.0) if exact_density else (float(values[place]) for values in moments)
            row = q * exact_matrix(sensors.measurement_matrix[sensor, part, :, 0]).T
            spread = mpmath.mpf(float(sensors.variance[sensor, part, 0])) * v
            value = float(state.measurement[place]) - float(expectation.value[place])
            # What is expected moves with the mean, which differs by rounding.
            innovation = value + (row * (believed - prior))[0]
            if not granted[sensor, 0]:
                if weight is None:
                    continue
                spread, innovation = spread + 1 / mpmath.mpf(float(weight[sensor, 0])), 0
            cross = covariance * row.T
            variance = (row * cross)[0] + spread
            mean = mean + cross * ((innovation - (row * (mean - prior))[0]) / variance)
            covariance = covariance - cross * cross.T / variance
        batch.step(granted)
        yield (
            Parts.of(task).fused(batch.delivered),
            exact_float(mean)[:, 0],
            exact_float(covariance),
        )


@pytest.mark.parametrize("rate", [0.4, 1.0, 0.02])
@pytest.mark.parametrize("kind", FILTERS)
@pytest.mark.parametrize("plant", PLANTS)
def test_estimates_are_exact_where_covariances_become_singular(
    plant: str, kind: str, rate: float
) -> None:
    options = PLANTS[plant] | FILTERS[kind]
    task = fusion_gym.make_task(LINEAR, tokens="unlimited", horizon=100, **options)
    with mpmath.workdps(50):
        for (mean, covariance), exact_mean, exact in exact_run(task, 100, rate):
            deviation = np.sqrt(np.diagonal(exact))
            excess = np.abs(covariance[..., 0] - exact)
            assert (excess <= 1e-9 * np.outer(deviation, deviation)).all()
            assert (np.abs(mean[:, 0] - exact_mean) <= 1e-9 * deviation).all()


@pytest.mark.parametrize(
    ("filter_", "fusion"),
    [("adf", None), *itertools.product(("paper", "tobit", "kalman"), (None, "ci", "sici"))],
)
@pytest.mark.parametrize("threshold", [0.0, -np.inf])
@pytest.mark.parametrize(
    "transition", [HALF, [[0.5, 0.4], [0.1, 0.8]], [[0.0, 1.0], [0.0, 0.0]]], ids=str
)
def test_a_plant_that_decays_leaves_every_filter_finite(
    filter_: str, threshold: float, transition: Any, fusion: str | None
) -> None:
    """With process noise of rank one, over long silence and after it; errors keep the claim."""
    task = fusion_gym.make_task(
        TOBIT, filter=filter_, fusion=fusion, transition=transition, horizon=200,
        censoring_threshold=threshold, tokens="unlimited", process_variance=2.0,
    )  # fmt: skip
    batch, rng = EpisodeBatch.seeded(task, 10, 0), np.random.default_rng(0)
    claimed, squares = [], []
    for step in range(200):
        rate = 0.0 if step % 100 > 30 else 0.4
        outcome = batch.step(rng.random((3, 10)) < rate)
        mean, covariance = Parts.of(task).fused(batch.delivered)
        variances = np.einsum("iin->in", covariance)
        assert np.isfinite(mean).all()
        assert (variances >= 0.0).all()
        scale = np.sqrt(np.where(variances > 0.0, variances, 1.0))
        units = np.moveaxis(covariance / scale[:, None] / scale, -1, 0)
        assert np.linalg.eigvalsh(units).min() > -1e-13
        assert np.isfinite(batch.signals()["variance_reduction"]).all()
        claimed.append(variances)
        squares.append(outcome.error**2)
    if threshold == -np.inf:
        assert np.mean(squares) < 1.15 * np.mean(claimed)


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
