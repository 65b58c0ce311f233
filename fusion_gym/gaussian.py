"""Moments of truncated and censored normal variables, accurate far into the tails.

Every function works element by element on arrays of any broadcastable shapes (plain floats
included), in float64, and never issues a NumPy warning; a NaN in gives a NaN out. A result for
floats only is a NumPy float64 scalar or an array of shape ``()``. Standardised arguments are
dimensionless.

With phi and Phi the standard normal density and distribution function and Q = 1 - Phi, a normal
variable known to exceed z has

* hazard       ``h = phi(z) / Q(z)``        its mean (the inverse Mills ratio),
* excess       ``d = h - z``                its mean distance from z,
* variance     ``v = 1 - h d``.

The hazard comes from the scaled complementary error function, ``h = sqrt(2/pi) / erfcx(z/sqrt 2)``,
which neither overflows nor underflows for z above -38. Far above zero d and v lose digits as the
difference of nearly equal numbers; there they come from the continued fraction of Laplace
(Abramowitz and Stegun, Handbook of Mathematical Functions, 26.2.14),
``d = 1 / (z + r)`` with ``r = 2 / (z + 3 / (z + 4 / (z + ...)))``, whence ``v = d (r - d)``.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erfcx, ndtr

FloatArray = NDArray[np.float64]

_ROOT_HALF = float(np.sqrt(0.5))
_HAZARD_SCALE = float(np.sqrt(2.0 / np.pi))
_DENSITY_SCALE = float(1.0 / np.sqrt(2.0 * np.pi))

# From this z on, 20 terms of the continued fraction are exact to float64 (5e-16), while the
# direct formula for the variance has lost at most four digits up to here (1e-12).
_FAR = 7.0
_TERMS = 20

# The tail underflows beyond 39, so such an end of an interval is equivalent to infinity.
_OUTER = 100.0

# Intervals with width * (1 + |midpoint|) below the limit: the density varies by less than a
# factor of about 20, and 12 Gauss-Legendre nodes integrate it to float64.
_NARROW = 3.0
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)
_NODES = 0.5 * (1.0 + _NODES)
_WEIGHTS = 0.5 * _WEIGHTS


class TobitMoments(NamedTuple):
    """Moments of a standard normal that is observed only above z, each of z's shape."""

    uncensored_probability: FloatArray
    """Q(z), the probability of exceeding z."""
    hazard: FloatArray
    """h, the mean given that z is exceeded."""
    excess: FloatArray
    """d = h - z, the mean distance from z given that z is exceeded."""
    truncated_variance: FloatArray
    """v = 1 - h d, the variance given that z is exceeded."""


class IntervalMoments(NamedTuple):
    """Probability of an interval, and mean and variance of a standard normal in it."""

    probability: FloatArray
    mean: FloatArray
    variance: FloatArray


def _far_tail(z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return excess and variance beyond z from the continued fraction, for z at least `_FAR`."""
    remainder = _TERMS / z
    for k in range(_TERMS - 1, 1, -1):
        remainder = k / (z + remainder)
    excess = 1.0 / (z + remainder)
    return excess, excess * (remainder - excess)


def _tail(z: FloatArray, scaled: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return hazard, excess and variance beyond z from scaled = erfcx(z / sqrt 2)."""
    hazard_ = np.asarray(_HAZARD_SCALE / scaled)
    excess = np.asarray(hazard_ - z)
    variance = np.asarray(1.0 - hazard_ * np.minimum(excess, 1e300))
    far = z > _FAR
    if far.any():
        z_far = z[far]
        excess[far], variance[far] = _far_tail(z_far)
        hazard_[far] = z_far + excess[far]
    return hazard_, excess, variance


@np.errstate(all="ignore")
def _beyond(z: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return hazard, excess and variance beyond z."""
    z = np.asarray(z, dtype=np.float64)
    return _tail(z, erfcx(_ROOT_HALF * z))


@np.errstate(all="ignore")
def density(z: ArrayLike) -> FloatArray:
    """Return the standard normal density ``phi(z) = exp(-z^2 / 2) / sqrt(2 pi)``."""
    z = np.asarray(z, dtype=np.float64)
    return _DENSITY_SCALE * np.exp(-0.5 * z * z)


@np.errstate(all="ignore")
def upper_tail(z: ArrayLike) -> FloatArray:
    """Return the probability ``Q(z) = 1 - Phi(z)`` of exceeding z, accurate in the tail."""
    return ndtr(-np.asarray(z, dtype=np.float64))


def hazard(z: ArrayLike) -> FloatArray:
    """Return the mean ``phi(z) / Q(z)`` of a standard normal given that it exceeds z."""
    return _beyond(z)[0]


def truncated_variance(z: ArrayLike) -> FloatArray:
    """Return the variance ``1 - h (h - z)`` of a standard normal given that it exceeds z."""
    return _beyond(z)[2]


@np.errstate(all="ignore")
def tobit_moments(z: ArrayLike) -> TobitMoments:
    """Return tail probability, hazard, excess and truncated variance, each of z's shape.

    Args:
        z: ``(threshold - predicted measurement) / standard deviation``. Minus infinity stands
            for no threshold: probability 1, hazard 0, infinite excess, variance 1.
    """
    z = np.asarray(z, dtype=np.float64)
    return TobitMoments(ndtr(-z), *_tail(z, erfcx(_ROOT_HALF * z)))


def _truncate(near: FloatArray, width: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Replace ends beyond which the probability is zero by finite ones."""
    near = np.maximum(near, -_OUTER)
    return near, np.minimum(width, _OUTER - np.minimum(near, 0.0))


def _inside(
    near: FloatArray, width: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return probability, distance of the mean from the near end, mean and variance in an interval.

    The general formulas subtract the tail beyond the far end from the tail beyond the near end,
    weighted by rho = Q(far) / Q(near). For narrow intervals they cancel, and Gauss-Legendre
    quadrature integrates the density relative to its value at the near end.

    Args:
        near: Near end, finite; the midpoint is not below zero.
        width: Width of the interval, finite.
    """
    far = near + width
    ends = np.stack(np.broadcast_arrays(near, far))
    scaled = erfcx(_ROOT_HALF * ends)
    hazards, excesses, variances = _tail(ends, scaled)
    drop = 0.5 * width * (near + far)
    rho = scaled[1] / scaled[0] * np.exp(-drop)
    share = 1.0 - rho
    rise = -np.expm1(-drop)
    probability = np.asarray(ndtr(-near) * share)
    mean = np.asarray(hazards[0] * rise / share)
    offset = np.asarray((excesses[0] - rho * (excesses[1] + width)) / share)
    gap = width + excesses[1] - offset
    variance = np.asarray((variances[0] - rho * variances[1]) / share - rho * gap * gap)

    narrow = width * (1.0 + 0.5 * (near + far)) < _NARROW
    if narrow.any():
        # The nodes lie on the last axis, so that every element has the same order of summation.
        start, span = near[narrow], width[narrow]
        step = span[:, None] * _NODES
        values = _WEIGHTS * np.exp(-step * (start[:, None] + 0.5 * step))
        mass = values.sum(axis=-1)
        centre = (values * _NODES).sum(axis=-1) / mass
        deviation = _NODES - centre[:, None]
        probability[narrow] = density(start) * span * mass
        offset[narrow] = span * centre
        mean[narrow] = rise[narrow] / (span * mass)
        variance[narrow] = span * span * (values * deviation * deviation).sum(axis=-1) / mass
    return probability, offset, mean, variance


@np.errstate(all="ignore")
def interval_moments(low: ArrayLike, high: ArrayLike) -> IntervalMoments:
    """Return the probability of ``low < z < high`` and the moments of z given that.

    Args:
        low: Lower end; minus infinity is allowed.
        high: Upper end, broadcasting with `low`; infinity is allowed.

    Returns:
        Probability, mean and variance, each of the broadcast shape. Mean and variance are accurate
        even where the probability underflows to zero, some 38 deviations out.

    Raises:
        ValueError: `low` is not below `high` somewhere, or one of them is NaN.
    """
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    ordered = low < high
    if not ordered.all():
        lows, highs = np.broadcast_arrays(low, high)
        first = np.unravel_index(int(np.argmin(ordered)), ordered.shape)
        raise ValueError(
            f"low = {lows[first]} and high = {highs[first]} are not allowed: low must be below high"
        )
    flip = low + high < 0.0
    near, width = _truncate(np.where(flip, -high, low), high - low)
    probability, _, mean, variance = _inside(near, width)
    return IntervalMoments(probability, np.where(flip, -mean, mean), variance)
