"""The plant: its noise, its factors, its closed forms and what it refuses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

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


def test_channels_count_the_rank_of_the_noise() -> None:
    assert make().noise_channels == 1
    assert make(process_covariance=0.05 * np.eye(2)).noise_channels == 2
    assert make(process_covariance=np.zeros((2, 2))).noise_channels == 0
    assert make().size == 2


def monte_carlo_room(covariance: Any, draws: int) -> Any:
    """Five standard errors of each entry of an empirical covariance of normal draws."""
    variance = np.diagonal(covariance)
    return 5 * np.sqrt((np.outer(variance, variance) + covariance**2) / draws)


def test_process_noise_has_its_covariance() -> None:
    plant, draws = make(), 200_000
    noise = np.random.default_rng(0).normal(size=(1, draws))
    moved = plant.advance(np.zeros((2, draws)), noise)
    empirical = moved @ moved.T / draws
    assert np.all(np.abs(empirical - RANK_ONE) <= monte_carlo_room(RANK_ONE, draws))
    # One scalar noise: every draw lies along the gain, and both signs occur.
    assert np.abs(GAIN[1] * moved[0] - GAIN[0] * moved[1]).max() < 1e-15
    assert abs((moved[0] > 0).mean() - 0.5) < 5 * 0.5 / np.sqrt(draws)


def test_full_noise_and_initial_state_have_their_covariances() -> None:
    covariance = np.array([[0.5, -0.3], [-0.3, 0.9]])
    plant, draws = make(process_covariance=covariance), 200_000
    generator = np.random.default_rng(1)
    moved = plant.advance(np.zeros((2, draws)), generator.normal(size=(2, draws)))
    assert np.all(
        np.abs(moved @ moved.T / draws - covariance) <= monte_carlo_room(covariance, draws)
    )
    start = plant.start(np.array([[5.0], [0.0]]), generator.normal(size=(2, draws)))
    wanted = np.array(GOOD["initial_covariance"])
    centred = start - [[5.0], [0.0]]
    assert np.all(np.abs(centred.mean(1)) <= 5 * np.sqrt(np.diagonal(wanted) / draws))
    assert np.all(np.abs(centred @ centred.T / draws - wanted) <= monte_carlo_room(wanted, draws))


def test_the_monte_carlo_tolerance_would_notice_a_wrong_covariance() -> None:
    room = monte_carlo_room(RANK_ONE, 200_000)
    assert np.all(room < 0.02 * RANK_ONE)


def test_without_noise_the_state_is_rotated_only() -> None:
    state = np.array([[1.0, -2.0], [0.5, 3.0]])
    moved = make().advance(state, np.zeros((1, 2)))
    np.testing.assert_allclose(moved, TURN @ state, rtol=1e-15)


def test_prediction_is_the_formula() -> None:
    generator = np.random.default_rng(3)
    mean, factor = generator.normal(size=(2, 5)), generator.normal(size=(2, 3, 5))
    covariance = np.einsum("ikN,jkN->ijN", factor, factor)
    prior_mean, prior = make().predict(mean, covariance)
    np.testing.assert_allclose(prior_mean, TURN @ mean, rtol=1e-14)
    for run in range(5):
        wanted = TURN @ covariance[..., run] @ TURN.T + RANK_ONE
        np.testing.assert_allclose(prior[..., run], wanted, rtol=1e-13)


def test_open_loop_of_a_scalar_plant_is_a_geometric_sum() -> None:
    plant = LinearPlant.create([[0.9]], [[0.2]], [1.0], [[0.5]])
    ratio, horizon = 0.81, 30
    fixed = 0.2 / (1 - ratio)
    decaying = sum((0.5 - fixed) * ratio**t for t in range(1, horizon + 1))
    assert plant.open_loop(horizon) == pytest.approx([fixed + decaying / horizon], rel=1e-12)


def test_open_loop_of_a_rotation_grows_with_the_noise() -> None:
    # A rotation keeps traces: after t steps it is that of the start plus t times that of W.
    angle = 0.052 * np.pi
    rotation = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    plant = make(transition=rotation, initial_covariance=0.1 * np.eye(2))
    wanted = 0.2 + np.trace(RANK_ONE) * (100 + 1) / 2
    assert plant.open_loop(100).sum() == pytest.approx(wanted, rel=1e-12)
    assert plant.open_loop(100).sum() == pytest.approx(0.346, abs=5e-4)


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
        ({"transition": [1.0, 0.0]}, "transition", "shape"),
        ({"transition": [[1.0, np.nan], [0.0, 1.0]]}, "transition", "finite"),
        ({"transition": "rotation"}, "transition", "numbers"),
        ({"process_covariance": np.eye(3)}, "process_covariance", "shape"),
        ({"process_covariance": 0.05}, "process_covariance", "shape"),
        ({"process_covariance": [[1.0, 0.5], [0.0, 1.0]]}, "process_covariance", "symmetric"),
        ({"process_covariance": [[1.0, 2.0], [2.0, 1.0]]}, "process_covariance", "semi-definite"),
        ({"process_covariance": [[-1.0, 0.0], [0.0, 1.0]]}, "process_covariance", "semi-definite"),
        ({"process_covariance": np.diag([np.inf, 1.0])}, "process_covariance", "finite"),
        ({"initial_covariance": [[1.0, 1.0], [1.0, 1.0]]}, "initial_covariance", "definite"),
        ({"initial_covariance": [[1.0, 2.0], [2.0, 1.0]]}, "initial_covariance", "definite"),
        ({"initial_covariance": np.zeros((2, 2))}, "initial_covariance", "definite"),
        ({"initial_mean": [5.0]}, "initial_mean", "shape"),
        ({"initial_mean": [5.0, np.inf]}, "initial_mean", "finite"),
    ],
)
def test_bad_matrices_are_refused(change: dict[str, Any], field: str, reason: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        make(**change)
    message = str(refused.value)
    assert message.startswith(f"{field} = ")
    assert " is not allowed: it must be " in message
    assert reason in message


def test_a_plant_does_not_share_memory_with_its_arguments() -> None:
    transition = TURN.copy()
    plant = make(transition=transition)
    transition[:] = 0.0
    assert np.array_equal(plant.transition[..., 0], TURN)
