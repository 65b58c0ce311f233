"""Whether float64 can hold a system over an episode: by its moments before, its numbers in it."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.core.system import System
from fusion_gym.errors import ConfigurationError, DivergenceError

_LARGEST_ERROR = 1e32  # of squares on average: rewards are also handed on as float32
_LARGEST_SIGNAL = 1e12  # over the noise: a rounding is then 1e-10 of the noise's deviation


def admit(system: System[Any], horizon: int) -> Array:
    """Return the error variances (n,) of a centre that never receives, of a system that fits.

    Raises:
        ConfigurationError: over the horizon they grow beyond all bounds, or the state so far beyond
            its noise that the noise has no digits left; names the longest horizon that is allowed.
    """
    open_loop = system.open_loop(horizon)
    error, signal = float(open_loop.max()), system.signal_to_noise(horizon)
    if error <= _LARGEST_ERROR and signal <= _LARGEST_SIGNAL:
        return open_loop
    why = (
        f"without transmissions the mean squared error reaches {error:.3g} (at most "
        f"{_LARGEST_ERROR:g}), and the mean square of a measured state {signal:.3g} times the "
        f"noise's variance (at most {_LARGEST_SIGNAL:g})"
    )
    longest = _longest(system, horizon)
    if not longest:
        raise ConfigurationError(f"these numbers together are not allowed: {why}")
    raise ConfigurationError(
        f"horizon = {horizon} is not allowed with this plant and these sensors: it must be at most "
        f"{longest}, for {why}"
    )


def require_finite(
    values: Mapping[str, Array], finished: NDArray[np.bool_], steps: NDArray[np.int64]
) -> None:
    """Pass by values (…, N) of N runs that are finite wherever a run is not ``finished``.

    Raises:
        DivergenceError: names the first run with one that is not, its step and the quantity.
    """
    for name, value in values.items():
        lost = ~np.isfinite(value).reshape(-1, len(steps)).all(0) & ~finished
        if lost.any():
            run = int(lost.argmax())
            raise DivergenceError(f"run {run}, step {steps[run]}: the {name} is not finite")


def _longest(system: System[Any], refused: int) -> int:
    """The longest horizon below a refused one that fits, 0 for none; the ratios rise with it."""

    def fits(horizon: int) -> bool:
        error, signal = system.open_loop(horizon), system.signal_to_noise(horizon)
        return bool(np.all(error <= _LARGEST_ERROR)) and signal <= _LARGEST_SIGNAL

    low, high = 0, 1
    while high < refused and fits(high):
        low, high = high, 2 * high
    high = min(high, refused)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low
