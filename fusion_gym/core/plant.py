"""The contract of a plant: the truth that no policy knows, and its sensors."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Any, Generic, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.declaration import NumpyOnly, OptionGroup
from fusion_gym.errors import ConfigurationError, refusal
from fusion_gym.namespace import ndtr

# Option of each row of a departure, and the reason why an environment may refuse it.
DEPARTURES = {
    "true_process_noise": "the plant has no process noise",
    "true_measurement_noise": "the sensors measure without noise",
    "true_threshold_shift": "no sensor is censored",
    "true_transition": "only noise and input move the plant",
}
_SHIFT = "true_threshold_shift"
_MODEL = (1.0, 1.0, 0.0, 1.0)  # no departure
_FACTORS = (1e-3, 1e3)
_LARGEST_GROWTH = 1e24  # of the plant's second moment over an episode


@dataclass(frozen=True)
class TruthOptions(OptionGroup):
    """The options of the departure of the truth from the model."""

    true_process_noise: Annotated[ArrayLike, NumpyOnly()] = 1.0
    """Factor of the true standard deviation of the process noise. The filters assume 1. A pair
    (low, high) is a range from which each episode draws."""
    true_measurement_noise: Annotated[ArrayLike, NumpyOnly()] = 1.0
    """Factor of the true standard deviation of the measurement noise. The filters assume 1. A pair
    (low, high) is a range from which each episode draws."""
    true_threshold_shift: Annotated[ArrayLike, NumpyOnly()] = 0.0
    """Shift of the true censoring limits of the sensors. The filters assume 0. A pair (low, high)
    is a range from which each episode draws."""
    true_transition: Annotated[ArrayLike, NumpyOnly()] = 1.0
    """Factor c of the true motion, from x to x + c (f(x) - x). The filters assume f(x). A pair
    (low, high) is a range from which each episode draws."""


@dataclass(frozen=True)
class Nature:
    """The range of the departure of the truth from the model that filters and policies assume.

    A departure (4, N) has the factors of the standard deviations of process and measurement noise,
    the shift of the sensors' limits, and the factor c of the motion from x to x + c (f(x) - x);
    ``None`` is no departure. Each episode draws between ``low`` and ``high``, factors uniformly in
    the logarithm, the shift uniformly.

    Args:
        low: Lower ends (4,).
        high: Upper ends (4,); equal ends need no draw.
    """

    low: tuple[float, ...] = _MODEL
    high: tuple[float, ...] = _MODEL

    @classmethod
    def create(cls, options: TruthOptions, absent: Collection[str] = ()) -> Nature:
        """Return the departure that the options declare.

        Args:
            options: The options.
            absent: Options without an effect in this environment.

        Raises:
            ConfigurationError: An option is neither a number nor a rising pair (low, high), a
                factor is outside 0.001 to 1000, or an absent option departs from the model.
        """
        pairs = [_span(name, getattr(options, name)) for name in DEPARTURES]
        nature = cls(*(tuple(ends) for ends in zip(*pairs, strict=True)))
        for name in nature.departing:
            if name in absent:
                model = _MODEL[list(DEPARTURES).index(name)]
                allowed = f"{model:g} here, because {DEPARTURES[name]}"
                raise refusal(name, getattr(options, name), allowed)
        return nature

    @property
    def departing(self) -> tuple[str, ...]:
        """Names of the options that depart from the model."""
        ends = zip(DEPARTURES, self.low, self.high, _MODEL, strict=True)
        return tuple(name for name, low, high, model in ends if not low == high == model)

    @property
    def channels(self) -> int:
        """Number of standard normals at the end of a start: one per option with a range."""
        return sum(low < high for low, high in zip(self.low, self.high, strict=True))

    def begin(self, noise: Array) -> tuple[Array, Array | None]:
        """Return the system's normals, and the departure (4, N) from the last :attr:`channels`."""
        if not self.departing:
            return noise, None
        own, last = np.split(noise, (len(noise) - self.channels,))
        uniform = iter(ndtr(last))
        departure = np.empty((len(self.low), noise.shape[-1]))
        for row, (name, low, high) in enumerate(zip(DEPARTURES, self.low, self.high, strict=True)):
            if low == high:
                departure[row] = low
            elif name == _SHIFT:
                departure[row] = low + (high - low) * next(uniform)
            else:
                departure[row] = low * (high / low) ** next(uniform)
        return own, departure

    def check_growth(self, radius: Callable[[float], float], horizon: int) -> None:
        """Raise an error if the true plant with spectral radius ``radius(c)`` grows too much."""
        ends = {self.low[-1], self.high[-1]} - {_MODEL[-1]}
        largest = max((radius(end) for end in ends), default=0.0)
        if 2.0 * horizon * np.log10(max(largest, 1.0)) > np.log10(_LARGEST_GROWTH):
            raise ConfigurationError(
                f"true_transition = {self._range('true_transition')} is not allowed with horizon "
                f"= {horizon}: the true plant has the spectral radius {largest:.4g}, and its "
                f"second moment may grow at most {_LARGEST_GROWTH:g} times in an episode"
            )

    def refuse(self, where: str, why: str = "it needs the assumed truth") -> None:
        """Raise an error if the truth departs from the model, with place and reason."""
        for name in self.departing:
            raise ConfigurationError(
                f"{name} = {self._range(name)} is not allowed {where}: it must be "
                f"{_MODEL[list(DEPARTURES).index(name)]:g}, because {why}"
            )

    def _range(self, name: str) -> str:
        row = list(DEPARTURES).index(name)
        low, high = self.low[row], self.high[row]
        return f"{low:g}" if low == high else f"[{low:g}, {high:g}]"


AS_ASSUMED = Nature()


def _span(name: str, value: Any) -> tuple[float, float]:
    """Return both ends of an option's range, equal for a number."""
    low, high = validation.spread(name, value, (2,)).tolist()
    least, most = (-np.inf, np.inf) if name == _SHIFT else _FACTORS
    if not (least <= low and high <= most and (np.ndim(value) == 0 or low < high)):
        limits = "" if name == _SHIFT else f" from {least:g} to {most:g}"
        raise refusal(name, value, f"a number{limits}, or such a pair (low, high), low < high")
    return low, high


def true_noise(departure: Array | None, process: Array, measurement: Array) -> tuple[Array, Array]:
    """Return the true noises (…, N) of process and measurement from the model's noises."""
    if departure is None:
        return process, measurement
    return departure[0] * process, departure[1] * measurement


def true_motion(departure: Array | None, state: Array, moved: Array) -> Array:
    """Return the true next state x + c (f(x) - x) from x (n, N) and ``moved`` = f(x)."""
    return moved if departure is None else moved + (departure[3] - 1.0) * (moved - state)


def true_limits(departure: Array | None, limit: Array) -> Array:
    """Return the true limits (…, N) of the sensors from the model's limits (…, 1)."""
    return limit if departure is None else limit + departure[2]


StateT = TypeVar("StateT")
_NOTHING: Mapping[int, tuple[float, float]] = MappingProxyType({})


class Plant(ABC, Generic[StateT]):
    """Define a plant and its sensors for N runs at once.

    A state is a dataclass of arrays whose last axis is the batch; no method changes a state in
    place. In the shapes below n is the number of states, l of sensors, m of a sensor's channels.
    A state has the fields ``truth`` (n, N) and ``measurement`` (l, m, N), or the class overrides
    :meth:`truth` and :meth:`measurement`.

    Attributes:
        state_names: Names of the n states.
        nature: Departure of the truth from the model.
        traceable: Whether JAX traces the methods, so that compiled code and JAX run them, too.
        branches: Whether a state can be moved twice, by different inputs or noise.
        censored_beyond: Lowest and highest uncensored value of a state, by its number, for
            pictures.

    Example:
        >>> import numpy as np
        >>> import fusion_gym
        >>> plant = fusion_gym.make_task("fusion_gym/TobitOscillator-v1").plant
        >>> state, _ = plant.start(np.zeros((plant.start_channels, 4)))
        >>> state = plant.sense(state, np.zeros((plant.noise_channels, 4)))
        >>> plant.truth(state).shape, plant.measurement(state).shape
        ((2, 4), (3, 2, 4))
    """

    state_names: tuple[str, ...]
    nature: Nature = AS_ASSUMED
    traceable: bool = False
    branches: bool = True
    censored_beyond: Mapping[int, tuple[float, float]] = _NOTHING

    @property
    @abstractmethod
    def sensor_count(self) -> int:
        """Number of sensors."""

    @property
    @abstractmethod
    def noise_channels(self) -> int:
        """Number of standard normals that :meth:`sense` takes per run."""

    @property
    @abstractmethod
    def start_channels(self) -> int:
        """Number of standard normals that :meth:`start` takes per run, including ``nature``."""

    @abstractmethod
    def start(self, noise: Array) -> tuple[StateT, Any]:
        """Return the state at time 0, and what the estimator knows of the start.

        A measurement of NaN is none.

        Args:
            noise: Standard normals (start_channels, N).
        """

    @abstractmethod
    def sense(self, state: StateT, noise: Array) -> StateT:
        """Return the state after a step of the plant and the new measurements.

        With a :class:`~fusion_gym.core.control.Controller` it takes the input ``control`` (k, N).

        Args:
            state: Any state.
            noise: Standard normals (noise_channels, N).
        """

    def truth(self, state: StateT) -> Array:
        """Return the plant's state (n, N), for the reward and metrics, never for a policy.

        Args:
            state: Any state.
        """
        truth: Array = cast(Any, state).truth
        return truth

    def measurement(self, state: StateT) -> Array:
        """Return the new measurements (l, m, N).

        Args:
            state: State after :meth:`sense` or :meth:`start`.
        """
        measurement: Array = cast(Any, state).measurement
        return measurement

    @property
    def draw_channels(self) -> int | None:
        """Number of standard normals that :meth:`draw` takes per run; ``None`` if it cannot."""
        return None

    def draw(
        self, measurement: Array, mean: Array, covariance: Array, noise: Array, time: Array
    ) -> StateT:
        """Return a state that a policy imagines from a belief.

        The truth follows N(mean, covariance), and other quantities follow their own laws without a
        departure from the model.

        Args:
            measurement: The new measurements (l, m, N), which the state has.
            mean: (n, N).
            covariance: (n, n, N).
            noise: Standard normals (draw_channels, N).
            time: Sensings since the start (N,).
        """
        raise NotImplementedError(f"{type(self).__name__} does not offer 'draw'")

    def available(self, state: StateT) -> tuple[NDArray[Any], NDArray[Any]] | None:
        """Return the sensors (l, N) with a reading and the states (n, N) of known truth.

        A sensor without a reading cannot request, and errors of other states count as zero.
        ``None`` is all.

        Args:
            state: State after :meth:`sense`.
        """
        return None

    @abstractmethod
    def open_loop(self, horizon: int) -> Array:
        """Return the mean error variance (n,) over t = 1..horizon without any delivery.

        Args:
            horizon: Steps of an episode.
        """

    def rounding(self, horizon: int) -> tuple[float, float]:
        """Return two ratios that bound the loss of float64's precision; 0 if unknown.

        Args:
            horizon: Steps of an episode.

        Returns:
            The largest mean square of a measurement over its noise variance, and the largest ratio
            of a predicted variance to the variance after a packet that ends a silence.
        """
        return 0.0, 0.0


LARGEST_ERROR = 1e32  # mean square; rewards become float32
# Relative errors above the first value give a warning, above the second an error.
_RIGHT, _WRONG = 1e-9, 0.2
# Factors of the ratios of `Plant.rounding`, fitted to 50-digit computations.
_OF_SIGNAL, _OF_LOSS = 2.0, 0.13
_PRECISION = float(np.finfo(np.float64).eps)


def admit(plant: Plant[Any], horizon: int) -> Array:
    """Return the open-loop error variances (n,) of a plant that float64 can simulate.

    Args:
        plant: The plant; an accuracy of its estimates below 1e-9 gives a warning.
        horizon: Steps of an episode.

    Raises:
        ConfigurationError: The variances exceed ``LARGEST_ERROR``, or rounding errors exceed 20 %.
            The message has the longest horizon that is allowed.
    """
    open_loop = plant.open_loop(horizon)
    accuracy = _accuracy(plant, horizon, open_loop)
    if accuracy <= _RIGHT:
        return open_loop
    if accuracy <= _WRONG:
        warnings.warn(
            f"horizon = {horizon} with this plant and these sensors: rounding errors may reach "
            f"{accuracy:.0e} of a deviation in means, and {accuracy:.0e} of their size in "
            "variances",
            stacklevel=2,
        )
        return open_loop
    largest = np.nan_to_num(open_loop.max(), nan=np.inf)
    signal, variance = plant.rounding(horizon)
    signals, variances = (_WRONG / _OF_SIGNAL / _PRECISION) ** 2, _WRONG / _OF_LOSS / _PRECISION
    why = (
        f"float64 allows mean squared errors up to {LARGEST_ERROR:g} without transmissions (here "
        f"{largest:.3g}), mean squares of measurements up to {signals:.0e} noise variances (here "
        f"{signal:.3g}), and reductions of a variance to one part in {variances:.0e} by a packet "
        f"(here in {variance:.3g})"
    )
    # The loss of accuracy grows with the horizon.
    longest = bisect_left(
        range(1, horizon),
        True,
        key=lambda steps: not _accuracy(plant, steps, plant.open_loop(steps)) <= _WRONG,
    )
    if not longest:
        raise ConfigurationError(f"these numbers together are not allowed: {why}")
    allowed = f"at most {longest}, because {why}"
    raise refusal("horizon", horizon, allowed, "with this plant and these sensors")


def _accuracy(plant: Plant[Any], horizon: int, open_loop: Array) -> float:
    """Estimate the largest relative rounding error of means (in deviations) and variances."""
    if not open_loop.max() <= LARGEST_ERROR:
        return np.inf
    signal, loss = plant.rounding(horizon)
    return _PRECISION * float(np.maximum(_OF_SIGNAL * np.sqrt(signal), _OF_LOSS * loss))
