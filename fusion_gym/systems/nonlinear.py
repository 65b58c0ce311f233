"""Base class of a nonlinear system of your own: you write plant, sensors and filter."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.control import Controller
from fusion_gym.core.estimator import Reception, SignalValues
from fusion_gym.core.knowledge import (
    Block,
    Signal,
    age_block,
    common_signals,
    log_deviation,
    numbered,
)
from fusion_gym.errors import ConfigurationError
from fusion_gym.systems import bases

_RUNS = 1000  # that tell what happens without transmissions
_SEED = 20_240_229  # of their noise


@dataclass(slots=True)
class FilteredEstimate(bases.Deliveries):
    """The estimate of N runs at one time; n states.

    ``prior_mean`` (n, N), ``prior_covariance`` (n, n, N) · ``mean``, ``covariance``, the posterior
    · ``sampled`` (l, N) bool, the sensors with a reading; ``None`` is all.
    """

    prior_mean: Array
    prior_covariance: Array
    mean: Array
    covariance: Array
    sampled: NDArray[np.bool_] | None = None


class NonlinearSystem(ABC):
    """A plant with sensors and a filter at the centre, of which you write four methods.

    :meth:`move` and :meth:`measure` are the truth, :meth:`predict` and :meth:`update` the filter.
    The centre processes deliveries in the order of the sensors. The class derives signals,
    observation and the simulated error without transmissions. All arrays have the batch axis N
    last.

    Override :meth:`available` for sensors that have no reading at some steps. Such a sensor cannot
    request, its innovation is zero, and the filter does not use its measurement.

    With ``inputs`` a controller closes the loop: you also write :meth:`control` and :meth:`cost`,
    and :meth:`move` and :meth:`predict` take the input as a last argument ``control`` (k, N). Pass
    ``controller`` to the scenario beside ``plant`` and ``estimator``.

    Args:
        state_names: a name for each of the n states.
        sensors: number of sensors l.
        channels: numbers m that each sensor measures.
        process_channels: standard normals that :meth:`move` consumes.
        initial_mean: mean (n,) of the Gaussian initial state, of truth and filter.
        initial_covariance: covariance (n, n) of the initial state.
        inputs: numbers k of a controller's input; 0 for no controller.

    Raises:
        ConfigurationError: a wrong shape, or a covariance that is not positive semi-definite.

    Example:
        >>> from fusion_gym import NonlinearSystem
        >>> class Still(NonlinearSystem):
        ...     def move(self, state, noise):
        ...         return state
        ...
        ...     def measure(self, state, noise):
        ...         return state[None] + 0.1 * noise
        ...
        ...     def predict(self, mean, covariance):
        ...         return mean, covariance
        ...
        ...     def update(self, mean, covariance, sensor, measurement):
        ...         return 0.5 * (mean + measurement), 0.5 * covariance
        >>> start = {"initial_mean": [0.0], "initial_covariance": [[1.0]]}
        >>> Still(("x",), sensors=1, process_channels=0, **start).state_names
        ('x',)
    """

    def __init__(
        self,
        state_names: tuple[str, ...],
        *,
        sensors: int,
        channels: int = 1,
        process_channels: int,
        initial_mean: ArrayLike,
        initial_covariance: ArrayLike,
        inputs: int = 0,
    ) -> None:
        self.state_names = tuple(state_names)
        size = len(self.state_names)
        self.sensors = validation.integer("sensors", sensors, at_least=1)
        self.channels = validation.integer("channels", channels, at_least=1)
        self.process_channels = validation.integer("process_channels", process_channels, at_least=0)
        self.initial_mean = validation.array("initial_mean", initial_mean, (size,))
        self.initial_covariance = validation.covariance(
            "initial_covariance", initial_covariance, size
        )
        self.inputs = validation.integer("inputs", inputs, at_least=0)

    @abstractmethod
    def move(self, state: Array, noise: Array) -> Array:
        """Return the next true state (n, N).

        Args:
            state: the present true state (n, N).
            noise: standard normals (process_channels, N).
        """

    @abstractmethod
    def measure(self, state: Array, noise: Array) -> Array:
        """Return the measurements (l, m, N).

        Args:
            state: true states (n, N).
            noise: standard normals (l, m, N); zeros give noise-free measurements.
        """

    @abstractmethod
    def predict(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Return the filter's prediction (n, N), (n, n, N) of the next state.

        Args:
            mean: posterior mean (n, N).
            covariance: posterior covariance (n, n, N).
        """

    @abstractmethod
    def update(
        self, mean: Array, covariance: Array, sensor: int, measurement: Array
    ) -> tuple[Array, Array]:
        """Return the filter's estimate (n, N), (n, n, N) after one measurement.

        Args:
            mean: prior mean (n, N).
            covariance: prior covariance (n, n, N).
            sensor: the sensor's number.
            measurement: its measurement (m, N).
        """

    def available(self, state: Array, noise: Array) -> NDArray[np.bool_]:
        """Return the sensors (l, N), bool, with a reading at this step, by default all.

        At time 0 every sensor has a reading.

        Args:
            state: true state (n, N), which is measured.
            noise: standard normals (l, N) of the sensors' own dropouts.
        """
        return np.ones(noise.shape, dtype=np.bool_)

    def control(self, mean: Array) -> Array:
        """Return the input (k, N); only with ``inputs``.

        Args:
            mean: estimate (n, N).

        Raises:
            NotImplementedError: the class does not define it.
        """
        raise NotImplementedError(f"{type(self).__name__} does not define 'control'")

    def cost(self, state: Array, control: Array) -> Array:
        """Return the cost (N,) >= 0 of a step; only with ``inputs``.

        Args:
            state: true state (n, N).
            control: input (k, N).

        Raises:
            NotImplementedError: the class does not define it.
        """
        raise NotImplementedError(f"{type(self).__name__} does not define 'cost'")

    def terminated(self, state: Array) -> NDArray[np.bool_] | None:
        """Return the runs (N,), bool, that end here, as a fall does; ``None`` is none.

        The cost of that step is charged for each step that is left. Read only with ``inputs``.

        Args:
            state: true state (n, N).
        """
        return None

    @functools.cached_property
    def controller(self) -> NonlinearController | None:
        """The controller, for a scenario; ``None`` without ``inputs``."""
        for name in ("control", "cost") if self.inputs else ():
            if getattr(type(self), name) is getattr(NonlinearSystem, name):
                reason = f"{type(self).__name__} must define {name!r}"
                raise ConfigurationError(f"inputs = {self.inputs} is not allowed: {reason}")
        return NonlinearController(self) if self.inputs else None

    @functools.cached_property
    def plant(self) -> NonlinearPlant:
        """The truth, for a scenario."""
        return NonlinearPlant(self)

    @functools.cached_property
    def estimator(self) -> NonlinearEstimator:
        """The filter at the centre, for a scenario."""
        return NonlinearEstimator(self)

    @property
    def dropout_channels(self) -> int:
        """Number of standard normals that :meth:`available` takes; 0 if it is not overridden."""
        overridden = type(self).available is not NonlinearSystem.available
        return self.sensors * overridden

    def measured(self, state: Array, noise: Array) -> Array:
        """Return checked measurements (l, m, N) from normals (l * m, N)."""
        shape = (self.sensors, self.channels, state.shape[-1])
        values = np.asarray(self.measure(state, noise.reshape(shape)), dtype=np.float64)
        if values.shape != shape:
            raise ValueError(
                f"measure of shape {values.shape} is not allowed: it must be {shape}, sensors, "
                "channels and runs"
            )
        return values

    @functools.cached_property
    def typical(self) -> tuple[Array, Array]:
        """Root mean square and open-loop error variance (n,) of each state, over ten steps."""
        moment, error = self.silence(10)
        return np.sqrt(np.maximum(moment, 1e-12)), np.maximum(error, 1e-12)

    def silence(self, horizon: int) -> tuple[Array, Array]:
        """Mean second moment and squared error (n,) over t = 1..horizon without transmissions.

        A controller of the second moment knows the state.
        """
        generator, plant, filters = np.random.default_rng(_SEED), self.plant, self.estimator
        truth, _ = plant.start(generator.standard_normal((plant.start_channels, _RUNS)))
        state = filters.start(truth.measurement, None)
        nobody = Reception(np.zeros((self.sensors, _RUNS), dtype=np.bool_))
        moment = error = np.zeros(len(self.state_names))
        controller, known = self.controller, truth
        for _ in range(horizon):
            noise = generator.standard_normal((plant.noise_channels, _RUNS))
            inputs = () if controller is None else (controller.act(state.mean),)
            moving = inputs if controller is None else (controller.act(known.truth),)
            known = plant.sense(known, noise, *moving)
            truth = known if controller is None else plant.sense(truth, noise, *inputs)
            state = filters.update(filters.predict(state, *inputs), nobody)
            moment = moment + (known.truth**2).mean(-1)
            error = error + ((truth.truth - state.mean) ** 2).mean(-1)
        return moment / horizon, error / horizon


class NonlinearController(Controller):
    """The controller of a :class:`NonlinearSystem`."""

    def __init__(self, system: NonlinearSystem) -> None:
        self.system = system

    def act(self, mean: Array) -> Array:
        """Return the system's input."""
        return _checked("control", self.system.control(mean), (self.system.inputs, mean.shape[-1]))

    def cost(self, state: bases.Truth, control: Array) -> Array:
        """Return the system's cost."""
        cost = _checked("cost", self.system.cost(state.truth, control), control.shape[-1:])
        if not np.all(cost >= 0.0):
            raise ValueError(f"cost of {cost.min()} is not allowed: it must be >= 0")
        return cost

    def terminated(self, state: bases.Truth) -> NDArray[np.bool_] | None:
        """Return the runs that the system ends."""
        return self.system.terminated(state.truth)


def _checked(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return what a user's method returned, of this shape."""
    result = np.asarray(values, dtype=np.float64)
    if result.shape != shape:
        raise ValueError(f"{name} of shape {result.shape} is not allowed: it must be {shape}")
    return result


class NonlinearPlant(bases.NormalPlant):
    """The truth of a :class:`NonlinearSystem`."""

    def __init__(self, system: NonlinearSystem) -> None:
        self.system, self.state_names = system, system.state_names

    @property
    def sensor_count(self) -> int:
        """Number of sensors."""
        return self.system.sensors

    @property
    def noise_channels(self) -> int:
        """Normals of one step: plant, then sensors, then their dropouts."""
        own, system = self.system.sensors * self.system.channels, self.system
        return system.process_channels + own + system.dropout_channels

    @property
    def start_channels(self) -> int:
        """Normals of a start: state, then first measurement."""
        return len(self.state_names) + self.system.sensors * self.system.channels

    def start(self, noise: Array) -> tuple[bases.Truth, None]:
        """Draw the initial state, and measure."""
        size, system = len(self.state_names), self.system
        mean = np.repeat(system.initial_mean[:, None], noise.shape[-1], axis=1)
        truth = mean + linalg.root(system.initial_covariance[..., None])[..., 0] @ noise[:size]
        time = np.zeros(noise.shape[-1])
        return bases.Truth(truth, system.measured(truth, noise[size:]), None, time), None

    def sense(self, state: bases.Truth, noise: Array, *control: Array) -> bases.Truth:
        """Move the plant, and measure; a run that has ended rests. NaN is no reading."""
        own, over = self.system.process_channels, self._over(state)
        if bool(control) != bool(self.system.inputs):
            system = type(self.system).__name__
            raise ConfigurationError(
                f"inputs = {self.system.inputs} is not allowed here: a scenario of {system} needs "
                "its controller"
            )
        truth = self.system.move(state.truth, noise[:own], *control)
        truth = truth if over is None else np.where(over, state.truth, truth)
        last = self.noise_channels - self.system.dropout_channels
        measurement, rest = self.system.measured(truth, noise[own:last]), noise[last:]
        if self.system.dropout_channels:
            present = _checked("available", self.system.available(truth, rest), rest.shape)
            measurement = np.where(present[:, None], measurement, np.nan)
        return bases.Truth(truth, measurement, None, state.time + 1.0)

    def available(self, state: bases.Truth) -> tuple[NDArray[Any], NDArray[Any]] | None:
        """See :class:`Plant`; a run that has ended has no readings."""
        over, present = self._over(state), ~np.isnan(state.measurement[:, 0])
        if over is None and not self.system.dropout_channels:
            return None
        present = present if over is None else present & ~over
        return present, np.ones(state.truth.shape, dtype=np.bool_)

    def _over(self, state: bases.Truth) -> NDArray[np.bool_] | None:
        """Return the runs (N,) that have ended."""
        controller = self.system.controller
        return None if controller is None else controller.terminated(state)

    def open_loop(self, horizon: int) -> Array:
        """Return the mean squared error (n,) of predictions over t = 1..horizon in 1,000 runs."""
        return self.system.silence(horizon)[1]


class NonlinearEstimator(bases.AdoptingEstimator[FilteredEstimate]):
    """The filter of a :class:`NonlinearSystem`, at the centre."""

    def __init__(self, system: NonlinearSystem) -> None:
        self.system = system

    @property
    def signals(self) -> tuple[Signal, ...]:  # type: ignore[override]
        """See :class:`Estimator`."""
        return common_signals() + (bases.SAMPLED,) * bool(self.system.dropout_channels)

    @property
    def observation(self) -> tuple[Block, ...]:
        """Blocks of the observation."""
        nodes, names = numbered(self.system.sensors), self.system.state_names
        magnitude, reference = self.system.typical
        labels = nodes, numbered(self.system.channels)
        new = partial(Block, labels=labels, knowledge="own", node="own", limit=bases.RANGE)
        return (
            new(
                "whitened_innovation",
                "innovation over its predicted deviation",
                lambda s: (s.measurement - self._expected(s)) / self._deviation(s),
            ),
            new(
                "held_difference",
                "new minus last delivered measurement, over twice the innovation's deviation",
                lambda s: (s.measurement - s.held) / (2.0 * self._deviation(s)),
            ),
            age_block(nodes),
            bases.variance_block(
                lambda s: 2.0 * log_deviation(s.prior_covariance, reference), names, reference
            ),
            bases.prior_block(names, magnitude),
        )

    def start(self, measurement: Array, announcement: None) -> FilteredEstimate:
        """Return the law of the initial state; every first measurement is known without charge."""
        runs, system = measurement.shape[-1], self.system
        mean = np.repeat(system.initial_mean[:, None], runs, axis=1)
        covariance = np.repeat(system.initial_covariance[..., None], runs, axis=-1)
        return FilteredEstimate.begin(measurement, mean, covariance, mean, covariance)

    def predict(self, state: FilteredEstimate, *control: Array) -> FilteredEstimate:
        """Predict."""
        mean, covariance = self.system.predict(state.mean, state.covariance, *control)
        return state.later(prior_mean=mean, prior_covariance=linalg.symmetrise(covariance))

    def observe(self, state: FilteredEstimate, measurement: Array) -> FilteredEstimate:
        """See :class:`Estimator`; a sensor without a reading has the expectation."""
        if not self.system.dropout_channels:
            return super().observe(state, measurement)
        sampled = ~np.isnan(measurement[:, 0])
        measurement = np.where(sampled[:, None], measurement, self._expected(state))
        return replace(state, measurement=measurement, sampled=sampled)

    def update(self, state: FilteredEstimate, reception: Reception) -> FilteredEstimate:
        """Update the centre with the measurements that arrive, sensor by sensor."""
        mean, covariance, arrived = state.prior_mean, state.prior_covariance, reception.arrived
        if state.sampled is not None:
            arrived = arrived & state.sampled
        for sensor in np.flatnonzero(arrived.any(1)).tolist():
            first, other = self.system.update(mean, covariance, sensor, state.measurement[sensor])
            mean = np.where(arrived[sensor], first, mean)
            covariance = np.where(arrived[sensor], linalg.symmetrise(other), covariance)
        return state.after(arrived, mean=mean, covariance=covariance)

    def read(self, state: FilteredEstimate, failure: Array | None = None) -> SignalValues:
        """Return the signals."""
        return {
            **super().read(state, failure),
            "innovation": lambda: state.measurement - self._expected(state),
            "expected_measurement": lambda: self._expected(state),
            "innovation_deviation": lambda: self._deviation(state),
            "silent_variance": lambda: linalg.trace(state.prior_covariance),
            "variance_reduction": lambda: self._reduction(state),
        }

    def _expected(self, state: FilteredEstimate) -> Array:
        shape = (self.system.sensors * self.system.channels, state.prior_mean.shape[-1])
        return self.system.measured(state.prior_mean, np.zeros(shape))

    def _deviation(self, state: FilteredEstimate) -> Array:
        """Return the innovation's deviation, by secants over one deviation of each source."""
        mean, measured = state.prior_mean, self.system.measured
        nothing = np.zeros((self.system.sensors * self.system.channels, mean.shape[-1]))
        variance = (measured(mean, nothing + 1.0) - measured(mean, nothing)) ** 2
        root = linalg.root(state.prior_covariance)
        for column in range(root.shape[1]):
            ahead = measured(mean + root[:, column], nothing)
            behind = measured(mean - root[:, column], nothing)
            variance = variance + (0.5 * (ahead - behind)) ** 2
        return np.sqrt(variance) + 1e-12

    def _reduction(self, state: FilteredEstimate) -> Array:
        mean, covariance = state.prior_mean, state.prior_covariance
        expected = self._expected(state)
        single = [
            linalg.trace(self.system.update(mean, covariance, sensor, expected[sensor])[1])
            for sensor in range(self.system.sensors)
        ]
        sampled: Any = True if state.sampled is None else state.sampled
        return np.where(sampled, linalg.trace(covariance) - np.array(single), 0.0)
