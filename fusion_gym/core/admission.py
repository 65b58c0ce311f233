"""Whether float64 can hold a system over an episode: by its moments before, its numbers in it."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.core.system import Rounding, System
from fusion_gym.errors import ConfigurationError, DivergenceError

# By comparison with 50 digits: within them, means are right to 1e-9 of a deviation, variances too.
_LARGEST_ERROR = 1e32  # of squares on average: rewards are also handed on as float32
_LARGEST_SIGNAL, _LARGEST_LOSS = 1e12, 1e7


def admit(system: System[Any], horizon: int) -> Array:
    """Return the error variances (n,) of a centre that never receives, of a system that fits.

    Raises:
        ConfigurationError: over the horizon they grow beyond all bounds, or states so far beyond
            their noise that nothing is left of its digits; names the longest horizon that fits.
    """
    open_loop = system.open_loop(horizon)
    error, rounding = float(open_loop.max()), system.rounding(horizon)
    if _fits(error, rounding):
        return open_loop
    why = (
        f"float64 holds a mean squared error without transmissions up to {_LARGEST_ERROR:g} (here "
        f"{error:.3g}), measurements with a mean square up to {_LARGEST_SIGNAL:g} times their "
        f"noise's variance (here {rounding.signal:.3g}), and variances of which a packet leaves "
        f"one part in {_LARGEST_LOSS:g} (here in {rounding.variance:.3g})"
    )
    longest = _longest(system, horizon)
    if not longest:
        raise ConfigurationError(f"these numbers together are not allowed: {why}")
    raise ConfigurationError(
        f"horizon = {horizon} is not allowed with this plant and these sensors: it must be at most "
        f"{longest}, for {why}"
    )


def _fits(error: float, rounding: Rounding) -> bool:
    signal, variance = rounding
    return error <= _LARGEST_ERROR and signal <= _LARGEST_SIGNAL and variance <= _LARGEST_LOSS


def _longest(system: System[Any], refused: int) -> int:
    """The longest horizon below a refused one that fits, 0 for none; what is lost rises with it."""

    def fits(horizon: int) -> bool:
        return _fits(float(system.open_loop(horizon).max()), system.rounding(horizon))

    low, high = 0, 1
    while high < refused and fits(high):
        low, high = high, 2 * high
    high = min(high, refused)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


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
