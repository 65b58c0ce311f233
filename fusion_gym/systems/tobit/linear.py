"""A linear system of one's own: any plant, any number of sensors, a network and a fusion centre."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.options import Scenario
from fusion_gym.systems.linear_plant import LinearPlant, typical_magnitude
from fusion_gym.systems.tobit.options import (
    FILTERS,
    FeedbackOptions,
    at_the_nodes,
    make_centre,
    remembering_system,
    stochastic_defaults,
    true_nature,
)
from fusion_gym.systems.tobit.sensors import CensoredSensors
from fusion_gym.systems.tobit.system import CensoredSystem
from fusion_gym.systems.tobit.tobit_filter import TobitKalmanFilter

_FILTERS = {
    "kalman": FILTERS["kalman"],
    "tobit": at_the_nodes(TobitKalmanFilter),
    "adf": FILTERS["adf"],
    "stochastic": FILTERS["stochastic"],
}
_STEP = 0.1  # seconds between two samples of the default target
# Observed variances are relative to those after so many silent steps: a target that nobody sees
# drifts far beyond what is ever unknown of it.
_REFERENCE_HORIZON = 10


@dataclass(frozen=True)
class LinearFusionOptions(FeedbackOptions):
    """Any linear plant, x' = A x + w, and any sensors of it, y = C x + v, each with its own size.

    Every sensor has a Kalman filter (a Tobit Kalman filter where it is censored); the centre fuses
    them and feeds the result back. At every step the policy requests transmissions, and the token
    bucket grants or denies them.

    ``measurement_matrices`` has a matrix (channels, states) for each sensor, or a row of as many
    numbers as states for a sensor of one channel. ``measurement_covariances`` has a covariance for
    each sensor, or a variance; one number is the variance of all channels. A sensor whose
    covariance is not diagonal reports R^(-1/2) y, which holds the same. ``censoring_threshold``
    and ``censoring_upper`` have a number for all channels, one for each sensor, or a list of one
    for each channel of each sensor.

    Starting state: x₀ ~ N(``initial_mean``, ``initial_covariance``), by default zero and the
    identity. The first measurement is known to the centre free of charge.

    The defaults are a target in one dimension, sampled every 0.1 s, with white acceleration;
    one sensor measures its position in metres, one its velocity in metres a second.
    """

    # Plant: x(t+1) = A x(t) + w(t), w ~ N(0, W)
    transition: ArrayLike = ((1.0, _STEP), (0.0, 1.0))
    process_covariance: ArrayLike = (
        (_STEP**3 / 3.0, _STEP**2 / 2.0),
        (_STEP**2 / 2.0, _STEP),
    )
    initial_mean: ArrayLike | None = None
    initial_covariance: ArrayLike | None = None
    # Sensors: y = clip(C x + v, τ, υ), v ~ N(0, R)
    measurement_matrices: Sequence[ArrayLike] = ((1.0, 0.0), (0.0, 1.0))
    measurement_covariances: ArrayLike | Sequence[ArrayLike] = 0.25
    censoring_threshold: ArrayLike | Sequence[ArrayLike] = -np.inf
    censoring_upper: ArrayLike | Sequence[ArrayLike] = np.inf
    # Network
    token_rate: float = 1.0
    token_capacity: float = 15.0
    initial_tokens: float = 6.0
    # Filters
    filter: str | None = None


def build(chosen: LinearFusionOptions) -> Scenario:
    """The scenario of these options, checked before anything runs.

    Raises:
        ConfigurationError: a value that is not allowed.
    """
    horizon = validation.horizon(chosen.horizon)
    plant = _plant(chosen)
    sensors = _sensors(chosen, plant.size)
    if chosen.filter is None:
        chosen = replace(chosen, filter="kalman" if sensors.unlimited else "tobit")
    system = CensoredSystem(
        plant=plant,
        model=plant,
        centre=make_centre(str(chosen.filter), _FILTERS, chosen, sensors),
        random_start=False,
        state_names=tuple(f"x{i + 1}" for i in range(plant.size)),
        scale=typical_magnitude(plant, horizon, random_start=False),
        reference=plant.open_loop(min(horizon, _REFERENCE_HORIZON)),
        nature=true_nature(chosen, plant, sensors, horizon),
    )
    return Scenario(
        chosen,
        system,
        policy_defaults=stochastic_defaults(chosen),
        feedback=True,
        memory_system=remembering_system(system, chosen.memory_filter, _FILTERS, chosen, sensors),
    )


def _plant(chosen: LinearFusionOptions) -> LinearPlant:
    transition = validation.array("transition", chosen.transition, (None, None))
    size = len(transition)
    mean = np.zeros(size) if chosen.initial_mean is None else chosen.initial_mean
    start = np.eye(size) if chosen.initial_covariance is None else chosen.initial_covariance
    return LinearPlant.create(transition, chosen.process_covariance, mean, start)


def _sensors(chosen: LinearFusionOptions, states: int) -> CensoredSensors:
    """All sensors with as many channels as the largest has; the others' last ones are absent."""
    matrices = _matrices(chosen.measurement_matrices, states)
    sizes = [len(matrix) for matrix in matrices]
    shape = (len(sizes), max(sizes))
    low = _limits("censoring_threshold", chosen.censoring_threshold, sizes, -np.inf)
    high = _limits("censoring_upper", chosen.censoring_upper, sizes, np.inf)
    present = np.arange(shape[1]) < np.array(sizes)[:, None]
    matrix, variance = np.zeros((*shape, states)), np.ones(shape)
    for place, covariance in enumerate(_covariances(chosen.measurement_covariances, sizes)):
        own, size = matrices[place], sizes[place]
        if np.count_nonzero(covariance - np.diag(np.diagonal(covariance))):
            if np.isfinite(low[place]).any() or np.isfinite(high[place]).any():
                raise validation.refusal(
                    f"measurement_covariances[{place}]",
                    covariance,
                    "diagonal, for this sensor is censored, channel by channel",
                )
            own = np.linalg.solve(np.linalg.cholesky(covariance), own)
            covariance = np.eye(size)
        matrix[place, :size], variance[place, :size] = own, np.diagonal(covariance)
    return CensoredSensors.create(matrix, variance, low, states, high, present)


def _matrices(given: Any, states: int) -> list[Array]:
    found = []
    for place, one in enumerate(_each("measurement_matrices", given, "a matrix")):
        name = f"measurement_matrices[{place}]"
        row = _dimensions(one) == 1
        matrix = validation.array(name, one, (states,) if row else (None, states))
        found.append(matrix[None] if row else matrix)
    return found


def _covariances(given: Any, sizes: Sequence[int]) -> list[Array]:
    name, count = "measurement_covariances", len(sizes)
    one = _dimensions(given) == 0
    each = [given] * count if one else _each(name, given, "a covariance or a variance", count)
    found = []
    for place, (size, value) in enumerate(zip(sizes, each, strict=True)):
        full = name if one else f"{name}[{place}]"
        if _dimensions(value) == 0:
            value = validation.number(full, value, above=0.0) * np.eye(size)
        found.append(validation.covariance(full, value, size, definite=True))
    return found


def _limits(name: str, given: Any, sizes: Sequence[int], none: float) -> Array:
    """Limits (sensors, m); ``none`` stands for no limit, as of channels that are absent."""
    one = _dimensions(given) == 0
    each = [given] * len(sizes) if one else _each(name, given, "a number or a list", len(sizes))
    found = np.full((len(sizes), max(sizes)), none)
    for place, (size, value) in enumerate(zip(sizes, each, strict=True)):
        full = name if one else f"{name}[{place}]"
        found[place, :size] = validation.spread(full, value, (size,), infinity=int(np.sign(none)))
    return found


def _each(name: str, given: Any, kind: str, count: int | None = None) -> list[Any]:
    """What is given for each sensor.

    Raises:
        ConfigurationError: no list, an empty one, or another number of sensors.
    """
    listed = isinstance(given, (list, tuple)) or (isinstance(given, np.ndarray) and given.ndim > 0)
    if not listed or not len(given) or (count is not None and len(given) != count):
        many = "each sensor" if count is None else f"each of the {count} sensors"
        raise validation.refusal(name, given, f"a list with {kind} for {many}")
    return list(given)


def _dimensions(value: Any) -> int:
    """How deep a value is nested, by its first entries: ragged ones have no shape."""
    if isinstance(value, np.ndarray):
        return value.ndim
    depth = 0
    while isinstance(value, (list, tuple)):
        depth, value = depth + 1, value[0] if value else 0.0
    return depth + (value.ndim if isinstance(value, np.ndarray) else 0)
