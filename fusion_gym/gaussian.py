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

from fusion_gym.namespace import as_array, erfcx, in_lanes, namespace, ndtr

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


def _far_tail(z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return hazard, excess and variance beyond z of at least `_FAR`, by the continued fraction."""
    remainder = _TERMS / z
    for k in range(_TERMS - 1, 1, -1):
        remainder = k / (z + remainder)
    excess = 1.0 / (z + remainder)
    return z + excess, excess, excess * (remainder - excess)


def _tail(z: FloatArray, scaled: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return hazard, excess and variance beyond z from scaled = erfcx(z / sqrt 2)."""
    xp = namespace(z, scaled)
    hazard_ = xp.asarray(_HAZARD_SCALE / scaled)
    excess = xp.asarray(hazard_ - z)
    variance = xp.asarray(1.0 - hazard_ * xp.minimum(excess, 1e300))
    results = in_lanes(z > _FAR, _far_tail, (z,), (hazard_, excess, variance), (_FAR + 1.0,))
    return results[0], results[1], results[2]


@np.errstate(all="ignore")
def _beyond(z: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return hazard, excess and variance beyond z."""
    values = as_array(z)
    return _tail(values, erfcx(_ROOT_HALF * values))


@np.errstate(all="ignore")
def density(z: ArrayLike) -> FloatArray:
    """Return the standard normal density ``phi(z) = exp(-z^2 / 2) / sqrt(2 pi)``."""
    values = as_array(z)
    return _DENSITY_SCALE * namespace(values).exp(-0.5 * values * values)


@np.errstate(all="ignore")
def upper_tail(z: ArrayLike) -> FloatArray:
    """Return the probability ``Q(z) = 1 - Phi(z)`` of exceeding z, accurate in the tail."""
    return ndtr(-as_array(z))


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
    values = as_array(z)
    return TobitMoments(ndtr(-values), *_tail(values, erfcx(_ROOT_HALF * values)))


def _truncate(near: FloatArray, width: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Replace ends beyond which the probability is zero by finite ones."""
    xp = namespace(near, width)
    near = xp.maximum(near, -_OUTER)
    return near, xp.minimum(width, _OUTER - xp.minimum(near, 0.0))


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
    xp, far = namespace(near, width), near + width
    ends = xp.stack(xp.broadcast_arrays(near, far))
    scaled = erfcx(_ROOT_HALF * ends)
    hazards, excesses, variances = _tail(ends, scaled)
    drop = 0.5 * width * (near + far)
    rho = scaled[1] / scaled[0] * xp.exp(-drop)
    share = 1.0 - rho
    rise = -xp.expm1(-drop)
    offset = xp.asarray((excesses[0] - rho * (excesses[1] + width)) / share)
    gap = width + excesses[1] - offset
    results = (
        xp.asarray(ndtr(-near) * share),
        offset,
        xp.asarray(hazards[0] * rise / share),
        xp.asarray((variances[0] - rho * variances[1]) / share - rho * gap * gap),
    )
    narrow = width * (1.0 + 0.5 * (near + far)) < _NARROW
    inside = in_lanes(narrow, _quadrature, (near, width, rise), results, (0.0, 1.0, 1.0))
    return inside[0], inside[1], inside[2], inside[3]


def _quadrature(
    start: FloatArray, span: FloatArray, rise: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the results of :func:`_inside` for narrow intervals (k,)."""
    # The nodes lie on the last axis, so that every element has the same order of summation.
    step = span[:, None] * _NODES
    values = _WEIGHTS * namespace(start, span).exp(-step * (start[:, None] + 0.5 * step))
    mass = values.sum(axis=-1)
    centre = (values * _NODES).sum(axis=-1) / mass
    deviation = _NODES - centre[:, None]
    variance = span * span * (values * deviation * deviation).sum(axis=-1) / mass
    return density(start) * span * mass, span * centre, rise / (span * mass), variance


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
    lower, upper = as_array(low), as_array(high)
    xp, ordered = namespace(lower, upper), lower < upper
    if xp is np and not ordered.all():
        lows, highs = np.broadcast_arrays(lower, upper)
        first = np.unravel_index(int(np.argmin(ordered)), ordered.shape)
        raise ValueError(
            f"low = {lows[first]} and high = {highs[first]} are not allowed: low must be below high"
        )
    flip = lower + upper < 0.0
    near, width = _truncate(xp.where(flip, -upper, lower), upper - lower)
    probability, _, mean, variance = _inside(near, width)
    return IntervalMoments(probability, xp.where(flip, -mean, mean), variance)
