"""The plant: its noise, its factors, its closed forms and what it refuses."""

import warnings
from typing import Any

import numpy as np
import pytest

import fusion_gym
from fusion_gym import ConfigurationError
from fusion_gym.systems.linear_plant import LinearPlant, covariance_factor

TURN = np.array([[0.8, 0.5], [-0.5, 0.8]])
GAIN = np.array([0.16, 0.18])
RANK_ONE = 0.05 * np.outer(GAIN, GAIN)
GOOD: dict[str, Any] = {
    "transition": TURN,
    "process_covariance": RANK_ONE,
    "initial_mean": [5.0, 0.0],
    "initial_covariance": [[0.1, 0.02], [0.02, 0.3]],
}


def make(**change: Any) -> LinearPlant:
    return LinearPlant.create(**(GOOD | change))


@pytest.mark.parametrize(
    ("matrix", "rank"),
    [
        (RANK_ONE, 1),
        (np.diag([0.05, 0.05]), 2),
        (np.zeros((3, 3)), 0),
        (np.diag([1e-6, 0.0, 1e6]), 2),
        (1e-20 * RANK_ONE, 1),
        (np.array([[2.0, 1.0, 3.0], [1.0, 2.0, 3.0], [3.0, 3.0, 6.0]]), 2),
        ([[4.0]], 1),
    ],
)
def test_factor_has_the_rank_and_the_square(matrix: Any, rank: int) -> None:
    matrix = np.asarray(matrix)
    factor = covariance_factor(matrix)
    assert factor.shape == (len(matrix), rank)
    np.testing.assert_allclose(factor @ factor.T, matrix, rtol=1e-12, atol=1e-14 * matrix.max())


def test_factor_has_the_rank_that_rounding_hides() -> None:
    draw = np.random.default_rng(0)
    for dt in 10.0 ** draw.uniform(-4, 2, 500):
        for size in (2, 3):
            gain = np.array([dt**3 / 6, dt**2 / 2, dt][-size:])
            noise = draw.uniform(0.01, 10) * np.array([[a * b for a in gain] for b in gain])
            moved = np.diag(10.0 ** draw.uniform(-3, 3, size))
            assert covariance_factor(moved @ noise @ moved).shape == (size, 1), (dt, size)
    acceleration = [covariance_factor(np.array([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]]))
                    for dt in 10.0 ** draw.uniform(-4, 2, 500)]  # fmt: skip
    assert {factor.shape for factor in acceleration} == {(2, 1)}


def test_factor_follows_the_unit_of_each_state() -> None:
    """Bitwise for powers of two; a genuine direction stays however small its unit makes it."""
    draw = np.random.default_rng(1)
    for size in (1, 2, 3, 5, 20):
        for rank in {1, size // 2 + 1, size}:
            gain = draw.normal(size=(size, rank))
            matrix = gain @ gain.T
            factor = covariance_factor((matrix + matrix.T) / 2)
            by = 2.0 ** draw.integers(-30, 30, size)
            other = covariance_factor((matrix + matrix.T) / 2 * np.outer(by, by))
            assert factor.shape == (size, rank)
            np.testing.assert_array_equal(factor * by[:, None], other)


def monte_carlo_room(covariance: Any, draws: int) -> Any:
    """Five standard errors of each entry of an empirical covariance of normal draws."""
    variance = np.diagonal(covariance)
    return 5 * np.sqrt((np.outer(variance, variance) + covariance**2) / draws)


def test_full_noise_and_initial_state_have_their_covariances() -> None:
    covariance = np.array([[0.5, -0.3], [-0.3, 0.9]])
    plant, draws = make(process_covariance=covariance), 200_000
    generator = np.random.default_rng(1)
    moved = plant.advance(np.zeros((2, draws)), generator.normal(size=(2, draws)))
    assert np.all(
        np.abs(moved @ moved.T / draws - covariance) <= monte_carlo_room(covariance, draws)
    )
    start = plant.start(np.array([[5.0], [0.0]]), generator.normal(size=(2, draws)))
    target = np.array(GOOD["initial_covariance"])
    centred = start - [[5.0], [0.0]]
    assert np.all(np.abs(centred.mean(1)) <= 5 * np.sqrt(np.diagonal(target) / draws))
    assert np.all(np.abs(centred @ centred.T / draws - target) <= monte_carlo_room(target, draws))


def test_open_loop_is_what_simulation_gives() -> None:
    plant, runs, horizon = make(), 50_000, 12
    generator = np.random.default_rng(5)
    state = plant.start(np.zeros((2, 1)), generator.normal(size=(2, runs)))
    squared = np.zeros((2, runs))
    for _ in range(horizon):
        state = plant.advance(state, generator.normal(size=(1, runs)))
        squared += state**2 / horizon
    room = 5 * squared.std(axis=1) / np.sqrt(runs)
    assert np.all(np.abs(squared.mean(1) - plant.open_loop(horizon)) <= room)
    assert np.all(room < 0.05 * plant.open_loop(horizon))


@pytest.mark.parametrize(
    ("change", "field", "reason"),
    [
        ({"transition": [[1.0, 0.0]]}, "transition", "shape"),
        ({"process_covariance": [[1.0, 0.5], [0.0, 1.0]]}, "process_covariance", "symmetric"),
        ({"process_covariance": [[1.0, 2.0], [2.0, 1.0]]}, "process_covariance", "semi-definite"),
        ({"initial_covariance": [[1.0, 1.1], [1.1, 1.0]]}, "initial_covariance", "semi-definite"),
    ],
)
def test_bad_matrices_are_refused(change: dict[str, Any], field: str, reason: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        make(**change)
    message = str(refused.value)
    assert message.startswith(f"{field} = ")
    assert " is not allowed: it must be " in message
    assert reason in message


@pytest.mark.parametrize("angle", [0.0, 0.3])
@pytest.mark.parametrize(("pole", "seen"), [(1.2, 0.0), (1.2, 1e-3), (0.99, 0.0), (1.0, 0.0)])
def test_a_growing_state_that_nobody_measures_gets_a_warning(
    pole: float, seen: float, angle: float
) -> None:
    """Also as a direction across states, in units far apart."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turn = np.diag([1.0, 1e6]) @ turn
    back = np.linalg.inv(turn)
    options = {
        "transition": turn @ np.diag([0.9, pole]) @ back,
        "process_covariance": turn @ turn.T,
        "measurement_matrices": [[1.0, seen] @ back],
        "reward_scale": None,
    }
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        fusion_gym.make_task("fusion_gym/LinearFusion-v2", horizon=30, **options)
    messages = [str(item.message) for item in warned if "no sensor measures" in str(item.message)]
    assert bool(messages) == (pole > 1.0 and seen == 0.0)
    assert all("grows by 1.2 a step" in message for message in messages)
    assert angle or all("'x2'" in message for message in messages)
