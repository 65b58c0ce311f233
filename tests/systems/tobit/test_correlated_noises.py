"""LinearFusion with noises that sensors share, against plain matrices and Monte Carlo."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.solvers.silence.problem import silence_model
from fusion_gym.validation import ConfigurationError

Array = NDArray[np.float64]
LINEAR = "fusion_gym/LinearFusion-v2"
SIZES = (1, 2, 1)
A = np.array([[0.98, 0.2], [-0.1, 0.95]])
W = np.array([[0.05, 0.02], [0.02, 0.1]])
ROWS = [[1.0, 0.0], [[0.0, 1.0], [1.0, 1.0]], [1.0, 0.5]]
C = np.vstack([np.atleast_2d(rows) for rows in ROWS])


def shared() -> Array:
    """The covariance of four channels that all have one common noise, and each its own."""
    common = np.array([[0.6, 0.5, 0.4, 0.7]])
    return common.T @ common + np.diag([0.1, 0.2, 0.15, 0.1])


def task_of(**options: Any) -> Task:
    arguments = {
        "transition": A,
        "process_covariance": W,
        "measurement_matrices": ROWS,
        "joint_measurement_covariance": shared(),
        "tokens": "unlimited",
    }
    return fusion_gym.make_task(LINEAR, **(arguments | options))


def optimal(granted: NDArray[np.bool_], prior: Array) -> Array:
    """Posterior covariance of all granted channels at once, in information form."""
    mask = np.repeat(granted, SIZES)
    if not mask.any():
        return prior
    noise = shared()[np.ix_(mask, mask)]
    return np.linalg.inv(np.linalg.inv(prior) + C[mask].T @ np.linalg.inv(noise) @ C[mask])


def test_the_noise_has_the_covariance_that_was_given() -> None:
    """Of a plant that stands still at zero the measurements are the noise."""
    still = {"transition": np.eye(2), "process_covariance": np.zeros((2, 2)),
             "initial_covariance": 1e-12 * np.eye(2)}  # fmt: skip
    batch = EpisodeBatch.seeded(task_of(horizon=1, **still), 20_000, 3)
    measured = batch.signals()["measurement"]
    own = np.linalg.cholesky(shared()[1:3, 1:3])  # the second sensor reports F⁻¹ y
    second = own @ measured[1]
    values = np.cov(np.vstack([measured[0, :1], second, measured[2, :1]]))
    np.testing.assert_allclose(values, shared(), atol=0.03)
    assert not measured[0, 1].any()  # a channel that the sensor does not have


def test_without_shared_noise_it_is_federated_fusion() -> None:
    separate = np.zeros((4, 4))
    for rows in (slice(0, 1), slice(1, 3), slice(3, 4)):
        separate[rows, rows] = shared()[rows, rows]
    together = task_of(joint_measurement_covariance=separate, filter="joint")
    nodes = task_of(joint_measurement_covariance=separate)
    assert nodes.settings["filter"] == "kalman"
    for name in ("periodic:period=3", "innovation_threshold", "information_gain",
                 "value_of_information"):  # fmt: skip
        first, second = (run_episodes(t, make_policy(name, t), 20, 0) for t in (together, nodes))
        np.testing.assert_allclose(first.returns, second.returns, rtol=1e-9)


@pytest.mark.parametrize("fusion", ["ci", "sci"])
def test_covariance_intersection_keeps_its_bound(fusion: str) -> None:
    """Two sensors of one state each, whose noise is nearly the same."""
    pair = {
        "measurement_matrices": [[1.0, 0.0], [0.6, 0.8]],
        "joint_measurement_covariance": [[0.5, 0.45], [0.45, 0.5]],
    }
    joint, nodes = task_of(**pair), task_of(**pair, filter="kalman", fusion=fusion)
    best, results = (run_episodes(t, make_policy("always", t), 500, 0) for t in (joint, nodes))
    assert results.mse.mean() < 0.97 * results.bound_trace.mean()
    assert best.mse.mean() < 0.9 * results.mse.mean()


def test_a_large_prior_keeps_its_digits() -> None:
    """A prior a million times as large as the noise: the posterior is that of the information."""
    task = task_of(initial_covariance=1e6 * np.eye(2))
    claimed = EpisodeBatch.seeded(task, 1, 0).state.estimate.covariance
    expected = np.linalg.inv(1e-6 * np.eye(2) + C.T @ np.linalg.inv(shared()) @ C)
    np.testing.assert_allclose(claimed[..., 0], expected, rtol=1e-9)


def test_the_bounds_floor_counts_what_is_shared() -> None:
    """The floor under the error is the optimal filter's error with all measurements."""
    model = silence_model(task_of())
    covariance, total = optimal(np.ones(3, dtype=np.bool_), np.eye(2)), 0.0
    for _ in range(100):
        covariance = optimal(np.ones(3, dtype=np.bool_), A @ covariance @ A.T + W)
        total += np.trace(covariance) / 100
    assert model.floor == pytest.approx(total, rel=1e-9)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"joint_measurement_covariance": np.ones((4, 4))}, "positive definite"),
        ({"filter": "kalman", "fusion": "federated"}, "'ci' or 'sci'"),
        ({"filter": "adf"}, "'joint', 'local' or 'kalman'"),
        ({"memory": True, "memory_filter": "adf"}, "memory_filter"),
        ({"filter": "joint", "fusion": "ci"}, "a filter with nodes"),
        ({"censoring_threshold": [0.0, -np.inf, -np.inf]}, "because some are censored"),
        ({"censoring_upper": [5.0, [4.0, np.inf], np.inf]}, "the censored sensor 1"),
    ],
)
def test_what_would_not_stay_right_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        task_of(**options)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
