"""The base of a system of one's own: plant, sensors and filter are written, the rest is here."""

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
    """Everything about N runs at one time; n states, l sensors of m channels.

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
    """A plant, its sensors and a filter at the centre, of which four methods are to be written.

    :meth:`move` and :meth:`measure` are the truth, :meth:`predict` and :meth:`update` the filter.
    The centre takes what was delivered in the order of the sensors. Signals, observation, the
    error without transmissions (by simulation) and all else of
    :class:`fusion_gym.core.system.System` follow. All arrays have the batch axis N last.

    Args:
        state_names: a name for each of the n states.
        sensors: their number l.
        channels: numbers that each sensor measures, m.
        process_channels: standard normals that :meth:`move` consumes.
        initial_mean: (n,), of the Gaussian from which the truth starts, and the filter with it.
        initial_covariance: (n, n).

    Raises:
        ConfigurationError: a wrong shape, or a covariance that is not positive semi-definite.
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
        """The next true state (n, N) from the present one and standard normals (channels, N)."""

    @abstractmethod
    def measure(self, state: Array, noise: Array) -> Array:
        """Measurements (l, m, N) of states (n, N), with standard normals (l, m, N); zeros: none."""

    @abstractmethod
    def predict(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """The filter's prediction (n, N), (n, n, N) of the next state."""

    @abstractmethod
    def update(
        self, mean: Array, covariance: Array, sensor: int, measurement: Array
    ) -> tuple[Array, Array]:
        """The filter's estimate (n, N), (n, n, N) after a sensor's measurement (m, N)."""

    @property
    def sensor_count(self) -> int:
        """Number of sensors."""
        return self._sensors

    @property
    def noise_channels(self) -> int:
        """Normals of one step: the plant's, then the sensors'."""
        return self.process_channels + self.sensor_count * self.channels

    @property
    def start_channels(self) -> int:
        """Normals of a start: the state's, then the first measurement's."""
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
        """Time 0: the state is drawn, and every first measurement is known, free of charge."""
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
        """The plant moves, the sensors measure, the centre predicts."""
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
        """The centre takes in what was granted (l, N), sensor by sensor."""
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
        """The signals."""
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
        """The state without the truth; nothing else is hidden."""
        return replace(state, truth=np.full_like(state.truth, np.nan))

    @property
    def imagination_channels(self) -> int:
        """One for each state."""
        return len(self.state_names)

    def imagine(
        self, state: FilteredState, mean: Array, covariance: Array, noise: Array
    ) -> FilteredState:
        """The state with a truth drawn by what is believed."""
        return replace(state, truth=linalg.draw_normal(mean, covariance, noise))

    def adopt(
        self, state: FilteredState, mean: Array, covariance: Array, runs: NDArray[np.bool_]
    ) -> FilteredState:
        """The centre goes on from this estimate in ``runs`` (N,)."""
        return replace(
            state,
            mean=np.where(runs, mean, state.mean),
            covariance=np.where(runs, covariance, state.covariance),
        )

    def local_means(self, state: FilteredState) -> Array:
        """The centre's mean for every sensor, (l, n, N): there are no nodes."""
        return np.broadcast_to(state.mean, (self.sensor_count, *state.mean.shape))

    def open_loop(self, horizon: int) -> Array:
        """Mean squared error (n,) over t = 1..horizon of a centre that only predicts.

        Of 1,000 simulated runs, always the same.
        """
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
        """The innovation's deviation: by secants one deviation of the prediction to either side,
        and by the response to one deviation of the noise."""
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
