"""Sensors that share the plant's noise, the robust filter, and the joint error covariance.

Oracles: FilterPy, conditioning of a joint Gaussian, the Lyapunov form of the paper, dense block
matrices, and samples.
"""

from dataclasses import replace
from typing import Any

import filterpy.kalman
import numpy as np
import pytest
from numpy.typing import NDArray

from fusion_gym.systems.correlated.filters import (
    CorrelatedSensors,
    JointErrorCovariance,
    RobustKalmanFilter,
)
from fusion_gym.systems.linear_plant import LinearPlant

Array = NDArray[np.float64]
T = 0.01
PHI = np.array([[1, T, T * T / 2], [0, 1, T], [0, 0, 1]])
GAMMA = np.array([[T * T / 2], [T], [1.0]])
ETA = np.array([0.64, 0.36, 0.49])
BETA = np.array([0.2, 0.4, 0.1])


def parts(
    transition: Array, gain: Array, process: Array, matrices: Array, variance: Any, coupling: Any
) -> tuple[LinearPlant, CorrelatedSensors]:
    """A plant with noise gain Γ and noise variances (r,), and its sensors."""
    n = len(transition)
    factor = gain * np.sqrt(process)
    plant = LinearPlant.create(transition, factor @ factor.T, np.zeros(n), np.eye(n))
    plant = replace(plant, process_factor=factor[..., None])
    return plant, CorrelatedSensors.create(matrices, variance, coupling, np.sqrt(process), plant)


def paper_parts(coupling: Any = BETA) -> tuple[LinearPlant, CorrelatedSensors]:
    return parts(PHI, GAMMA, np.array([0.16]), np.eye(3)[:, None], ETA, coupling)


def random_parts(
    seed: int, n: int = 4, r: int = 2, sensors: int = 3, m: int = 2
) -> tuple[LinearPlant, CorrelatedSensors]:
    """A stable plant and sensors of several components, all entries random."""
    draw = np.random.default_rng(seed)
    transition = draw.normal(size=(n, n))
    transition *= 0.9 / np.abs(np.linalg.eigvals(transition)).max()
    return parts(
        transition,
        draw.normal(size=(n, r)),
        draw.uniform(0.1, 1.0, r),
        draw.normal(size=(sensors, m, n)),
        draw.uniform(0.2, 1.0, (sensors, m)),
        draw.normal(size=(sensors, m, r)),
    )


def random_covariances(seed: int, sensors: int, n: int, runs: int) -> Array:
    root = np.random.default_rng(seed).normal(size=(sensors, n, n + 2, runs))
    return np.einsum("sijr,skjr->sikr", root, root)


# --- sensors -----------------------------------------------------------------------------------


def test_measured_noises_have_the_stated_covariances() -> None:
    plant, sensors = random_parts(5)
    runs = 400_000
    draw = np.random.default_rng(3)
    process = draw.standard_normal((plant.noise_channels, runs))
    own = draw.standard_normal((sensors.noise_channels, runs))
    state = draw.standard_normal((plant.size, runs))
    moved = plant.advance(np.zeros((plant.size, runs)), process)
    noise = sensors.measure(state, process, own)
    noise -= np.einsum("smn,nr->smr", sensors.measurement_matrix[..., 0], state)
    joint = np.cov(np.concatenate((moved, noise.reshape(-1, runs))))
    cross = sensors.cross_covariance[..., 0].transpose(1, 0, 2).reshape(plant.size, -1)
    own_part = sensors.covariance[..., 0].transpose(0, 2, 1, 3).reshape(sensors.noise_channels, -1)
    expected = np.block([[plant.process_covariance[..., 0], cross], [cross.T, own_part]])
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert (np.abs(joint - expected) / scale).max() <= 5 * np.sqrt(2 / runs)


# --- the filter ----------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1, 2, 3])
def test_update_agrees_with_filterpys_correlated_update(size: int) -> None:
    plant, sensors = random_parts(size, m=size)
    node = RobustKalmanFilter(sensors)
    covariance = random_covariances(size, 3, plant.size, 6)
    mean = np.random.default_rng(1).normal(size=(3, plant.size, 6))
    measurement = np.random.default_rng(2).normal(size=(3, size, 6))
    outcomes, expected = node.outcomes(covariance), node.expect(mean)
    for sensor in range(3):
        for run in range(6):
            other = filterpy.kalman.KalmanFilter(dim_x=plant.size, dim_z=size)
            other.x, other.P = mean[sensor, :, run].copy(), covariance[sensor, ..., run].copy()
            other.H = sensors.measurement_matrix[sensor, ..., 0]
            other.R = sensors.covariance[sensor, sensor, ..., 0]
            other.M = sensors.cross_covariance[sensor, ..., 0]
            other.update_correlated(measurement[sensor, :, run])
            gain = outcomes.gain[sensor, ..., run]
            innovation = measurement[sensor, :, run] - expected[sensor, :, run]
            np.testing.assert_allclose(gain, other.K, rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(
                mean[sensor, :, run] + gain @ innovation, other.x, rtol=1e-9, atol=1e-12
            )
            np.testing.assert_allclose(
                outcomes.delivered_covariance[sensor, ..., run], other.P, rtol=1e-8, atol=1e-10
            )


# --- the joint error covariance ------------------------------------------------------------------


def walk(
    plant: LinearPlant, sensors: CorrelatedSensors, scale: float, seed: int, steps: int, runs: int
) -> tuple[Array, Array, Array, Array]:
    """Errors, tracked and dense covariances, conservative local ones, under random deliveries.

    The fused estimate takes an arbitrary weighted mean with matrices that add up to I. Deliveries
    and weights are the same in all runs, so that samples over runs meet the covariances.
    """
    draw = np.random.default_rng(seed)
    node, tracker = RobustKalmanFilter(sensors), JointErrorCovariance.create(plant, sensors)
    n, count = plant.size, sensors.count
    truth = np.sqrt(scale) * draw.standard_normal((n, runs))
    mean = np.zeros((count + 1, n, runs))
    covariance = np.tile(np.eye(n)[None, ..., None], (count, 1, 1, 1))
    joint = tracker.start(1)
    dense = scale * np.kron(np.ones((count + 1, count + 1)), np.eye(n))
    for _ in range(steps):
        process = np.sqrt(scale) * draw.standard_normal((plant.noise_channels, runs))
        own = np.sqrt(scale) * draw.standard_normal((sensors.noise_channels, runs))
        truth = plant.advance(truth, process)
        measurement = sensors.measure(truth, process, own)
        mean = np.einsum("ij,sjr->sir", plant.transition[..., 0], mean)
        _, covariance = plant.predict(np.zeros((count, n, 1)), covariance)
        outcomes = node.outcomes(covariance)
        granted = draw.random((count, 1)) < 0.5
        weights = draw.normal(size=(count + 1, n, n, 1)) * 0.3
        weights[0] = np.eye(n)[..., None] - weights[1:].sum(0)
        gain = np.where(granted[:, None, None], outcomes.gain, 0.0)
        mean[1:] += np.einsum("sim,smr->sir", gain[..., 0], measurement - node.expect(mean[1:]))
        mean[0] = np.einsum("sij,sjr->ir", weights[..., 0], mean)
        covariance = np.where(granted[:, None, None], outcomes.delivered_covariance, covariance)
        joint = tracker.predict(joint)
        joint = tracker.fuse(tracker.update(joint, outcomes.gain, granted), weights)
        dense = dense_step(plant, sensors, dense, gain[..., 0], weights[..., 0], scale)
    blocks = dense.reshape(count + 1, n, count + 1, n).transpose(0, 2, 1, 3)
    return (truth - mean).reshape(-1, runs), scale * joint[..., 0], blocks, covariance[..., 0]


def dense_step(
    plant: LinearPlant,
    sensors: CorrelatedSensors,
    joint: Array,
    gain: Array,
    weights: Array,
    scale: float,
) -> Array:
    """One step of the joint recursion with plain matrices and independent normals as noise."""
    n, r, count, m = plant.size, plant.noise_channels, sensors.count, sensors.size
    every = np.arange(n * (count + 1)).reshape(count + 1, n)
    moving = np.kron(np.eye(count + 1), plant.transition[..., 0])
    noise = np.zeros((n * (count + 1), r + count * m))
    for estimate in range(count + 1):
        noise[every[estimate], :r] = plant.process_factor[..., 0]
    for node in range(count):
        rows, own = every[node + 1], r + m * node + np.arange(m)
        retention = np.eye(n) - gain[node] @ sensors.measurement_matrix[node, ..., 0]
        moving[rows] = retention @ moving[rows]
        noise[rows] = retention @ noise[rows]
        noise[rows, :r] -= gain[node] @ sensors.coupling[node, ..., 0]
        noise[np.ix_(rows, own)] -= gain[node] * sensors.deviation[node, :, 0]
    joined = np.eye(n * (count + 1))
    joined[:n] = np.hstack(list(weights))
    moving, noise = joined @ moving, joined @ noise
    result: Array = moving @ joint @ moving.T + scale * noise @ noise.T
    return result


@pytest.mark.parametrize("scale", [1.0, 0.4])
def test_joint_covariance_agrees_with_dense_matrices(scale: float) -> None:
    for seed in range(4):
        plant, sensors = random_parts(30 + seed)
        _, joint, dense, _ = walk(plant, sensors, scale, seed, steps=25, runs=1)
        np.testing.assert_allclose(joint, dense, rtol=1e-8, atol=1e-10 * np.abs(dense).max())


def test_joint_covariance_is_that_of_the_errors() -> None:
    plant, sensors = paper_parts()
    runs = 40_000
    errors, joint, _, _ = walk(plant, sensors, 0.6, 7, steps=15, runs=runs)
    flat = joint.transpose(0, 2, 1, 3).reshape(12, 12)
    scale = np.sqrt(np.outer(np.diag(flat), np.diag(flat)))
    assert (np.abs(np.cov(errors) - flat) / scale).max() <= 5 * np.sqrt(2 / runs)
    # Without the common noise of the measurements the same samples would not fit.
    _, ignoring, _, _ = walk(*paper_parts(coupling=0.0), 0.6, 7, steps=15, runs=1)
    other = ignoring.transpose(0, 2, 1, 3).reshape(12, 12)
    assert (np.abs(np.cov(errors) - other) / scale).max() > 5 * np.sqrt(2 / runs)


def test_conservative_covariance_is_actual_at_the_bounds_and_above_it_below() -> None:
    """Theorem 1 for any deliveries that do not depend on the noise."""
    for seed in range(5):
        plant, sensors = random_parts(40 + seed)
        _, joint, _, conservative = walk(plant, sensors, 1.0, seed, steps=40, runs=1)
        _, smaller, _, same = walk(plant, sensors, 0.4, seed, steps=40, runs=1)
        np.testing.assert_array_equal(conservative, same)
        for node in range(3):
            own = joint[node + 1, node + 1]
            np.testing.assert_allclose(own, conservative[node], rtol=1e-7, atol=1e-9)
            gap = np.linalg.eigvalsh(conservative[node] - smaller[node + 1, node + 1])
            assert gap[0] > 0.0
