"""Base classes of states, plants and estimators, and blocks that several families share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.estimator import Estimator, StateT
from fusion_gym.core.knowledge import Block, Signal, log_deviation
from fusion_gym.core.plant import Plant
from fusion_gym.namespace import namespace

RANGE = 5.0  # whitened quantities and logarithms of ratios are clipped here
SAMPLED = Signal("sampled", "own", "(sensors, N)", "whether the sensor has a reading")


@dataclass(slots=True)
class Truth:
    """The true state of N runs at one time; n states, l sensors, m channels.

    ``truth`` (n, N) · ``measurement`` (l, m, N) · ``departure`` (4, N) of the truth from the model,
    if any · ``time`` (N,), sensings since the start.
    """

    truth: Array
    measurement: Array
    departure: Array | None
    time: NDArray[Any]


class NormalPlant(Plant[Truth]):
    """A plant of which a policy imagines nothing but the truth."""

    @property
    def draw_channels(self) -> int:
        """Number of states."""
        return len(self.state_names)

    def draw(
        self, measurement: Array, mean: Array, covariance: Array, noise: Array, time: Array
    ) -> Truth:
        """Draw the truth from N(mean, covariance)."""
        return Truth(linalg.draw_normal(mean, covariance, noise), measurement, None, time)


@dataclass(slots=True)
class Deliveries:
    """What nodes and centre have of l sensors in N runs.

    ``measurement`` (l, m, N) · ``held``, the last delivered one · ``age`` (l, N), steps since then.
    """

    measurement: Array
    held: Array
    age: Array

    @classmethod
    def begin(cls, measurement: Array, *fields: Any) -> Self:
        """Return the state at time 0 from measurements that are delivered, and the other fields."""
        age = np.zeros((len(measurement), measurement.shape[-1]))
        return cls(measurement, measurement, age, *fields)

    def later(self, **changes: Any) -> Self:
        """Return the state one step later, with changes of other fields."""
        return replace(self, age=self.age + 1.0, **changes)

    def after(self, arrived: NDArray[np.bool_], sent: Array | None = None, **changes: Any) -> Self:
        """Return the state after packets (l, N), with changes of other fields.

        They carry what is ``sent`` (l, …, N), by default the measurements.
        """
        sent = self.measurement if sent is None else sent
        xp = namespace(arrived, sent)
        held = xp.where(arrived[:, None], sent, self.held)
        return replace(self, held=held, age=xp.where(arrived, 0.0, self.age), **changes)


class SensorPlant(Plant[StateT]):
    """A plant of dynamics and sensors, each with its own normals."""

    dynamics: Any
    sensors: Any
    traceable = True

    @property
    def sensor_count(self) -> int:
        """Number of sensors."""
        return self.sensors.count

    @property
    def noise_channels(self) -> int:
        """Normals of one step: process noise, then the sensors'."""
        return self.dynamics.noise_channels + self.sensors.noise_channels

    def open_loop(self, horizon: int) -> Array:
        """Return the mean error variance (n,) over t = 1..horizon without any delivery."""
        return self.dynamics.open_loop(horizon)


class AdoptingEstimator(Estimator[StateT]):
    """An estimator that continues from the fields ``mean`` and ``covariance`` of its state."""

    def adopt(self, state: StateT, mean: Array, covariance: Array, runs: NDArray[Any]) -> StateT:
        """See :class:`Estimator`."""
        before: Any = state
        mean = np.where(runs, mean, before.mean)
        return replace(before, mean=mean, covariance=np.where(runs, covariance, before.covariance))


@dataclass(frozen=True)
class ScaledEstimator(Estimator[StateT]):
    """An estimator whose observation is relative to the open loop.

    ``state_weights`` (n,) weigh the traces among the signals, ``magnitude`` (n,) divides observed
    estimates and ``reference`` (n,) observed variances.
    """

    state_names: tuple[str, ...]
    state_weights: Array
    magnitude: Array
    reference: Array
    traceable = True

    def trace(self, covariance: Array) -> Array:
        """Return the weighted trace (N,) of a covariance (n, n, N)."""
        return linalg.weighted_trace(covariance, self.state_weights)

    def estimate_block(self, meaning: str, mean: Callable[[Any], Array]) -> Block:
        """Return the block of the centre's ``mean`` (n, N) of a state."""
        return estimate_block(meaning, mean, self.state_names, self.magnitude)

    def deviation_block(
        self, name: str, whose: str, covariance: Callable[[Any], Array], *nodes: tuple[str, ...]
    ) -> Block:
        """Return a block of logarithms of deviations, of the centre or of ``nodes``."""
        return Block(
            name,
            f"logarithm of {whose} over the open-loop deviation",
            lambda state: log_deviation(covariance(state), self.reference),
            (*nodes, self.state_names),
            node="own" if nodes else "hidden",
            limit=RANGE,
            constants={"open-loop deviation": np.sqrt(self.reference)},
        )


def estimate_block(
    meaning: str,
    mean: Callable[[Any], Array],
    names: tuple[str, ...],
    magnitude: Array,
    node: Literal["broadcast", "hidden"] = "hidden",
) -> Block:
    """Return the block of the centre's ``mean`` (n, N) of a state, over ``magnitude`` (n,)."""
    return Block(
        "estimate",
        meaning,
        lambda state: mean(state) / magnitude[:, None],
        (names,),
        node=node,
        limit=RANGE,
        constants={"root mean square": magnitude},
    )


def prior_block(names: tuple[str, ...], magnitude: Array) -> Block:
    """Return the block of the prediction ``prior_mean``, which is broadcast."""
    meaning = "prediction over the state's root mean square"
    return estimate_block(meaning, lambda s: s.prior_mean, names, magnitude, "broadcast")


def variance_block(
    value: Callable[[Any], Array], names: tuple[str, ...], reference: Array
) -> Block:
    """Return the block of logarithms of predicted variances over ``reference`` (n,)."""
    return Block(
        "log_variance",
        "logarithm of the predicted variance over its open-loop mean",
        value,
        (names,),
        node="broadcast",
        limit=RANGE,
        constants={"open-loop mean": reference},
    )


def trigger_parameters(
    options: Any, names: tuple[str, ...], sensors: int, usual: Mapping[str, ArrayLike] | None = None
) -> dict[str, tuple[float, ...]]:
    """Return a policy's parameters from ``trigger_*``, numbers >= 0, one for each sensor.

    ``usual`` has the values of parameters that are ``None``, for any number of sensors.
    """
    result = {}
    for name in names:
        value = getattr(options, field := f"trigger_{name}")
        value = np.resize((usual or {})[name], sensors) if value is None else value
        result[name] = tuple(validation.not_negative(field, value, (sensors,)).tolist())
    return result


def numbered_states(size: int, usual: tuple[str, ...] = ()) -> tuple[str, ...]:
    """Return the ``usual`` names of the states where they fit, else x1, x2 and so on."""
    return usual if len(usual) == size else tuple(f"x{i + 1}" for i in range(size))
