"""Filters of censored sensors after long silence and from priors far larger than the noise."""

from typing import Any

import mpmath
import numpy as np
import pytest
from numpy.typing import NDArray
from parts import Parts
from reference_tobit import exact_float, exact_matrix

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch

TOBIT = "fusion_gym/TobitOscillator-v1"
Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


def follow(
    requests: Flags, seed: int = 0, **options: Any
) -> tuple[list[Any], list[tuple[Array, Array]]]:
    """Estimates after sensing, mean and covariance after each delivery, of (T, sensors, N)."""
    steps, _, runs = requests.shape
    task = fusion_gym.make_task(TOBIT, tokens="unlimited", horizon=steps + 1, **options)
    batch = EpisodeBatch.seeded(task, runs, seed)
    states, result = [], []
    for request in requests:
        states.append(batch.state.estimate)
        batch.step(request)
        result.append(Parts.of(task).fused(batch.delivered))
    return states, result


def smallest(covariance: Array) -> Array:
    """Smallest eigenvalue of the correlations (N,) of (n, n, N)."""
    matrices = np.moveaxis(covariance, -1, 0)
    scale = np.sqrt(np.einsum("rii->ri", matrices))
    result: Array = np.linalg.eigvalsh(matrices / scale[:, :, None] / scale[:, None])[:, 0]
    return result


def sparse_requests(runs: int) -> Flags:
    """Requests (250, 3, runs) of one step in fifty, always the same."""
    return np.random.default_rng(5).random((250, 3, 400))[..., :runs] < 0.02


def test_long_silence_leaves_estimates_and_covariances_sound() -> None:
    """Where P - P Cᵀ S⁻¹ C P loses all its digits: in 10 of these 200 runs."""
    _, result = follow(sparse_requests(200))
    for mean, covariance in result:
        assert np.isfinite(mean).all()
        assert smallest(covariance).min() > 0.0


MATRICES = np.array([[[1.0, 0.3], [-0.2, 1.0]], [[1.0, -2.3], [0.2, 1.0]]])
UNKNOWN = {
    "initial_covariance": ((1e10, 9.9e9), (9.9e9, 1e10)),
    "measurement_matrices": MATRICES,
    "measurement_variance": 1e4,
}


@pytest.mark.parametrize("kind", ["paper", "tobit", "kalman", "adf"])
@pytest.mark.parametrize("pattern", ["both", "in turn"])
def test_a_prior_of_any_size_beside_any_noise(kind: str, pattern: str) -> None:
    """P₀ is 10⁶ times R."""
    requests = np.ones((40, 2, 50), dtype=np.bool_)
    if pattern == "in turn":
        requests[::2, 0] = requests[1::2, 1] = False
    _, result = follow(requests, filter=kind, **UNKNOWN)
    for mean, covariance in result:
        assert np.isfinite(mean).all()
        assert smallest(covariance).min() > -1e-12


@pytest.mark.parametrize("kind", ["tobit", "kalman", "adf"])
def test_the_first_look_from_an_unknown_start(kind: str) -> None:
    """Uncensored, all three are the Kalman filter; here against its information form."""
    requests = np.ones((1, 2, 5), dtype=np.bool_)
    options = UNKNOWN | {"filter": kind, "censoring_threshold": -np.inf}
    states, result = follow(requests, **options)
    for run in range(5):
        with mpmath.workdps(60):
            information = exact_matrix(states[0].prior_covariance[..., run]) ** -1
            total = information * exact_matrix(states[0].prior_mean[:, run])
            for matrix, value in zip(MATRICES, states[0].measurement[..., run], strict=True):
                weight = exact_matrix(matrix).T / 10**4
                information += weight * exact_matrix(matrix)
                total += weight * exact_matrix(value)
            exact = information**-1
            expected = exact_float(exact * total)[:, 0]
        mean, covariance = (values[..., run] for values in result[0])
        np.testing.assert_allclose(covariance, exact_float(exact), rtol=1e-9)
        np.testing.assert_allclose(mean, expected, rtol=1e-9)
