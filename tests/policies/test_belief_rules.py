"""The rules on beliefs: their units, their limits, their figures."""

import functools
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.estimator import Reception
from fusion_gym.core.knowledge import Signals
from fusion_gym.core.memory import Beliefs
from fusion_gym.core.task import Task
from fusion_gym.policies.rules import (
    EstimateDifference,
    KullbackLeibler,
    ValueOfInformation,
)

TOBIT = "fusion_gym/TobitOscillator-v1"
CORRELATED = "fusion_gym/CorrelatedTracking-v1"
BENCHMARK = {"filter": "tobit", "random_start": True, "token_rate": 2.0}
Array = NDArray[Any]


@functools.cache
def task_of(env_id: str = TOBIT, **options: Any) -> Task:
    return fusion_gym.make_task(env_id, **(BENCHMARK if env_id == TOBIT else {}) | options)


def later(task: Task, owner: Any = "scheduler", runs: int = 40, steps: int = 6) -> EpisodeBatch:
    """Runs after a few steps with few deliveries."""
    batch, draw = EpisodeBatch.seeded(task, runs, 0, owner), np.random.default_rng(0)
    for _ in range(steps):
        batch.step(draw.random((task.sensors, runs)) < 0.1)
    return batch


def weighted(task: Task, difference: Array) -> Array:
    """‖·‖² by weights of mean 1."""
    weights = task.reward.state_weights[:, 0] / task.reward.state_weights.mean()
    return np.asarray(np.einsum("i,...ir->...r", weights, difference**2))


def after(task: Task, state: Any, *sensors: int) -> tuple[Array, Array]:
    """The centre's mean and covariance when these transmit."""
    estimator = task.estimator
    granted = np.zeros((task.sensors, state.measurement.shape[-1]), dtype=np.bool_)
    granted[list(sensors)] = True
    updated = estimator.update(state, Reception(granted))
    return estimator.mean(updated), estimator.covariance(updated)


def share(requests: Array) -> None:
    """Neither none nor all."""
    assert 0.0 < requests.mean() < 1.0


@pytest.mark.parametrize("memory", [False, True])
def test_the_value_is_in_squared_units_of_the_states(memory: bool) -> None:
    """‖x* - x̂‖² - ‖x* - x̂(s)‖² at least the threshold; equality is enough."""
    task = task_of(memory=memory, state_weights=(1.0, 3.0))
    batch = later(task)
    best = after(task, batch.state.estimate, *range(3))[0]
    if memory:
        best = after(task, batch.memory.states["every"], *range(3))[0]
    silent = weighted(task, best - after(task, batch.state.estimate)[0])
    each = [weighted(task, best - after(task, batch.state.estimate, s)[0]) for s in range(3)]
    value = silent - np.array(each)
    np.testing.assert_allclose(batch.signals()["transmission_value"], value, rtol=1e-9, atol=1e-12)
    requests = ValueOfInformation(task, threshold=0.02)(batch.signals())
    share(requests)
    np.testing.assert_array_equal(requests, value >= 0.02)
    highest = float(batch.signals()["transmission_value"].max())
    assert ValueOfInformation(task, threshold=highest)(batch.signals()).sum() == 1
    assert not ValueOfInformation(task, threshold=np.nextafter(highest, 9.0))(batch.signals()).any()


@pytest.mark.parametrize("own", [False, True])
def test_a_price_is_a_threshold_in_the_rewards_units(own: bool) -> None:
    """The tokens of a packet times their price, over what a squared error counts."""
    task = task_of(memory=True, token_cost=(1.0, 2.0, 4.0), error_weight=7.0)
    signals = later(task, "own" if own else "scheduler").signals()
    price, costs = 0.05, np.array([1.0, 2.0, 4.0])
    requests = ValueOfInformation(task, price=price, own=own)(signals)
    share(requests)
    for sensor, cost in enumerate(costs):
        threshold = price * cost / (7.0 * task.reward.state_weights.mean())
        other = ValueOfInformation(task, threshold=threshold, own=own)(signals)
        np.testing.assert_array_equal(requests[sensor], other[sensor])


def test_without_a_price_the_threshold_is_that_of_its_page() -> None:
    signals = later(task_of(memory=True)).signals()
    names = "value_of_information", "value_of_information:threshold=0.03"
    requests, same = (fusion_gym.make_policy(name, task_of(memory=True))(signals) for name in names)
    np.testing.assert_array_equal(requests, same)
    share(requests)


def test_at_most_takes_the_most_valuable_and_ties_go_to_the_longest_silent() -> None:
    task = task_of(memory=True)
    signals = later(task, runs=200).signals()
    value = signals["transmission_value"]
    every = ValueOfInformation(task, threshold=0.001)(signals)
    assert every.sum(0).max() == 3
    for most in (1, 2):
        requests = ValueOfInformation(task, threshold=0.001, at_most=most)(signals)
        assert requests.sum(0).max() == most
        ranks = (value[:, None] < value[None]).sum(1)  # how many are worth more
        clear = np.diff(np.sort(value, axis=0), axis=0).min(0) > 0.0
        np.testing.assert_array_equal(requests[:, clear], (every & (ranks < most))[:, clear])
    tied = dict(signals) | {
        "beliefs": Tied(task),
        "age": np.array([[1.0, 4.0], [3.0, 4.0], [3.0, 2.0]]),
    }
    requests = ValueOfInformation(task, threshold=0.5, at_most=1)(Signals(tied))
    np.testing.assert_array_equal(requests.T, [[False, True, False], [True, False, False]])


class Tied:
    """Beliefs by which all transmissions are worth the same."""

    def __init__(self, task: Task) -> None:
        self.value = np.ones((task.sensors, 2))


def test_what_differs_is_measured_in_the_states_unit_or_whitened() -> None:
    task = task_of(memory=True, state_weights=(1.0, 3.0))
    batch = later(task)
    signals, silent = batch.signals(), after(task, batch.state.estimate)
    apart = signals["belief_difference"]
    norm = np.sqrt(weighted(task, apart))
    white = np.sqrt([
        apart[:, run] @ np.linalg.solve(silent[1][..., run], apart[:, run])
        for run in range(batch.num_envs)
    ])  # fmt: skip
    for whitened, size, threshold in ((False, norm, 0.2), (True, white, 0.5)):
        share(size >= threshold)
        parameters: Any = {"threshold": threshold, "whitened": whitened}
        every = EstimateDifference(task, at_most=None, **parameters)(signals)
        np.testing.assert_array_equal(every, np.broadcast_to(size >= threshold, every.shape))
        single = EstimateDifference(task, **parameters)(signals)
        np.testing.assert_array_equal(single.sum(0), size >= threshold)
        selected = single.any(0)
        value = signals["transmission_value"]
        np.testing.assert_array_equal(value.T[single.T], value.max(0)[selected])


@pytest.mark.parametrize("env_id", [TOBIT, "fusion_gym/BiasedOscillator-v2"])
def test_a_sensor_without_memory_looks_at_what_its_measurement_would_change(env_id: str) -> None:
    """A threshold on |W^½ (x̂(s) - x̂)|."""
    task = task_of(env_id, access="any")
    batch = later(task, "own", runs=8)
    assert not batch.memory.states
    silent = after(task, batch.state.estimate)[0]
    each = [after(task, batch.state.estimate, s)[0] - silent for s in range(task.sensors)]
    size = np.sqrt(weighted(task, np.array(each)))
    threshold = float(np.median(size))
    requests = EstimateDifference(task, threshold=threshold, own=True)(batch.signals())
    share(requests)
    np.testing.assert_array_equal(requests, size >= threshold)


@pytest.mark.parametrize(
    ("own", "memory"), [(False, False), (False, True), (True, False), (True, True)]
)
def test_the_divergence_is_that_of_two_gaussians(own: bool, memory: bool) -> None:
    """As the mean of the logarithm of their ratio, by three-point quadrature in each direction."""
    task = task_of(CORRELATED, memory=memory, broadcast="packets")
    batch = later(task, "own" if own else "scheduler", runs=6)
    beliefs: Beliefs = batch.beliefs()
    estimates = beliefs.best if own else beliefs.sent
    values = np.zeros((task.sensors, 6))
    for sensor in range(task.sensors):
        for run in range(6):
            known = len(beliefs.silent.mean) > 1
            mean, spread = (part[sensor][..., run] for part in estimates)
            other, wide = (part[sensor if known else 0][..., run] for part in beliefs.silent)
            steps = np.sqrt(len(mean)) * np.linalg.cholesky(spread).T
            points = np.concatenate((mean + steps, mean - steps))  # exact for squares
            ratio = multivariate_normal(mean, spread).logpdf(points)
            ratio -= multivariate_normal(other, wide).logpdf(points)
            values[sensor, run] = ratio.mean()
    threshold = float(np.median(values)) * (1.0 + 1e-9)
    requests = KullbackLeibler(task, threshold=threshold, own=own)(batch.signals())
    share(requests)
    np.testing.assert_array_equal(requests, values >= threshold)
