"""Gains, models, bound tables, fusion and trigger of the unknown-input system.

Oracles: plain matrices and loops, closed forms with explicit inverses, samples.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import null_space
from test_unknown_input_plant import random_plant

from fusion_gym import linalg
from fusion_gym.core.knowledge import Signals
from fusion_gym.fusion.several import CovarianceIntersection, covariance_intersection_many
from fusion_gym.policies.rules import AdaptiveThreshold
from fusion_gym.systems.unknown_input.environment import EXAMPLES, UnknownInputOptions
from fusion_gym.systems.unknown_input.filters import (
    BoundTables,
    InputModel,
    JointGain,
)
from fusion_gym.systems.unknown_input.nodes import NodeFusion, tracked_intersection
from fusion_gym.systems.unknown_input.plant import InputSensors, UnknownInputPlant
from fusion_gym.validation import ConfigurationError

Array = NDArray[np.float64]


def random_sensors(
    seed: int, plant: UnknownInputPlant, count: int = 3, size: int = 3
) -> InputSensors:
    draw = np.random.default_rng(seed)
    root = draw.normal(size=(count, size, size + 2))
    noise = 0.1 * root @ root.swapaxes(1, 2)
    matrices = draw.normal(size=(count, size, plant.size))
    options = UnknownInputOptions(measurement_matrices=matrices, measurement_covariance=noise)
    return InputSensors.create(options, plant)


def random_covariances(seed: int, shape: tuple[int, ...], n: int, runs: int) -> Array:
    root = np.random.default_rng(seed).normal(size=(*shape, n, n + 2, runs))
    return linalg.matmul(root, linalg.transpose(root))


# --- gains ---------------------------------------------------------------------------------------


def textbook_gain(
    plant: UnknownInputPlant, c: Array, phi: Array, noise: Array
) -> tuple[Array, Array]:
    """N and L with explicit inverses, as in the literature."""
    b = plant.input_matrix[..., 0]
    omega, observed = c @ phi @ c.T + noise, c @ b
    inverse = np.linalg.inv(omega)
    left = np.linalg.inv(observed.T @ inverse @ observed) @ observed.T @ inverse
    n = b @ left
    u = null_space(observed.T)
    if u.shape[1]:
        n = n + (phi @ c.T - b @ left @ omega) @ u @ np.linalg.inv(u.T @ omega @ u) @ u.T
    return n, left


@given(st.integers(0, 10**6), st.integers(1, 2), st.integers(2, 4))
@settings(max_examples=25, deadline=None)
def test_gain_hides_the_input_and_is_the_textbooks(seed: int, q: int, size: int) -> None:
    plant = random_plant(seed, q=q)
    sensors = random_sensors(seed + 1, plant, size=size)
    joint = JointGain.create(plant, sensors)
    phi = random_covariances(seed, (3,), 4, 2)
    gain = joint.gain(phi, sensors.covariance)
    observed = linalg.matmul(sensors.measurement_matrix, plant.input_matrix)
    through = linalg.matmul(gain, observed)
    scale = np.abs(gain).max()
    np.testing.assert_allclose(
        through[:, :4], np.broadcast_to(plant.input_matrix, through[:, :4].shape), atol=1e-9 * scale
    )
    np.testing.assert_allclose(
        through[:, 4:], np.broadcast_to(linalg.identity(q), through[:, 4:].shape), atol=1e-9 * scale
    )
    for sensor in range(3):
        n, left = textbook_gain(
            plant,
            sensors.measurement_matrix[sensor, ..., 0],
            phi[sensor, ..., 1],
            sensors.covariance[sensor, ..., 0],
        )
        expected = np.concatenate((n, left))
        np.testing.assert_allclose(gain[sensor, ..., 1], expected, rtol=1e-5, atol=1e-6 * scale)


def test_paper_gain_is_exact_to_rounding() -> None:
    """The paper's C ℬ is nearly singular; normal equations would leave a residual of 1e-7."""
    options = SimpleNamespace(sampling_period=2, **EXAMPLES["paper"])
    plant = UnknownInputPlant.create(options)
    sensors = InputSensors.create(options, plant)
    joint = JointGain.create(plant, sensors)
    gain = joint.gain(random_covariances(0, (2,), 2, 1), sensors.covariance)
    observed = linalg.matmul(sensors.measurement_matrix, plant.input_matrix)
    through = linalg.matmul(gain, observed)[..., 0]
    residual = through - np.concatenate((plant.input_matrix[..., 0], np.eye(2)))
    assert np.abs(residual).max() < 3e-11
    retention = linalg.identity(2) - linalg.matmul(gain[:, :2], sensors.measurement_matrix)
    assert np.abs(retention).max() < 1e-9  # N C = I: the estimate has no memory


# --- models and filters --------------------------------------------------------------------------


def test_bound_tables_have_their_radius_and_grow_by_silence() -> None:
    plant = random_plant(18, n=3, q=1)
    sensors = random_sensors(19, plant, count=2, size=3)
    epsilon = (0.3, 0.1)
    options = UnknownInputOptions(
        input_memory=0.9,
        input_change=0.3,
        input_deviation=0.7,
        rho_bar=(0.05, 0.2),
        young_factor=epsilon,
    )
    joint, model = JointGain.create(plant, sensors), InputModel.create(plant, options)
    tables = BoundTables.create(joint, model, options, 12)
    for sensor in range(2):
        observed = tables.gain[sensor, :3, ..., 12] @ sensors.measurement_matrix[sensor, ..., 0]
        moved = np.sqrt(1 + epsilon[sensor]) * (np.eye(3) - observed) @ plant.transition[..., 0]
        radius = np.abs(np.linalg.eigvals(moved)).max()
        assert tables.radius[sensor] == pytest.approx(radius, abs=0.02)
        smaller = tables.covariance[sensor] - tables.delivered[sensor]
        assert np.linalg.eigvalsh(np.moveaxis(smaller, -1, 0)).min() > -1e-9


# --- fusion --------------------------------------------------------------------------------------


@given(st.integers(0, 10**6), st.integers(2, 4), st.integers(2, 4))
@settings(max_examples=20, deadline=None)
def test_tracked_weights_give_covariance_intersection_and_reach_its_optimum(
    seed: int, nodes: int, n: int
) -> None:
    covariance = random_covariances(seed, (nodes,), n, 3)
    mean = np.random.default_rng(seed).normal(size=(nodes, n, 3))
    weights = np.full((nodes, 3), 1.0 / nodes)
    for _ in range(40):
        fused = tracked_intersection(mean, covariance, weights)
        assert fused.weights is not None
        weights = fused.weights
    np.testing.assert_allclose(weights.sum(0), 1.0, rtol=1e-12)
    assert (weights >= 0).all()
    for run in range(3):
        inverses = np.linalg.inv(covariance[..., run])
        total = np.linalg.inv((weights[:, run, None, None] * inverses).sum(0))
        np.testing.assert_allclose(fused.covariance[..., run], total, rtol=1e-7)
        vector = sum(weights[i, run] * inverses[i] @ mean[i, :, run] for i in range(nodes))
        np.testing.assert_allclose(fused.mean[:, run], total @ vector, rtol=1e-6, atol=1e-9)
    optimum = linalg.trace(covariance_intersection_many(mean, covariance).covariance)
    ratio = linalg.trace(fused.covariance) / optimum
    assert (ratio >= 1 - 1e-6).all()
    assert (ratio <= 1.02).all()


def test_state_and_input_are_fused_apart() -> None:
    covariance = random_covariances(20, (3,), 5, 4)
    mean = np.random.default_rng(21).normal(size=(3, 5, 4))
    fused = NodeFusion(CovarianceIntersection(), 4).fuse(mean, covariance)
    state = covariance_intersection_many(mean[:, :4], covariance[:, :4, :4])
    np.testing.assert_allclose(fused.mean[:4], state.mean, rtol=1e-12)
    np.testing.assert_allclose(fused.covariance[:4, :4], state.covariance, rtol=1e-12)
    best = covariance[:, 4, 4].argmin(0)
    np.testing.assert_allclose(fused.mean[4], mean[best, 4, np.arange(4)])
    np.testing.assert_allclose(fused.covariance[4, 4], covariance[:, 4, 4].min(0))
    assert not fused.covariance[:4, 4].any()
    np.testing.assert_allclose(np.einsum("lijN,ljN->iN", fused.gains, mean), fused.mean, rtol=1e-9)


# --- trigger -------------------------------------------------------------------------------------


def signals(measurement: Array, held: Array, start: bool) -> Signals:
    sensors, _, runs = measurement.shape
    return Signals(
        {
            "measurement": measurement,
            "held": held,
            "start": np.full(runs, start),
            "step": np.zeros(runs),
            "tokens": np.zeros(runs),
            "token_cost": np.ones((sensors, 1)),
        }
    )


def test_adaptive_threshold_is_the_papers_recursion_and_keeps_its_promise() -> None:
    draw = np.random.default_rng(22)
    limit, first, adaptation = (0.5, 0.8), (0.1, 0.0), 0.3
    trigger = AdaptiveThreshold(limit, first, adaptation)
    trigger.reset(3)
    held, rho = np.zeros((2, 2, 3)), np.repeat(np.array(first)[:, None], 3, 1)
    sent = 0
    for step in range(30):
        if step == 15:  # a new episode
            rho = np.repeat(np.array(first)[:, None], 3, 1)
        measurement = held + 0.4 * draw.normal(size=held.shape)
        request = trigger(signals(measurement, held, step in (0, 15)))
        for sensor in range(2):
            for run in range(3):
                sigma = measurement[sensor, :, run] - held[sensor, :, run]
                square = sigma @ sigma
                assert request[sensor, run] == (square > rho[sensor, run])
                if not request[sensor, run]:
                    assert square <= limit[sensor]
                share = square / (adaptation + square)
                new = limit[sensor] + share * (rho[sensor, run] - limit[sensor])
                assert new >= rho[sensor, run]
                rho[sensor, run] = new
        held = np.where(request[:, None], measurement, held)
        sent += int(request.sum())
    assert 30 < sent < 150


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"rho_bar": 0.05, "rho_initial": 0.06}, r"rho_initial = 0.06 .* <= rho_bar = 0.05"),
        ({"rho_bar": (0.1, 0.2), "rho_initial": (0.1, 0.1, 0.1)}, "rho_initial"),
    ],
)
def test_thresholds_that_are_not_allowed(parameters: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        AdaptiveThreshold(**parameters)
