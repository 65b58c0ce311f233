"""Base class of a nonlinear system of your own: you write plant, sensors and filter."""

import functools
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.system import (
    Block,
    SignalArray,
    System,
    age_block,
    common_signals,
    log_deviation,
    numbered,
)

_RUNS = 1000  # that tell what happens without transmissions
_SEED = 20_240_229  # of their noise
_RANGE = 5.0  # whitened quantities and logarithms of variance ratios are clipped here


@dataclass(slots=True)
class FilteredState:
    """The state of N runs at one time; n states, l sensors of m channels.

    ``truth`` (n, N) · ``measurement`` and ``held``, the last delivered one, (l, m, N) · ``age``
    (l, N) · ``prior_mean`` (n, N), ``prior_covariance`` (n, n, N) · ``mean``, ``covariance``, the
    posterior.
    """

    truth: Array
    measurement: Array
    held: Array
    age: Array
    prior_mean: Array
    prior_covariance: Array
    mean: Array
    covariance: Array


class NonlinearSystem(System[FilteredState]):
    """A plant with sensors and a filter at the centre, of which you write four methods.

    :meth:`move` and :meth:`measure` are the truth, :meth:`predict` and :meth:`update` the filter.
    The centre processes deliveries in the order of the sensors. The class derives signals,
    observation and the simulated error without transmissions. All arrays have the batch axis N
    last.

    Args:
        state_names: a name for each of the n states.
        sensors: number of sensors l.
        channels: numbers m that each sensor measures.
        process_channels: standard normals that :meth:`move` consumes.
        initial_mean: mean (n,) of the Gaussian initial state, of truth and filter.
        initial_covariance: covariance (n, n) of the initial state.

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

    signals = common_signals()
    extensions = ("move", "measure", "predict", "update")

    def __init__(
        self,
        state_names: tuple[str, ...],
        *,
        sensors: int,
        channels: int = 1,
        process_channels: int,
        initial_mean: ArrayLike,
        initial_covariance: ArrayLike,
    ) -> None:
        self.state_names = tuple(state_names)
        size = len(self.state_names)
        self._sensors = validation.integer("sensors", sensors, at_least=1)
        self.channels = validation.integer("channels", channels, at_least=1)
        self.process_channels = validation.integer("process_channels", process_channels, at_least=0)
        self.initial_mean = validation.array("initial_mean", initial_mean, (size,))
        self.initial_covariance = validation.covariance(
            "initial_covariance", initial_covariance, size
        )

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

    @property
    def sensor_count(self) -> int:
        """Number of sensors."""
        return self._sensors

    @property
    def noise_channels(self) -> int:
        """Normals of one step: plant, then sensors."""
        return self.process_channels + self.sensor_count * self.channels

    @property
    def start_channels(self) -> int:
        """Normals of a start: state, then first measurement."""
        return len(self.state_names) + self.sensor_count * self.channels

    @property
    def observation(self) -> tuple[Block, ...]:
        """Blocks of the observation."""
        nodes, entries = numbered(self.sensor_count), numbered(self.channels)
        return (
            Block(
                "whitened_innovation",
                "innovation over its predicted deviation",
                lambda s: (s.measurement - self._expected(s)) / self._deviation(s),
                (nodes, entries),
                knowledge="own",
                node="own",
                limit=_RANGE,
            ),
            Block(
                "held_difference",
                "new minus last delivered measurement, over twice the innovation's deviation",
                lambda s: (s.measurement - s.held) / (2.0 * self._deviation(s)),
                (nodes, entries),
                knowledge="own",
                node="own",
                limit=_RANGE,
            ),
            age_block(nodes),
            Block(
                "log_variance",
                "logarithm of the predicted variance over its open-loop mean",
                lambda s: 2.0 * log_deviation(s.prior_covariance, self._typical[1]),
                (self.state_names,),
                node="broadcast",
                limit=_RANGE,
                constants={"open-loop mean": self._typical[1]},
            ),
            Block(
                "estimate",
                "prediction over the state's root mean square",
                lambda s: s.prior_mean / self._typical[0][:, None],
                (self.state_names,),
                node="broadcast",
                limit=_RANGE,
                constants={"root mean square": self._typical[0]},
            ),
        )

    def start(self, noise: Array) -> FilteredState:
        """Draw the initial state; every first measurement is known without charge."""
        size, runs = len(self.state_names), noise.shape[-1]
        mean = np.repeat(self.initial_mean[:, None], runs, axis=1)
        truth = mean + linalg.root(self.initial_covariance[..., None])[..., 0] @ noise[:size]
        measurement = self._measured(truth, noise[size:])
        covariance = np.repeat(self.initial_covariance[..., None], runs, axis=-1)
        age = np.zeros((self.sensor_count, runs))
        return FilteredState(
            truth, measurement, measurement, age, mean, covariance, mean, covariance
        )

    def sense(self, state: FilteredState, noise: Array) -> FilteredState:
        """Move the plant, measure, and predict."""
        own = self.process_channels
        truth = self.move(state.truth, noise[:own])
        prior_mean, prior_covariance = self.predict(state.mean, state.covariance)
        return replace(
            state,
            truth=truth,
            measurement=self._measured(truth, noise[own:]),
            age=state.age + 1.0,
            prior_mean=prior_mean,
            prior_covariance=linalg.symmetrise(prior_covariance),
        )

    def deliver(self, state: FilteredState, granted: NDArray[np.bool_]) -> FilteredState:
        """Update the centre with the granted (l, N) measurements, sensor by sensor."""
        mean, covariance = state.prior_mean, state.prior_covariance
        for sensor in np.flatnonzero(granted.any(1)).tolist():
            first, other = self.update(mean, covariance, sensor, state.measurement[sensor])
            mean = np.where(granted[sensor], first, mean)
            covariance = np.where(granted[sensor], linalg.symmetrise(other), covariance)
        return replace(
            state,
            held=np.where(granted[:, None], state.measurement, state.held),
            age=np.where(granted, 0.0, state.age),
            mean=mean,
            covariance=covariance,
        )

    def read(self, state: FilteredState) -> Mapping[str, SignalArray | Callable[[], SignalArray]]:
        """Return the signals."""
        return {
            "measurement": state.measurement,
            "innovation": lambda: state.measurement - self._expected(state),
            "held": state.held,
            "age": state.age,
            "expected_measurement": lambda: self._expected(state),
            "innovation_deviation": lambda: self._deviation(state),
            "prior_mean": state.prior_mean,
            "prior_covariance": state.prior_covariance,
            "silent_variance": lambda: linalg.trace(state.prior_covariance),
            "variance_reduction": lambda: self._reduction(state),
        }

    def visible(self, state: FilteredState) -> FilteredState:
        """Return the state without the truth."""
        return replace(state, truth=np.full_like(state.truth, np.nan))

    @property
    def imagination_channels(self) -> int:
        """Number of states."""
        return len(self.state_names)

    def imagine(
        self, state: FilteredState, mean: Array, covariance: Array, noise: Array
    ) -> FilteredState:
        """Return the state with a truth drawn from N(mean, covariance)."""
        return replace(state, truth=linalg.draw_normal(mean, covariance, noise))

    def adopt(
        self, state: FilteredState, mean: Array, covariance: Array, runs: NDArray[np.bool_]
    ) -> FilteredState:
        """Replace the centre's estimate in ``runs`` (N,)."""
        return replace(
            state,
            mean=np.where(runs, mean, state.mean),
            covariance=np.where(runs, covariance, state.covariance),
        )

    def local_means(self, state: FilteredState) -> Array:
        """Return the centre's mean for every sensor (l, n, N); the system has no nodes."""
        return np.broadcast_to(state.mean, (self.sensor_count, *state.mean.shape))

    def open_loop(self, horizon: int) -> Array:
        """Return the mean squared error (n,) of predictions over t = 1..horizon in 1,000 runs."""
        return self._silence(horizon)[1]

    def _measured(self, state: Array, noise: Array) -> Array:
        shape = (self.sensor_count, self.channels, state.shape[-1])
        values = np.asarray(self.measure(state, noise.reshape(shape)), dtype=np.float64)
        if values.shape != shape:
            raise ValueError(
                f"measure of shape {values.shape} is not allowed: it must be {shape}, sensors, "
                "channels and runs"
            )
        return values

    def _expected(self, state: FilteredState) -> Array:
        shape = (self.sensor_count * self.channels, state.prior_mean.shape[-1])
        return self._measured(state.prior_mean, np.zeros(shape))

    def _deviation(self, state: FilteredState) -> Array:
        """Return the innovation's deviation, by secants over one deviation of each source."""
        mean = state.prior_mean
        nothing = np.zeros((self.sensor_count * self.channels, mean.shape[-1]))
        variance = (self._measured(mean, nothing + 1.0) - self._measured(mean, nothing)) ** 2
        root = linalg.root(state.prior_covariance)
        for column in range(root.shape[1]):
            ahead = self._measured(mean + root[:, column], nothing)
            behind = self._measured(mean - root[:, column], nothing)
            variance = variance + (0.5 * (ahead - behind)) ** 2
        return np.sqrt(variance) + 1e-12

    def _reduction(self, state: FilteredState) -> Array:
        mean, covariance = state.prior_mean, state.prior_covariance
        expected = self._expected(state)
        single = [
            linalg.trace(self.update(mean, covariance, sensor, expected[sensor])[1])
            for sensor in range(self.sensor_count)
        ]
        return linalg.trace(covariance) - np.array(single)

    @functools.cached_property
    def _typical(self) -> tuple[Array, Array]:
        """Root mean square and open-loop error variance (n,) of each state, over ten steps."""
        moment, error = self._silence(10)
        return np.sqrt(np.maximum(moment, 1e-12)), np.maximum(error, 1e-12)

    def _silence(self, horizon: int) -> tuple[Array, Array]:
        """Mean second moment and squared error (n,) over t = 1..horizon without transmissions."""
        generator = np.random.default_rng(_SEED)
        state = self.start(generator.standard_normal((self.start_channels, _RUNS)))
        nobody = np.zeros((self.sensor_count, _RUNS), dtype=np.bool_)
        moment = error = np.zeros(len(self.state_names))
        for _ in range(horizon):
            noise = generator.standard_normal((self.noise_channels, _RUNS))
            state = self.deliver(self.sense(state, noise), nobody)
            moment = moment + (state.truth**2).mean(-1)
            error = error + ((state.truth - state.mean) ** 2).mean(-1)
        return moment / horizon, error / horizon
