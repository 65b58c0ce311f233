"""The node filters against FilterPy, quadrature and Joseph's form."""

import math
from typing import Any

import mpmath
import numpy as np
import pytest
from filter_problems import Array, Problem, outcomes, random_problem
from filterpy.kalman import KalmanFilter as FilterPyFilter

from fusion_gym.systems.tobit.filters import KalmanFilter
from fusion_gym.systems.tobit.sensors import CensoredSensors
from fusion_gym.systems.tobit.tobit_filter import TobitKalmanFilter

NEVER_CENSORED = -math.inf


# --- uncensored filters against FilterPy -------------------------------------------------------


def filterpy_filter(problem: Problem, sensor: int, lane: int) -> Any:
    states, size = problem.mean.shape[1], problem.sensors.size
    other = FilterPyFilter(dim_x=states, dim_z=size)
    other.x = problem.mean[sensor, :, lane][:, None].copy()
    other.P = problem.covariance[sensor, :, :, lane].copy()
    other.H = problem.sensors.measurement_matrix[sensor, :, :, 0]
    other.R = np.diag(problem.sensors.variance[sensor, :, 0])
    return other


@pytest.mark.parametrize("kind", [KalmanFilter, TobitKalmanFilter])
def test_twenty_uncensored_steps_are_filterpys(kind: Any) -> None:
    problem = random_problem(8, 2, 3, lanes=6, threshold=NEVER_CENSORED)
    generator = np.random.default_rng(9)
    transition = np.linalg.qr(generator.normal(size=(3, 3)))[0] * 0.98
    process = np.diag([0.1, 0.2, 0.0])
    node_filter = kind(problem.sensors)
    others = [[filterpy_filter(problem, s, lane) for lane in range(6)] for s in range(2)]
    mean, covariance = problem.mean, problem.covariance
    for _ in range(20):
        mean = np.einsum("ij,sjN->siN", transition, mean)
        covariance = np.einsum("ij,sjkN,lk->silN", transition, covariance, transition)
        covariance = covariance + process[..., None]
        value = generator.normal(scale=3.0, size=problem.value.shape)
        arrived = generator.random((2, 6)) < 0.6
        step = problem._replace(mean=mean, covariance=covariance, value=value)
        delivered, bound, silent, silent_bound = outcomes(node_filter, step)
        mean = np.where(arrived[:, None], delivered, silent)
        covariance = np.where(arrived[:, None, None], bound, silent_bound)
        for sensor in range(2):
            for lane in range(6):
                other = others[sensor][lane]
                other.predict(F=transition, Q=process)
                other.update(value[sensor, :, lane] if arrived[sensor, lane] else None)
                np.testing.assert_allclose(
                    mean[sensor, :, lane], other.x[:, 0], rtol=1e-10, atol=1e-10
                )
                np.testing.assert_allclose(
                    covariance[sensor, :, :, lane], other.P, rtol=1e-10, atol=1e-10
                )


def test_a_component_without_threshold_beside_a_censored_one() -> None:
    # With C and P diagonal the components do not touch: one is FilterPy's, the other stands alone.
    sensors = CensoredSensors.create(np.eye(2)[None], 0.5, (NEVER_CENSORED, 1.0), 2)
    mean, spread = np.array([[[-40.0], [0.7]]]), (np.eye(2) * 0.3)[None, ..., None]
    problem = Problem(sensors, mean, spread, np.zeros((1, 2, 1)), np.array([[[-40.5], [1.4]]]))
    delivered, bound, _, _ = outcomes(TobitKalmanFilter(sensors), problem)
    other = FilterPyFilter(dim_x=1, dim_z=1)
    other.x, other.P = np.array([[-40.0]]), np.array([[0.3]])
    other.H, other.R = np.eye(1), np.array([[0.5]])
    other.update(-40.5)
    assert delivered[0, 0, 0] == pytest.approx(other.x[0, 0], rel=1e-12)
    assert bound[0, 0, 0, 0] == pytest.approx(other.P[0, 0], rel=1e-12)
    lone = Problem(
        CensoredSensors.create([[[1.0]]], 0.5, 1.0, 1),
        *(value[:, 1:] for value in (mean, spread[:, :, 1:], problem.held, problem.value)),
    )
    lone_delivered, lone_bound, _, _ = outcomes(TobitKalmanFilter(lone.sensors), lone)
    assert delivered[0, 1] == pytest.approx(lone_delivered[0, 0], rel=1e-12)
    assert bound[0, 1, 1] == pytest.approx(lone_bound[0, 0, 0], rel=1e-12)
    assert bound[0, 1, 1, 0] > bound[0, 0, 0, 0]  # a censored component tells less


# --- the expectation against quadrature ----------------------------------------------------------


@pytest.mark.parametrize("latent", [-4.0, -1.3, 0.0, 0.4, 2.5, 9.0])
@pytest.mark.parametrize("threshold", [-1.0, 0.0, 0.75])
@pytest.mark.parametrize("variance", [0.09, 0.5, 4.0])
def test_expectation_is_that_of_the_censored_normal(
    latent: float, threshold: float, variance: float
) -> None:
    sensors = CensoredSensors.create([[[2.0]]], variance, threshold, 1)
    expectation = TobitKalmanFilter(sensors).expect(np.array([[[latent / 2.0]]]))
    result = {name: float(value[0, 0, 0]) for name, value in expectation._asdict().items()}
    with mpmath.workdps(30):
        root = mpmath.sqrt(variance)
        nearest = mpmath.mpf(max(latent, threshold))
        ends = [nearest + root * step for step in (0, 0.1, 0.2, 0.4, 0.8, 1.6, 4, 20)]
        ends = [threshold, *ends] if threshold < latent else ends

        def beyond(power: int, about: Any) -> Any:
            """∫ over y > τ of (y - about)^power times the density."""
            return mpmath.quad(lambda y: (y - about) ** power * mpmath.npdf(y, latent, root), ends)

        inside, censored = beyond(0, 0), mpmath.ncdf(threshold, latent, root)
        mean = censored * threshold + beyond(1, 0)
        total_variance = censored * (threshold - mean) ** 2 + beyond(2, mean)
        truncated_mean = beyond(1, 0) / inside
        truncated_variance = beyond(2, truncated_mean) / inside
        expected = {
            "latent": latent,
            "uncensored_probability": float(inside),
            "value": float(mean),
            "noise_variance": float(total_variance),
            "hazard": float((truncated_mean - latent) / root),
            "truncated_variance": float(truncated_variance / variance),
        }
    assert result == pytest.approx(expected, rel=1e-8, abs=1e-14)
    assert result["uncensored_probability"] == pytest.approx(float(inside), rel=1e-9, abs=0.0)


# --- Joseph form -------------------------------------------------------------------------------


def joseph(weighted: Array, covariance: Array, noise: Array) -> Array:
    gain = covariance @ weighted.T @ np.linalg.inv(weighted @ covariance @ weighted.T + noise)
    keep = np.eye(len(covariance)) - gain @ weighted
    return keep @ covariance @ keep.T + gain @ noise @ gain.T


@pytest.mark.parametrize("kind", [KalmanFilter, TobitKalmanFilter])
def test_posterior_equals_its_joseph_form(kind: Any) -> None:
    problem = random_problem(12, 2, 3, lanes=10, threshold=0.3)
    node_filter = kind(problem.sensors)
    expectation = node_filter.expect(problem.mean)
    posterior = outcomes(node_filter, problem)[1]
    for sensor in range(2):
        matrix = problem.sensors.measurement_matrix[sensor, :, :, 0]
        for lane in range(10):
            q = expectation.uncensored_probability[sensor, :, lane]
            v = expectation.truncated_variance[sensor, :, lane]
            expected = joseph(
                q[:, None] * matrix,
                problem.covariance[sensor, :, :, lane],
                np.diag(problem.sensors.variance[sensor, :, 0] * v),
            )
            result = posterior[sensor, :, :, lane]
            np.testing.assert_allclose(result, expected, rtol=1e-9, atol=1e-12)
            assert np.array_equal(result, result.T)
