"""What each packet alone would do, all at once: the same as one delivery after another."""

from typing import Any

import numpy as np
import pytest
from parts import Parts

import fusion_gym
from fusion_gym import linalg
from fusion_gym.arrays import Array, take_runs
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task

MANY, STATES = 8, 4


def task_of(**options: Any) -> Task:
    rng = np.random.default_rng(3)
    transition = 0.3 * rng.normal(size=(STATES, STATES))
    return fusion_gym.make_task(
        "fusion_gym/LinearFusion-v2",
        transition=transition.tolist(),
        process_covariance=(0.2 * np.eye(STATES)).tolist(),
        measurement_matrices=rng.normal(size=(MANY, 2, STATES)).tolist(),
        token_rate=12.0,
        **options,
    )


def sensed(task: Task, runs: int) -> Any:
    """A state after some steps of random requests, from the same noise for any number of runs."""
    batch, rng = EpisodeBatch.seeded(task, 6, 0), np.random.default_rng(1)
    for _ in range(5):
        batch.step(rng.random((MANY, 6)) < 0.3)
    return take_runs(batch.state, np.arange(runs))


def one_by_one(task: Task, state: Any) -> tuple[Array, Array]:
    runs = task.plant.truth(state.plant).shape[-1]
    parts, value = Parts.of(task), []
    for sensor in range(task.sensors):
        single = np.zeros((task.sensors, runs), dtype=np.bool_)
        single[sensor] = True
        value.append(parts.fused(parts.deliver(state, single)))
    return np.array([mean for mean, _ in value]), np.array([covariance for _, covariance in value])


KINDS: dict[str, dict[str, Any]] = {
    "kalman": {},
    "tobit": {"filter": "tobit", "censoring_threshold": -0.5},
    "stochastic": {"filter": "stochastic", "stochastic_weight": 0.5},
    "shares": {"information_shares": np.arange(1.0, MANY + 1.0) / 36.0},
}


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("runs", [1, 6])
def test_all_at_once_is_bitwise_one_after_another(name: str, runs: int) -> None:
    task = task_of(**KINDS[name])
    expected = one_by_one(task, sensed(task, runs))
    result = task.estimator.single_deliveries(sensed(task, runs).estimate)
    assert result is not None
    np.testing.assert_array_equal(result[0], expected[0])
    np.testing.assert_array_equal(result[1], expected[1])
    assert len(np.unique(result[0][:, 0, 0])) == MANY


def test_the_joint_filter_agrees_up_to_rounding() -> None:
    correlated = np.eye(2 * MANY) + 0.3
    task = task_of(filter="joint", joint_measurement_covariance=correlated.tolist())
    state = sensed(task, 6)
    expected = one_by_one(task, state)
    result = task.estimator.single_deliveries(state.estimate)
    assert result is not None
    np.testing.assert_allclose(result[0], expected[0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(result[1], expected[1], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("rows", [2, 7, 8, 30])
def test_diagonal_matrices_are_solved_with_the_same_roundings(rows: int) -> None:
    rng = np.random.default_rng(rows)
    diagonal = 10.0 ** rng.uniform(-12.0, 12.0, (3, rows, 50))
    diagonal[0, 1, :2], diagonal[1, 0, 3], diagonal[2, 1, 4] = 0.0, -1.0, np.inf
    matrix = np.zeros((3, rows, rows, 50))
    matrix[:, np.arange(rows), np.arange(rows)] = diagonal
    vector = rng.normal(size=(3, rows, 50))
    expected = linalg.solve(matrix, vector[..., None, :])[..., 0, :]
    np.testing.assert_array_equal(linalg.solve_vector(matrix, vector), expected)
    matrix[..., 0, 1, 7] = matrix[..., 1, 0, 7] = 0.1
    expected = linalg.solve(matrix, vector[..., None, :])[..., 0, :]
    np.testing.assert_array_equal(linalg.solve_vector(matrix, vector), expected)
