"""Random sensors, priors and held values for the tests of node filters."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.systems.tobit.filters import (
    BoundConstants,
    BoundTobitFilter,
    EventError,
    NodeFilter,
)
from fusion_gym.systems.tobit.sensors import CensoredSensors

Array = NDArray[np.float64]
PAPER_EPSILON = (0.05,) * 5 + (0.7,) * 8 + (1.0,)


class Problem(NamedTuple):
    """Sensors and priors: mean (sensors, n, N), covariance (sensors, n, n, N), held, value."""

    sensors: CensoredSensors
    mean: Array
    covariance: Array
    held: Array
    value: Array


def random_covariance(generator: np.random.Generator, size: int, lanes: int) -> Array:
    """Random positive definite matrices (size, size, lanes) with unequal scales."""
    factor = generator.normal(size=(size, size + 2, lanes))
    factor *= np.exp(generator.normal(size=(size, 1, lanes)))
    return np.einsum("ikn,jkn->ijn", factor, factor)


def random_problem(
    seed: int, size: int, states: int, lanes: int, threshold: Any = None, count: int = 2
) -> Problem:
    """Sensors that differ in everything, and a prior for each sensor and lane."""
    generator = np.random.default_rng(seed)
    if threshold is None:
        threshold = generator.normal(size=(count, size))
    sensors = CensoredSensors.create(
        generator.normal(size=(count, size, states)),
        np.exp(generator.normal(size=(count, size))),
        threshold,
        states,
    )
    low = np.maximum(sensors.threshold, -3.0)
    shape = (count, size, lanes)
    held = np.maximum(generator.normal(scale=2.0, size=shape), low)
    value = np.maximum(generator.normal(scale=2.0, size=shape), low)
    mean = generator.normal(scale=2.0, size=(count, states, lanes))
    spread = [random_covariance(generator, states, lanes) for _ in range(count)]
    return Problem(sensors, mean, np.stack(spread), held, value)


def outcomes(
    node_filter: NodeFilter, problem: Problem, time: int = 3
) -> tuple[Array, Array, Array, Array]:
    """Delivered mean and covariance, silent mean and covariance, of the state."""
    expectation = node_filter.expect(problem.mean)
    times = np.full(problem.mean.shape[-1], float(time))
    root = linalg.root(problem.covariance)
    matrix = linalg.matmul(problem.sensors.measurement_matrix, root)
    outcomes = node_filter.outcomes(matrix, expectation, problem.held, times)
    innovation = problem.value - expectation.value
    delivered = np.einsum("smkN,smN->skN", outcomes.correction, innovation)
    return (
        problem.mean + linalg.matvec(root, delivered),
        linalg.congruence(root, outcomes.delivered_covariance),
        problem.mean + linalg.matvec(root, outcomes.silent_mean),
        linalg.congruence(root, outcomes.silent_covariance),
    )


def make_bound_filter(
    sensors: CensoredSensors,
    with_event_error: bool = True,
    epsilon: tuple[float, ...] = PAPER_EPSILON,
    hold: bool = True,
) -> BoundTobitFilter:
    trigger = {
        "threshold": np.linspace(0.1, 0.3, sensors.count),
        "decay": np.linspace(0.1, 0.25, sensors.count),
        "divisor": np.linspace(4.0, 6.0, sensors.count),
        "initial": np.linspace(1.0, 2.0, sensors.count),
    }
    error = EventError.create(trigger, (1.5, 2.0), sensors.count)
    constants = BoundConstants.create(epsilon)
    return BoundTobitFilter(sensors, constants, error if with_event_error else None, hold)
