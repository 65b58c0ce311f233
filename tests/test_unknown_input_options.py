"""Options of the unknown-input environment: other sizes, given inputs, and what is refused."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusion_gym import linalg
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.envs.registration import make_task
from fusion_gym.policies.registry import make_rule
from fusion_gym.validation import ConfigurationError

build = partial(make_task, "fusion_gym/UnknownInput-v0")

ROOT = Path(__file__).parents[1]


def shape(n: int, q: int, sensors: int, m: int) -> dict[str, Any]:
    draw = np.random.default_rng(100 * n + 10 * q + m)
    transition = draw.normal(size=(n, n))
    transition *= 0.7 / np.abs(np.linalg.eigvals(transition)).max()
    return {
        "transition": transition,
        "input_matrix": draw.normal(size=(n, q)),
        "process_covariance": 0.05 * np.eye(n),
        "initial_mean": np.zeros(n),
        "initial_covariance": np.eye(n),
        "measurement_matrices": draw.normal(size=(sensors, m, n)),
        "measurement_covariance": 0.1,
        "horizon": 15,
    }


@pytest.mark.parametrize(
    "options",
    [
        shape(3, 2, 4, 3) | {"input_signal": np.ones((16, 2)), "filter": "predict"},
        shape(2, 2, 2, 2) | {"fusion": "ici", "input_signal": "steps"},
        shape(3, 1, 1, 2) | {"sampling_period": 1, "input_signal": "random_walk"},
        shape(1, 1, 2, 1) | {"sampling_period": 3, "filter": "predict", "fusion": "sci"},
        shape(2, 1, 5, 2) | {"young_factor": 0.05, "filter": "paper", "fusion": "sici"},
        shape(2, 2, 2, 2) | {"filter": "paper", "input_phase": 0.3},
        {"example": "paper", "filter": "predict", "horizon": 15},
        {"example": "paper", "filter": "random_walk", "hold_variance": 0.05, "horizon": 15},
        {"horizon": 1, "filter": "paper"},
        {"max_episode_steps": 7},
    ],
)
def test_other_sizes_signals_filters_and_fusions_run(options: dict[str, Any]) -> None:
    task = build(**options)
    batch = EpisodeBatch(task, 5)
    batch.seed(np.arange(5), list(range(5)))
    batch.reset()
    policy = make_rule("random:rate=0.4", task.policy_defaults)
    policy.reset(5, 1)
    for _ in range(task.horizon + 3):  # and beyond the end, as finished runs go
        outcome = batch.step(policy(batch.signals()))
        assert np.isfinite(outcome.reward).all()
        assert np.isfinite(batch.observe()).all()
        mean, covariance = task.system.fused(batch.delivered)
        assert mean.shape == task.system.truth(batch.delivered).shape
        assert np.isfinite(linalg.cholesky(covariance)).all()
    states = task.system.plant.size + task.system.plant.inputs
    assert len(task.system.state_names) == states


def test_a_users_array_is_the_input() -> None:
    values = np.random.default_rng(0).normal(size=(21, 1))
    task = build(input_signal=values, horizon=20)
    batch = EpisodeBatch(task, 2)
    batch.reset()
    for k in range(20):
        batch.step(np.zeros((3, 2), dtype=np.bool_))
        np.testing.assert_array_equal(batch.delivered.truth[4], np.repeat(values[k], 2))


def test_episodes_differ_in_their_input() -> None:
    for kind in ("sinusoids", "steps", "random_walk"):
        batch = EpisodeBatch(build(input_signal=kind), 50)
        batch.seed(np.arange(50), list(range(50)))
        batch.reset()
        assert batch.state.truth[4].std() > 0.4


# Velocity and elongation: with the force unknown, a common drift of both carts is not seen.
DRIFTING = (((0.0, 1.0, 0.0, 0.0), (-1.0, 0.0, 1.0, 0.0)),) * 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sampling_period": 0}, r"sampling_period = 0 .* >= 1"),
        ({"sampling_period": 1.5}, "sampling_period = 1.5"),
        ({"measurement_matrices": np.zeros((3, 2, 4))}, r"measurement_matrices\[0\].*rank"),
        (
            {
                "measurement_matrices": np.eye(4)[None, 2:],
                "measurement_covariance": 0.1,
                "input_matrix": np.eye(4)[:, :2],
                "transition": 0.5 * np.eye(4),
            },
            r"measurement_matrices\[0\] .* rank\(C B\) is 0 for 2 inputs",
        ),
        (
            {
                "measurement_matrices": np.ones((2, 1, 4)),
                "measurement_covariance": 0.1,
                "input_matrix": np.eye(4)[:, :2],
            },
            r"rank\(C B\) is 1 for 2 inputs",
        ),
        ({"measurement_matrices": np.ones((3, 2, 3))}, "measurement_matrices"),
        ({"measurement_covariance": -0.1}, "measurement_covariance"),
        ({"measurement_covariance": np.zeros((3, 2, 2))}, r"measurement_covariance\[0\]"),
        ({"measurement_covariance": np.ones((2, 2))}, "measurement_covariance"),
        ({"transition": np.ones((3, 4))}, "transition"),
        ({"transition": np.eye(3)}, "input_matrix"),
        ({"input_matrix": np.ones(4)}, "input_matrix"),
        ({"process_covariance": -np.eye(4)}, "process_covariance"),
        ({"initial_covariance": np.zeros((4, 4))}, "initial_covariance"),
        ({"initial_half_width": -0.1}, "initial_half_width"),
        ({"rho_bar": 0.05, "rho_initial": 0.1}, r"rho_initial = .* <= rho_bar"),
        ({"rho_bar": 1.2}, r"rho_bar = .* <= 1"),
        ({"rho_initial": -0.1}, "rho_initial"),
        ({"adaptation": 0.0}, "adaptation"),
        ({"rho_bar": (0.1, 0.2)}, "rho_bar"),
        ({"young_factor": 0.0}, "young_factor"),
        (
            {"filter": "paper", "measurement_matrices": DRIFTING},
            r"young_factor = .* sensor 0: .*radius",
        ),
        ({"input_memory": 1.1}, "input_memory"),
        ({"input_change": 0.0}, "input_change"),
        ({"input_deviation": -1.0}, "input_deviation"),
        ({"hold_variance": 0.1, "filter": "predict"}, r"hold_variance = 0.1 .*random_walk"),
        ({"hold_variance": -0.1}, "hold_variance"),
        ({"filter": "kalman"}, r"filter = 'kalman' .*'random_walk'"),
        ({"fusion": "information"}, r"fusion = 'information' .* process noise"),
        ({"fusion": "federated"}, r"fusion = 'federated'"),
        ({"fusion": "ici"}, r"fusion = 'ici' .* 3 sensors"),
        ({"fusion": "cii"}, "did you mean"),
        ({"input_signal": "sine"}, "input_signal = 'sine'"),
        ({"input_signal": np.ones((100, 1))}, r"input_signal .*\(101, 1\)"),
        ({"input_signal": np.zeros((101, 1))}, "input_signal"),
        (
            {
                "process_covariance": np.zeros((4, 4)),
                "initial_half_width": 0.0,
                "transition": np.eye(4),
                "input_matrix": np.eye(4)[:, 1:2],
            },
            "process_covariance = .* moved by the input",
        ),
        ({"input_signal": np.ones((101, 1)), "input_period": 3.0}, "input_period = 3.0"),
        ({"input_amplitude": "large"}, "input_amplitude"),
        ({"input_amplitude": np.ones((2, 2))}, "input_amplitude"),
        ({"input_period": 0.0}, "input_period"),
        ({"input_signal": "steps", "input_period": 0.5}, r"input_period .* >= 1"),
        ({"input_signal": "steps", "input_phase": 0.0}, "input_phase = 0.0"),
        ({"input_phase": "drawn"}, "input_phase = 'drawn'"),
        ({"example": "carts"}, r"example = 'carts' .*did you mean 'two_carts'"),
        ({"input_weight": -1.0}, "input_weight"),
        ({"state_weights": (1.0, 1.0)}, "state_weights"),
        ({"horizon": 0}, "horizon = 0"),
        ({"thresholds": 1.0}, "unknown option"),
    ],
)
def test_what_is_not_allowed_is_said_in_one_error(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        build(**options)


def test_given_numbers_go_before_the_examples() -> None:
    task = build(example="paper", rho_bar=0.2, initial_covariance=0.02 * np.eye(2))
    assert task.policy_defaults["adaptive_threshold"] == {
        "rho_bar": (0.2, 0.2),
        "rho_initial": (0.01, 0.01),
        "adaptation": (0.01, 0.01),
    }
    assert task.settings["initial_covariance"] == [[0.02, 0.0], [0.0, 0.02]]
    assert task.settings["filter"] == "paper"
    assert task.system.state_names == ("x1", "x2", "d1", "d2")
    assert build().system.state_names[-1] == "force"
