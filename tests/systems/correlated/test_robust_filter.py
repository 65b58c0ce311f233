"""Sensors that share the plant's noise, the robust filter, and the joint error covariance.

Oracles: dense block matrices, and samples.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fusion_gym.systems.correlated.environment import CorrelatedTrackingOptions
from fusion_gym.systems.correlated.filters import (
    CorrelatedSensors,
    JointErrorCovariance,
    RobustKalmanFilter,
)
from fusion_gym.systems.linear_plant import LinearPlant

Array = NDArray[np.float64]


def parts(
    transition: Array, gain: Array, process: Array, matrices: Array, variance: Any, coupling: Any
) -> tuple[LinearPlant, CorrelatedSensors]:
    """A plant with noise gain Γ and noise variances (r,), and its sensors."""
    n = len(transition)
    factor = gain * np.sqrt(process)
    plant = LinearPlant.create(transition, factor @ factor.T, np.zeros(n), np.eye(n))
    plant = replace(plant, process_factor=factor[..., None])
    options = CorrelatedTrackingOptions(
        measurement_matrices=matrices, measurement_variance=variance, noise_coupling=coupling
    )
    return plant, CorrelatedSensors.create(options, np.sqrt(process), plant)


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


# --- the joint error covariance ------------------------------------------------------------------


def walk(
    plant: LinearPlant, sensors: CorrelatedSensors, scale: float, seed: int, steps: int
) -> tuple[Array, Array, Array]:
    """Tracked and dense covariances, conservative local ones, under random deliveries.

    The fused estimate takes an arbitrary weighted mean with matrices that add up to I.
    """
    draw = np.random.default_rng(seed)
    node, tracker = RobustKalmanFilter(sensors), JointErrorCovariance.create(plant, sensors)
    n, count = plant.size, sensors.count
    covariance = np.tile(np.eye(n)[None, ..., None], (count, 1, 1, 1))
    joint = tracker.start(1)
    dense = scale * np.kron(np.ones((count + 1, count + 1)), np.eye(n))
    for _ in range(steps):
        _, covariance = plant.predict(np.zeros((count, n, 1)), covariance)
        outcomes = node.outcomes(covariance)
        granted = draw.random((count, 1)) < 0.5
        weights = draw.normal(size=(count + 1, n, n, 1)) * 0.3
        weights[0] = np.eye(n)[..., None] - weights[1:].sum(0)
        gain = np.where(granted[:, None, None], outcomes.gain, 0.0)
        covariance = np.where(granted[:, None, None], outcomes.delivered_covariance, covariance)
        joint = tracker.predict(joint)
        joint = tracker.fuse(tracker.update(joint, outcomes.gain, granted), weights)
        dense = dense_step(plant, sensors, dense, gain[..., 0], weights[..., 0], scale)
    blocks = dense.reshape(count + 1, n, count + 1, n).transpose(0, 2, 1, 3)
    return scale * joint[..., 0], blocks, covariance[..., 0]


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
        joint, dense, _ = walk(plant, sensors, scale, seed, steps=25)
        np.testing.assert_allclose(joint, dense, rtol=1e-8, atol=1e-10 * np.abs(dense).max())


def test_conservative_covariance_is_actual_at_the_bounds_and_above_it_below() -> None:
    """Theorem 1 for any deliveries that do not depend on the noise; of the best gain alone."""
    for seed in range(5):
        plant, sensors = random_parts(40 + seed)
        joint, _, conservative = walk(plant, sensors, 1.0, seed, steps=40)
        smaller, _, same = walk(plant, sensors, 0.4, seed, steps=40)
        np.testing.assert_array_equal(conservative, same)
        for node in range(3):
            own = joint[node + 1, node + 1]
            np.testing.assert_allclose(own, conservative[node], rtol=1e-7, atol=1e-9)
            gap = np.linalg.eigvalsh(conservative[node] - smaller[node + 1, node + 1])
            assert gap[0] > 0.0
