"""Options of the unknown-input environment: other sizes, given inputs, and what is refused."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from rules import make_rule
from structured_systems import flaw

from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.envs.registration import make_task
from fusion_gym.validation import ConfigurationError

build = partial(make_task, "fusion_gym/UnknownInput-v1")


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
    batch = EpisodeBatch.seeded(task, 5, 0)
    policy = make_rule("random:rate=0.4", task.policy_defaults)
    policy.reset(5, 1)
    for _ in range(task.horizon + 3):  # and beyond the end, as finished runs go
        outcome = batch.step(policy(batch.signals()))
        assert flaw(batch, outcome.reward, ()) is None
    dynamics = task.plant.dynamics  # type: ignore[attr-defined]
    assert len(task.plant.state_names) == dynamics.size + dynamics.inputs


def test_a_users_array_is_the_input() -> None:
    values = np.random.default_rng(0).normal(size=(21, 1))
    task = build(input_signal=values, horizon=20)
    batch = EpisodeBatch(task, 2)
    batch.reset()
    for k in range(20):
        batch.step(np.zeros((3, 2), dtype=np.bool_))
        np.testing.assert_array_equal(batch.delivered.plant.truth[4], np.repeat(values[k], 2))


# Velocity and elongation: with the force unknown, a common drift of both carts is not seen.
DRIFTING = (((0.0, 1.0, 0.0, 0.0), (-1.0, 0.0, 1.0, 0.0)),) * 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
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
        ({"measurement_covariance": np.zeros((3, 2, 2))}, r"measurement_covariance\[0\]"),
        ({"transition": np.eye(3)}, "input_matrix"),
        ({"rho_bar": 0.05, "rho_initial": 0.1}, r"rho_initial = .* <= rho_bar"),
        (
            {"filter": "paper", "measurement_matrices": DRIFTING},
            r"young_factor = .* sensor 0: .*radius",
        ),
        ({"hold_variance": 0.1, "filter": "predict"}, r"hold_variance = 0.1 .*random_walk"),
        ({"fusion": "information"}, r"fusion = 'information' .* process noise"),
        ({"fusion": "ici"}, r"fusion = 'ici' .* 3 sensors"),
        ({"input_signal": np.ones((100, 1))}, r"input_signal .*\(101, 1\)"),
        ({"input_signal": np.zeros((101, 1))}, "input_signal"),
        (
            {
                "process_covariance": np.zeros((4, 4)),
                "initial_half_width": 0.0,
                "transition": np.eye(4),
                "input_matrix": np.eye(4)[:, 1:2],
            },
            "process_covariance = .* have an input",
        ),
        ({"input_signal": np.ones((101, 1)), "input_period": 3.0}, "input_period = 3.0"),
        (shape(2, 2, 2, 2) | {"input_amplitude": [0.1, 0.1]}, r"input_amplitude .* \(2, terms\)"),
        ({"intersample_error": True, "error": "trace"}, "error = 'trace' .* intersample_error"),
        ({"input_signal": "steps", "input_period": 0.5}, r"input_period .* >= 1"),
        ({"input_signal": "steps", "input_phase": 0.0}, "input_phase = 0.0"),
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
    assert task.plant.state_names == ("x1", "x2", "d1", "d2")
    assert build().plant.state_names[-1] == "force"


def test_the_error_between_samples_is_of_the_predicted_small_steps() -> None:
    options = shape(3, 2, 2, 2) | {"sampling_period": 4, "intersample_error": True}
    task = build(**options, state_weights=[1.0, 2.0, 0.5, 3.0, 0.0], error_weight=2.0)
    batch = EpisodeBatch.seeded(task, 4, 0)
    outcome = batch.step(np.array([[True, False, True, False]] * 2))
    weights, (states, inputs) = task.reward.state_weights[:, 0], np.split(outcome.error, [3])
    cost = np.zeros(4)
    for run in range(4):
        for small in range(4):  # in closed form: Aʲ e + Σ Aⁱ B e_d
            power = partial(np.linalg.matrix_power, np.array(options["transition"]))
            error = power(small) @ states[:, run]
            error += sum(power(i) @ options["input_matrix"] @ inputs[:, run] for i in range(small))
            cost[run] += weights[:3] @ error**2 / 4
        cost[run] += weights[3:] @ inputs[:, run] ** 2
    np.testing.assert_allclose(outcome.reward_error, -2.0 * cost, rtol=1e-12)


def test_the_variance_of_a_silent_node_is_its_prediction() -> None:
    batch = EpisodeBatch.seeded(build(), 2, 0)
    plant: Any = batch.task.plant
    a, b = plant.dynamics.transition[..., 0], plant.dynamics.input_matrix[..., 0]
    memory, change, deviation = 0.9, 0.3, 0.7  # r and η of d(k) = r d(k-1) + η, and d's own
    move = np.block([[a, memory * b], [np.zeros((1, 4)), np.full((1, 1), memory)]])
    new = np.vstack((b, [[1.0]])) * change
    noise = new @ new.T
    noise[:4, :4] += plant.dynamics.process_covariance[..., 0]
    covariance = np.diag([0.1] * 4 + [deviation**2])
    for _ in range(6):
        covariance = move @ covariance @ move.T + noise
        expected = np.full((3, 2), np.trace(covariance[:4, :4]))
        np.testing.assert_allclose(batch.signals()["local_variance"], expected, rtol=1e-9)
        batch.step(np.zeros((3, 2), dtype=np.bool_))
