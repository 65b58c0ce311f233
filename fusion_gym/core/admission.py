"""How much of a system float64 holds over an episode: by its moments before, its numbers in it."""

import warnings
from bisect import bisect_left
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.core.system import System
from fusion_gym.errors import ConfigurationError, DivergenceError

LARGEST_ERROR = 1e32  # of squares on average: rewards are also handed on as float32
# Means, in deviations, and variances that are right to the first need no warning; of more than the
# second nothing reliable is left.
_RIGHT, _WRONG = 1e-9, 0.2
# Of float64's precision times a ratio of `System.rounding`, by comparison with 50 digits.
_OF_SIGNAL, _OF_LOSS = 2.0, 0.13
_PRECISION = float(np.finfo(np.float64).eps)


def admit(system: System[Any], horizon: int) -> Array:
    """Return the error variances (n,) of a centre that never receives, of a system that fits.

    Warn where estimates are less accurate than 1e-9, with the accuracy that is left.

    Raises:
        ConfigurationError: over the horizon they grow beyond all bounds, or states so far beyond
            their noise that nothing is left of its digits; names the longest horizon that fits.
    """
    open_loop = system.open_loop(horizon)
    accuracy = _accuracy(system, horizon)
    if accuracy <= _RIGHT:
        return open_loop
    if accuracy <= _WRONG:
        warnings.warn(
            f"horizon = {horizon} with this plant and these sensors: in the worst case float64 "
            f"holds means only to about {accuracy:.0e} of a deviation, and variances to about "
            f"{accuracy:.0e} of their size",
            stacklevel=2,
        )
        return open_loop
    largest = np.nan_to_num(open_loop.max(), nan=np.inf)
    signal, variance = system.rounding(horizon)
    signals, variances = (_WRONG / _OF_SIGNAL / _PRECISION) ** 2, _WRONG / _OF_LOSS / _PRECISION
    why = (
        f"float64 holds a mean squared error without transmissions up to {LARGEST_ERROR:g} (here "
        f"{largest:.3g}), measurements with a mean square up to {signals:.0e} times their noise's "
        f"variance (here {signal:.3g}), and variances of which a packet leaves one part in "
        f"{variances:.0e} (here in {variance:.3g})"
    )
    # What is lost rises with the horizon.
    longest = bisect_left(
        range(1, horizon), True, key=lambda steps: not _accuracy(system, steps) <= _WRONG
    )
    if not longest:
        raise ConfigurationError(f"these numbers together are not allowed: {why}")
    raise ConfigurationError(
        f"horizon = {horizon} is not allowed with this plant and these sensors: it must be at most "
        f"{longest}, for {why}"
    )


def _accuracy(system: System[Any], horizon: int) -> float:
    """Estimate the largest error of means, in deviations, and of variances, over their size.

    It may be ten times as large, after a long silence, and is often a hundred times smaller.
    """
    if not system.open_loop(horizon).max() <= LARGEST_ERROR:
        return np.inf
    signal, loss = system.rounding(horizon)
    return _PRECISION * float(np.maximum(_OF_SIGNAL * np.sqrt(signal), _OF_LOSS * loss))


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
