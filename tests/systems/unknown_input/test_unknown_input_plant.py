"""The lifted plant of the unknown-input system and its input signals.

Oracles: small steps one by one, definitions, samples.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import block_diag

from fusion_gym import linalg
from fusion_gym.systems.unknown_input.environment import UnknownInputOptions
from fusion_gym.systems.unknown_input.plant import (
    ArrayInput,
    InputSignal,
    MeanRevertingWalk,
    Sinusoids,
    Steps,
    UnknownInputPlant,
)

Array = NDArray[np.float64]


def random_plant(seed: int, n: int = 4, q: int = 2, period: int = 2) -> UnknownInputPlant:
    """A stable plant with random entries."""
    draw = np.random.default_rng(seed)
    transition = draw.normal(size=(n, n))
    transition *= 0.95 / np.abs(np.linalg.eigvals(transition)).max()
    root = draw.normal(size=(n, n))
    options = UnknownInputOptions(
        transition=transition,
        input_matrix=draw.normal(size=(n, q)),
        process_covariance=0.1 * root @ root.T,
        sampling_period=period,
        initial_mean=draw.normal(size=n),
        initial_covariance=0.5 * np.eye(n),
    )
    return UnknownInputPlant.create(options)


@given(st.integers(0, 10**6), st.integers(1, 4))
@settings(max_examples=25, deadline=None)
def test_a_sampling_interval_is_its_small_steps(seed: int, period: int) -> None:
    """Means from small steps one by one, the covariance from the stacked noises."""
    small, lifted = random_plant(seed, period=1), random_plant(seed, period=period)
    a, b = small.transition[..., 0], small.input_matrix[..., 0]
    draw = np.random.default_rng(seed)
    state, inputs = draw.normal(size=4), draw.normal(size=2)
    moved, effects = state, np.zeros((4, 0))
    for _ in range(period):
        moved = a @ moved + b @ inputs
        effects = np.concatenate((a @ effects, np.eye(4)), axis=1)
    noiseless = lifted.advance(
        state[:, None], inputs[:, None], np.zeros((lifted.noise_channels, 1))
    )
    np.testing.assert_allclose(noiseless[:, 0], moved, rtol=1e-10, atol=1e-12)
    noises = block_diag(*[small.process_covariance[..., 0]] * period)
    expected = effects @ noises @ effects.T
    np.testing.assert_allclose(lifted.process_covariance[..., 0], expected, rtol=1e-9, atol=1e-12)
    factor = lifted.process_factor[..., 0]
    np.testing.assert_allclose(factor @ factor.T, expected, rtol=1e-9, atol=1e-12)


SIGNALS: dict[str, InputSignal] = {
    "phases drawn": Sinusoids.create(2, ((0.8, 0.6), (0.5, 0.1)), ((30.0, 12.0), (20.0, 7.0))),
    "phases given": Sinusoids.create(2, 0.7, ((50.0,), (35.0,)), ((0.0,), (1.0,))),
    "steps": Steps.create(2, (0.7, 0.4), (8.0, 3.0)),
    "walk": MeanRevertingWalk.create(2, (0.7, 0.4), (8.0, 3.0)),
    "array": ArrayInput.create(2, np.random.default_rng(1).normal(size=(31, 2)), 30),
}


def simulate(signal: InputSignal, horizon: int, runs: int, seed: int) -> Array:
    """Inputs (horizon, q, runs)."""
    draw = np.random.default_rng(seed)
    memory = signal.start(draw.standard_normal((signal.start_channels, runs)))
    rows = []
    for k in range(horizon):
        rows.append(signal.value(memory, np.full(runs, float(k))))
        memory = signal.advance(memory, draw.standard_normal((signal.noise_channels, runs)))
    return np.array(rows)


@pytest.mark.parametrize("name", SIGNALS)
def test_moments_of_a_signal_are_those_of_its_samples(name: str) -> None:
    signal, horizon, runs = SIGNALS[name], 12, 20_000
    results = simulate(signal, horizon, runs, 3)
    mean, lags = signal.mean(horizon), signal.covariance(horizon)
    room = 5 * results.std(-1).max() / np.sqrt(runs) + 1e-12
    np.testing.assert_allclose(results.mean(-1), mean, rtol=0, atol=room)
    centred = results - mean[..., None]
    for first, lag in ((0, 0), (3, 0), (0, 1), (2, 5), (1, 10)):
        product = centred[first][:, None] * centred[first + lag][None]
        spread = 5 * product.std(-1).max() / np.sqrt(runs) + 1e-12
        np.testing.assert_allclose(product.mean(-1), lags[lag], rtol=0, atol=spread)


def test_signals_follow_their_definitions() -> None:
    k = np.arange(12)
    expected = 0.7 * np.array([np.sin(2 * np.pi * k / 50), np.sin(2 * np.pi * k / 35 + 1)])
    results = simulate(SIGNALS["phases given"], 12, 3, 0)
    np.testing.assert_allclose(results, np.repeat(expected.T[..., None], 3, -1), atol=1e-14)
    steps = simulate(SIGNALS["steps"], 400, 50, 0)
    moved = np.diff(steps, axis=0) != 0.0
    np.testing.assert_allclose(moved.mean((0, 2)), [1 / 8, 1 / 3], atol=0.015)
    array = SIGNALS["array"]
    rows_argument = array.mean(31)
    results = array.value(np.empty((0, 3)), np.array([0.0, 7.0, 99.0]))
    np.testing.assert_array_equal(results.T, rows_argument[[0, 7, 30]])


@pytest.mark.parametrize("name", SIGNALS)
@pytest.mark.parametrize("half_width", [None, 0.8])
def test_open_loop_and_magnitude_are_those_of_samples(name: str, half_width: float | None) -> None:
    signal, horizon, runs = SIGNALS[name], 12, 8000
    draw = np.random.default_rng(5)
    root = draw.normal(size=(3, 3))
    options = UnknownInputOptions(
        transition=0.8 * np.linalg.qr(root)[0],
        input_matrix=draw.normal(size=(3, 2)),
        process_covariance=0.05 * np.eye(3),
        initial_mean=(1.0, -0.5, 0.0),
        initial_covariance=0.4 * np.eye(3),
        initial_half_width=half_width,
    )
    plant = UnknownInputPlant.create(options)
    inputs = simulate(signal, horizon, runs, 6)
    state = plant.start(draw.standard_normal((3, runs)))
    if half_width is not None:
        assert np.abs(state - plant.initial_mean).max() <= half_width
    centre, errors, moments = plant.initial_mean, np.zeros((5, runs)), np.zeros((5, runs))
    for k in range(horizon):
        state = plant.advance(state, inputs[k], draw.standard_normal((plant.noise_channels, runs)))
        centre = linalg.matvec(plant.transition, centre)
        errors += np.concatenate((state - centre, inputs[k])) ** 2 / horizon
        moments += np.concatenate((state, inputs[k])) ** 2 / horizon
    for samples, closed in (
        (errors, plant.open_loop(signal, horizon)),
        (moments, plant.magnitude(signal, horizon) ** 2),
    ):
        room = 4.5 * samples.std(-1) / np.sqrt(runs) + 1e-12
        assert (np.abs(samples.mean(-1) - closed) <= room).all()
