"""The limits of float64 over an episode: a check of moments before it, and of values during it."""

import warnings
from bisect import bisect_left
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.core.plant import Plant
from fusion_gym.errors import ConfigurationError, DivergenceError, refusal

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


def require_finite(
    values: Mapping[str, Array], finished: NDArray[np.bool_], steps: NDArray[np.int64]
) -> None:
    """Raise a ``DivergenceError`` if a value (…, N) of an unfinished run is not finite."""
    for name, value in values.items():
        lost = ~np.isfinite(value).reshape(-1, len(steps)).all(0) & ~finished
        if lost.any():
            run = int(lost.argmax())
            raise DivergenceError(f"run {run}, step {steps[run]}: the {name} is not finite")
