"""Laws of units and of the order of sensors: they change no estimate beyond rounding."""

import functools
from typing import Any

import numpy as np
import pytest
from cases import FREE, Array, Options

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.noise import PhiloxNoise
from fusion_gym.core.task import Task
from fusion_gym.systems.correlated.system import CorrelatedTrackingPlant
from fusion_gym.systems.remote.system import ScalarSources
from fusion_gym.systems.tobit.system import CensoredPlant
from fusion_gym.systems.unknown_input.system import DrivenPlant

RUNS, STEPS = 5, 12
# Of the largest error; covariance intersection stops near its optimum, matrix weights have a ridge.
ROUNDING, SEARCH = 1e-9, 1e-6

# Axes of options with units, and the power of the sensor's unit: s is a sensor, x a state in its
# unit, y a state in the inverse of its unit, w a state in the inverse square.
AXES: dict[str, tuple[str, int]] = {
    "transition": ("xy", 0),
    "transitions": (".xy", 0),
    "process_covariance": ("xx", 0),
    "process_gain": ("x.", 0),
    "process_gains": (".x.", 0),
    "input_matrix": ("x.", 0),
    "bias_gain": ("x.", 0),
    "initial_mean": ("x", 0),
    "initial_covariance": ("xx", 0),
    "measurement_matrices": ("s.y", 1),
    "measurement_variance": ("s.", 2),
    "measurement_covariances": ("s", 2),
    "measurement_covariance": ("s.", 2),
    "joint_measurement_covariance": ("ss", 1),
    "censoring_threshold": ("s.", 1),
    "censoring_upper": ("s.", 1),
    "noise_coupling": ("s.", 1),
    "trigger_threshold": ("s", 1),
    "stochastic_weight": ("s", -2),
    "sampling_periods": ("s", 0),
    "fading_values": ("s.", 0),
    "fading_probabilities": ("s.", 0),
    "information_shares": ("s", 0),
    "trigger_initial": ("s", 1),
    "rho_bar": ("s", 2),
    "rho_initial": ("s", 2),
    "state_weights": ("w", 0),
    # Sources with a sensor each.
    "coefficient": ("s", 0),
    "noise_deviation": ("s", 1),
    "initial_deviation": ("s", 1),
    "drop_probability": ("s", 0),
}
LINEAR: Options = {
    "transition": [[0.95, 0.1, 0.0], [-0.1, 0.9, 0.05], [0.0, 0.1, 0.8]],
    "process_covariance": [[0.2, 0.05, 0.0], [0.05, 0.3, 0.0], [0.0, 0.0, 0.1]],
    "initial_mean": [0.5, -1.0, 1.0],
    "initial_covariance": [[1.0, 0.0, 0.0], [0.0, 2.0, 0.1], [0.0, 0.1, 1.0]],
    "measurement_matrices": [
        [[1, 0, 0], [0, 1, 0]],
        [[0, 1, 1], [1, 0, 0]],
        [[1, 0.5, 0], [0, 0, 1]],
    ],
    "measurement_covariances": [0.3, 0.5, 0.2],
    "state_weights": [1.0, 0.7, 1.5],
}
JOINT: Options = {
    "measurement_matrices": [[[1, 0, 0]], [[0, 1, 1]], [[1, 0.5, 0]]],
    "measurement_covariances": 0.25,
    "joint_measurement_covariance": [[0.3, 0.2, 0.1], [0.2, 0.4, 0.1], [0.1, 0.1, 0.2]],
}
LIMITS: Options = {
    "censoring_threshold": [[-0.5, -0.4], [-0.3, -0.6], [-0.8, -0.5]],
    "censoring_upper": [[1.5, np.inf], [2.0, 2.0], [1.8, 1.2]],
}
WEIGHT: Options = {"filter": "stochastic", "stochastic_weight": [1.0, 0.5, 2.0]}
CHANGE: Options = {"trigger": "report_on_change", "trigger_threshold": [0.8, 0.5, 1.0]}
TOBIT: Options = {
    "measurement_matrices": [[[1, 0], [0.5, 1]], [[0, 1], [1, 1]], [[1, 1], [1, -1]]],
    "measurement_variance": [[0.5, 0.2], [0.3, 0.4], [0.1, 0.6]],
    "censoring_threshold": [[-0.5, -0.4], [0.0, -0.2], [0.1, -0.3]],
    "state_weights": [1.0, 0.6],
}
BIASED: Options = {
    "measurement_matrices": [[[1.0, 0.0]], [[0.5, 1.0]], [[1.0, -1.0]]],
    "measurement_variance": [[0.6], [0.3], [0.4]],
    "censoring_threshold": [[-5.0], [-3.0], [-4.0]],
    "censoring_upper": [[5.0], [3.0], [4.0]],
    "state_weights": [1.0, 0.6, 0.3],
}
CORRELATED: Options = {
    "measurement_matrices": [
        [[1, 0, 0], [0, 1, 0]],
        [[0, 1, 0], [0, 0, 1]],
        [[1, 0, 1], [0, 1, 1]],
    ],
    "measurement_variance": [[0.64, 0.3], [0.36, 0.2], [0.49, 0.4]],
    "noise_coupling": [[[0.2], [0.1]], [[0.4], [0.3]], [[0.1], [0.2]]],
    "process_variance": 0.16,
    "state_weights": [1.0, 0.7, 1.5],
}
SOURCES: Options = {
    "sensors": 3,
    "coefficient": [0.9, 1.0, 1.02],
    "noise_deviation": [1.0, 0.5, 2.0],
    "initial_deviation": [1.0, 2.0, 0.5],
    "state_weights": [1.0, 0.7, 1.5],
}
CASES: list[tuple[str, Options]] = [
    ("LinearFusion-v2", LINEAR | options)
    for options in (
        {},
        {"information_shares": [0.2, 0.3, 0.5]},
        {"fusion": "ci"},
        {"fusion": "sci", "order": [2, 0, 1]},
        {"fusion": "sici", "order": [0, 2, 1]},
        JOINT,
        {"filter": "hold"},
        {"filter": "truncated"} | CHANGE,
        {"filter": "tobit"} | LIMITS,
        {"filter": "tobit", "fusion": "ci"} | LIMITS,
        {"filter": "adf"} | LIMITS,
        WEIGHT,
        WEIGHT | {"fusion": "ci"},
    )
]
EVENT: Options = {
    "trigger_threshold": [0.1, 0.2, 0.3],
    "trigger_decay": 0.1,
    "trigger_initial": [1.5] * 3,
}
CASES += [
    ("TobitOscillator-v1", TOBIT | options)
    for options in ({"filter": "tobit"}, {"filter": "adf"}, {"filter": "kalman"}, EVENT)
]
CASES += [
    (name, BIASED | {"filter": kind})
    for name in ("BiasedOscillator-v2", "BiasedTracking-v1")
    for kind in ("paper", "adf", "kalman")
]
CASES += [
    ("CorrelatedTracking-v1", CORRELATED | {"fusion": kind, "order": order})
    for kind, order in (("sici", [2, 0, 1]), ("sci", [0, 2, 1]), ("ci", None))
]
CASES += [
    ("MarkovJumpTracking-v1", {"state_weights": [1.0, 0.7]} | options)
    for options in ({}, {"fusion": "ci"}, {"filter": "centralised"}, {"filter": "imm"})
]
PAPER: Options = {"filter": "paper", "rho_bar": [0.1, 0.2, 0.1], "rho_initial": [0.05] * 3}
CASES += [
    ("UnknownInput-v1", {"state_weights": [1.0, 0.7, 1.5, 0.5, 2.0]} | options)
    for options in ({}, {"fusion": "exact_ci"}, {"filter": "predict"}, PAPER)
]
CASES += [
    ("RemoteEstimation-v1", SOURCES | options)
    for options in (
        {"channel": "independent", "drop_probability": [0.2, 0.4, 0.1]},
        {"filter": "truncated", "trigger": "send_on_delta", "trigger_threshold": [1.0, 0.8, 2.0]},
    )
]
SAME, ORDER = np.arange(3), np.array([2, 0, 1])
each = pytest.mark.parametrize(
    "number",
    range(len(CASES)),
    ids=[
        "-".join([name, *(value for value in options.values() if isinstance(value, str))])
        for name, options in CASES
    ],
)


class Channels:
    """The default noise, times orthogonal matrices."""

    def __init__(self, start: Array, step: Array, stream: int = 0) -> None:
        self._start, self._step, self._own = start, step, PhiloxNoise(stream)

    def start(self, seed: int, episode: int, channels: int) -> Array:
        return self._start @ self._own.start(seed, episode, channels)

    def steps(self, seed: int, episode: int, first: int, count: int, channels: int) -> Array:
        return self._own.steps(seed, episode, first, count, channels) @ self._step.T

    def uniform(self, seed: int, episode: int) -> float:
        return self._own.uniform(seed, episode)


def exchanged(before: Task, after: Task, order: Array) -> Channels:
    """The noise with which sensors in another order measure the same."""
    plant: Any = before.plant
    steps, starts, sources = plant.noise_channels, plant.start_channels, before.sensors
    match plant:
        case CensoredPlant():
            own = sources * plant.sensors.size
            start, step = [(2 * plant.dynamics.size, own)], [(steps - own, own)]
        case CorrelatedTrackingPlant():
            start, step = [], [(steps - 2 * sources, 2 * sources)]
        case DrivenPlant():
            size = plant.dynamics.size
            start, step = [(size, 2 * sources)], [(steps - 2 * sources, 2 * sources)]
        case ScalarSources():
            start, step = [(0, sources)], [(0, sources)]
        case _:  # fading, then noises
            start, step = [], [(steps - 2 * sources, sources), (steps - sources, sources)]
    result = np.eye(starts), np.eye(steps)
    for matrix, blocks in zip(result, (start, step), strict=True):
        for first, own in blocks:
            size = own // sources
            moved = np.eye(own)[(order[:, None] * size + np.arange(size)).ravel()]
            if before.settings.get("joint_measurement_covariance"):  # L' z' = L z, in their orders
                factors = [correlation(task) for task in (before, after)]
                moved = np.linalg.solve(factors[1], moved @ factors[0])
            matrix[first : first + own, first : first + own] = moved
    return Channels(*result)


def correlation(task: Task) -> Array:
    """The factor of the correlations of a task's noises."""
    plant: Any = task.plant
    factor: Array = plant.sensors.noise_correlation[..., 0]
    return factor


def scaled(task: Task, sensors: Array, states: Array) -> Options:
    """The options of a task in other units."""
    result: Options = {}
    for name, (axes, power) in AXES.items():
        if (value := task.settings.get(name)) is None:
            continue
        units = {"s": sensors**power, "x": states, "y": 1.0 / states, "w": states**-2.0}
        value = np.array(value, dtype=np.float64)
        for axis, letter in enumerate(axes[: value.ndim]):
            if letter in units:
                unit = np.append(units[letter], np.ones(value.shape[axis]))[: value.shape[axis]]
                value *= unit.reshape(-1, *(1,) * (value.ndim - 1 - axis))
        result[name] = value.tolist()
    return result


def permuted(task: Task, order: Array) -> Options:
    """The options of a task with its sensors in another order."""
    result: Options = {}
    sources = "s" if "coefficient" in task.settings else "w"
    for name, (axes, _) in AXES.items():
        value = task.settings.get(name)
        if isinstance(value, list):
            for axis, letter in enumerate(axes.replace("w", sources)):
                if letter == "s":
                    value = np.take(np.array(value), order, axis).tolist()
            result[name] = value
    if (arrival := task.settings.get("order")) is not None:
        result["order"] = np.argsort(order)[arrival].tolist()
    return result


def errors(task: Task, order: Array, noise: Channels | None = None) -> Array:
    """The reward's error terms (steps, runs) under random requests of the sensors in an order."""
    batch = EpisodeBatch(task, RUNS, noise=noise)
    if task.network.noise_channels:  # a loss for each sensor
        batch.network_source = Channels(np.eye(0), np.eye(task.sensors)[order], stream=1)
    batch.seed(np.arange(RUNS), list(range(RUNS)))
    batch.reset()
    request = np.random.default_rng(1).random((STEPS, task.sensors, RUNS)) < 0.4
    return np.array([-batch.step(requested[order]).reward_error for requested in request])


@functools.cache
def base(number: int) -> tuple[Task, Array]:
    """The task of a case, and its errors."""
    task = changed(number, {})
    return task, errors(task, SAME)


def changed(number: int, more: Options) -> Task:
    """The task of a case with other options."""
    name, options = CASES[number]
    common = FREE | {"reward_scale": None, "horizon": STEPS}
    return fusion_gym.make_task(f"fusion_gym/{name}", **common | options | more)


def compare(number: int, errors: Array) -> None:
    """Demand the errors of a case."""
    task, expected = base(number)
    near = task.settings.get("fusion") in ("ci", "exact_ci") or "transitions" in task.settings
    most = (SEARCH if near else ROUNDING) * expected.max()
    np.testing.assert_allclose(errors, expected, rtol=0.0, atol=most)


@each
def test_the_unit_of_a_sensor_has_no_effect(number: int) -> None:
    task, unit = base(number)[0], np.array([1.4, 0.01, 0.3])  # a bound of one paper is at most 1
    states = unit if "coefficient" in task.settings else np.ones(1)
    compare(number, errors(changed(number, scaled(task, unit, states)), SAME))


@each
def test_the_unit_of_a_state_with_its_weight_has_no_effect(number: int) -> None:
    task = base(number)[0]
    count = len(task.settings.get("transition", task.settings.get("transitions", [[]])[0]))
    states = np.array([3.0, 0.1, 20.0, 0.5])[:count]  # sources are those of the sensors
    compare(number, errors(changed(number, scaled(task, np.ones(3), states)), SAME))


@each
def test_the_order_of_sensors_has_no_effect(number: int) -> None:
    """The assumed-density filter takes deliveries one after another, so its order has one."""
    task, expected = base(number)
    after = changed(number, permuted(task, ORDER))
    result = errors(after, ORDER, exchanged(task, after, ORDER))
    if task.settings.get("filter") == "adf":
        ratio = result.mean() / expected.mean()
        assert 0.0 < abs(ratio - 1.0) < 0.01
    else:
        compare(number, result)
