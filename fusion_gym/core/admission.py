"""Whether float64 can hold a system over an episode: by its moments before, its numbers in it."""

from bisect import bisect_left
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.core.system import System
from fusion_gym.errors import ConfigurationError, DivergenceError

# By comparison with 50 digits: within them, means are right to 1e-9 of a deviation, variances too.
LARGEST_ERROR = 1e32  # of squares on average: rewards are also handed on as float32
_LARGEST_SIGNAL, _LARGEST_LOSS = 1e12, 1e7


def admit(system: System[Any], horizon: int) -> Array:
    """Return the error variances (n,) of a centre that never receives, of a system that fits.

    Raises:
        ConfigurationError: over the horizon they grow beyond all bounds, or states so far beyond
            their noise that nothing is left of its digits; names the longest horizon that fits.
    """
    open_loop = system.open_loop(horizon)
    if _fits(system, horizon):
        return open_loop
    signal, variance = system.rounding(horizon)
    why = (
        f"float64 holds a mean squared error without transmissions up to {LARGEST_ERROR:g} (here "
        f"{open_loop.max():.3g}), measurements with a mean square up to {_LARGEST_SIGNAL:g} times "
        f"their noise's variance (here {signal:.3g}), and variances of which a packet leaves one "
        f"part in {_LARGEST_LOSS:g} (here in {variance:.3g})"
    )
    # What is lost rises with the horizon.
    longest = bisect_left(range(1, horizon), True, key=lambda steps: not _fits(system, steps))
    if not longest:
        raise ConfigurationError(f"these numbers together are not allowed: {why}")
    raise ConfigurationError(
        f"horizon = {horizon} is not allowed with this plant and these sensors: it must be at most "
        f"{longest}, for {why}"
    )


def _fits(system: System[Any], horizon: int) -> bool:
    lost = np.array((system.open_loop(horizon).max(), *system.rounding(horizon)))
    return bool((lost <= (LARGEST_ERROR, _LARGEST_SIGNAL, _LARGEST_LOSS)).all())


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
