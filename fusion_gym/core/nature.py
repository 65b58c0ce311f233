"""The departure of the truth from the model that filters and policies assume."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.declaration import NumpyOnly, OptionGroup
from fusion_gym.errors import ConfigurationError, refusal

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
