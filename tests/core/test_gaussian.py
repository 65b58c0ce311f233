"""Truncated and censored normal moments against many-digit arithmetic, and their properties."""

import warnings
from collections.abc import Callable
from typing import Any

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion_gym import gaussian

TOLERANCE = 1e-10
FLOOR = 1e-300  # below it a result may have underflowed
INFINITY = float("inf")

# Whole and odd steps over the range asked for, and both sides of every change of formula.
Z_GRID = np.unique(
    np.concatenate([np.linspace(-37.0, 40.0, 155), [-1e-9, 0.0, 1e-9, 6.999999, 7.0, 7.000001]])
)
WIDTHS = [1e-3, 0.03, 0.1, 0.37, 0.9, 1.5, 2.99, 3.01, 8.0, 30.0]
LOWS = np.linspace(-45.0, 45.0, 46)


@pytest.fixture(autouse=True)
def many_digits() -> Any:
    """Reference arithmetic with so many digits that cancellation does no harm."""
    with mpmath.workdps(120), warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def exact_density(z: Any) -> Any:
    return mpmath.exp(-(mpmath.mpf(z) ** 2) / 2) / mpmath.sqrt(2 * mpmath.pi)


def exact_tail(z: Any) -> Any:
    return mpmath.erfc(mpmath.mpf(z) / mpmath.sqrt(2)) / 2


def exact_beyond(z: float) -> tuple[Any, Any, Any]:
    """Hazard, excess and variance beyond z."""
    hazard = exact_density(z) / exact_tail(z)
    excess = hazard - mpmath.mpf(z)
    return hazard, excess, 1 - hazard * excess


def exact_inside(low: Any, high: Any) -> tuple[Any, Any, Any]:
    """Probability, mean and variance inside an interval with finite ends."""
    low, high = mpmath.mpf(low), mpmath.mpf(high)
    if low + high < 0:
        probability, mean, variance = exact_inside(-high, -low)
        return probability, -mean, variance
    probability = exact_tail(low) - exact_tail(high)
    mean = (exact_density(low) - exact_density(high)) / probability
    square = 1 + (low * exact_density(low) - high * exact_density(high)) / probability
    return probability, mean, square - mean**2


def error(actual: Any, expected: Any) -> float:
    """Relative error, where both underflow to nothing zero."""
    size = abs(expected)
    return float(abs(mpmath.mpf(float(actual)) - expected) / (size if size > FLOOR else FLOOR))


def worst(actual: Any, expected: list[Any]) -> float:
    return max(error(a, e) for a, e in zip(np.ravel(actual), expected, strict=True))


def test_density_and_upper_tail() -> None:
    assert worst(gaussian.density(Z_GRID), [exact_density(z) for z in Z_GRID]) < TOLERANCE
    assert worst(gaussian.upper_tail(Z_GRID), [exact_tail(z) for z in Z_GRID]) < TOLERANCE


@pytest.mark.parametrize(
    ("function", "position"), [(gaussian.hazard, 0), (gaussian.truncated_variance, 2)]
)
def test_moments_beyond_z(function: Callable[[Any], Any], position: int) -> None:
    expected = [exact_beyond(z)[position] for z in Z_GRID]
    assert worst(function(Z_GRID), expected) < TOLERANCE
    single = [function(float(z)) for z in Z_GRID]
    np.testing.assert_array_equal(single, function(Z_GRID))


def excess_beyond(z: Any) -> Any:
    """Mean distance from z given that z is exceeded."""
    return gaussian.tobit_moments(z).excess


def test_moments_beyond_z_far_out() -> None:
    z = np.geomspace(40.0, 1e8, 60)
    hazard, excess, variance = (
        f(z) for f in (gaussian.hazard, excess_beyond, gaussian.truncated_variance)
    )
    np.testing.assert_allclose(hazard, z + 1 / z, rtol=1e-5)
    np.testing.assert_allclose(excess * z, 1 - 2 / z**2 + 10 / z**4, rtol=1e-7)
    np.testing.assert_allclose(variance * z**2, 1 - 6 / z**2 + 50 / z**4, rtol=1e-6)
    assert np.all(np.diff(hazard) > 0)
    assert np.all(np.diff(excess) < 0)
    assert np.all(np.diff(variance) < 0)


def test_limits_and_nan() -> None:
    z = np.array([-INFINITY, -1e300, -50.0, INFINITY, np.nan])
    moments = gaussian.tobit_moments(z)
    np.testing.assert_array_equal(moments.uncensored_probability, [1, 1, 1, 0, np.nan])
    np.testing.assert_array_equal(moments.hazard, [0, 0, 0, INFINITY, np.nan])
    np.testing.assert_array_equal(moments.excess, [INFINITY, 1e300, 50, 0, np.nan])
    np.testing.assert_array_equal(moments.truncated_variance, [1, 1, 1, 0, np.nan])
    np.testing.assert_array_equal(gaussian.density(z), [0, 0, 0, 0, np.nan])


@pytest.mark.parametrize("shape", [(), (1,), (3, 2, 1), (2, 400)])
def test_tobit_moments_are_the_single_functions(shape: tuple[int, ...]) -> None:
    z = np.random.default_rng(5).normal(0.0, 8.0, shape)
    moments = gaussian.tobit_moments(z)
    for actual, function in zip(
        moments,
        (gaussian.upper_tail, gaussian.hazard, excess_beyond, gaussian.truncated_variance),
        strict=True,
    ):
        assert actual.shape == shape
        assert actual.dtype == np.float64
        np.testing.assert_array_equal(actual, function(z))


@pytest.mark.parametrize("width", WIDTHS)
def test_interval_moments(width: float) -> None:
    lows = np.concatenate([LOWS, [-width / 2 + 1e-7, -0.3 * width, -0.5 * width]])
    highs = lows + width
    expected = [exact_inside(low, high) for low, high in zip(lows, highs, strict=True)]
    probability, mean, variance = gaussian.interval_moments(lows, highs)
    assert worst(probability, [e[0] for e in expected]) < TOLERANCE
    assert worst(variance, [e[2] for e in expected]) < TOLERANCE
    absolute = worst(mean, [e[1] for e in expected])
    assert absolute < TOLERANCE
    near = np.where(np.abs(lows) < np.abs(highs), lows, highs)
    distance = [e[1] - mpmath.mpf(n) for e, n in zip(expected, near, strict=True)]
    # The stored mean itself cannot be closer than its last digit to the near end.
    for m, n, d, e in zip(mean, near, distance, expected, strict=True):
        slack = 4 * np.spacing(abs(float(e[1])))
        assert abs(mpmath.mpf(float(m)) - mpmath.mpf(n) - d) < TOLERANCE / 10 * abs(d) + slack
    single = [gaussian.interval_moments(a, b) for a, b in zip(lows, highs, strict=True)]
    np.testing.assert_array_equal(np.transpose(single), [probability, mean, variance])


def test_interval_moments_of_half_lines_and_the_line() -> None:
    z = np.array([-40.0, -8.0, -1.0, 0.0, 3.0, 12.0, 40.0])
    above = gaussian.interval_moments(z, INFINITY)
    np.testing.assert_allclose(above.probability, gaussian.upper_tail(z), rtol=1e-13)
    np.testing.assert_allclose(above.mean, gaussian.hazard(z), rtol=1e-13, atol=1e-300)
    np.testing.assert_allclose(above.variance, gaussian.truncated_variance(z), rtol=1e-13)
    below = gaussian.interval_moments(-INFINITY, -z)
    np.testing.assert_array_equal(below.mean, -above.mean)
    np.testing.assert_array_equal(below.variance, above.variance)
    assert gaussian.interval_moments(-INFINITY, INFINITY) == (1.0, 0.0, 1.0)


def test_interval_moments_where_the_probability_underflows() -> None:
    low = np.array([60.0, 60.0, 1e4, 1e8, 1e17])
    high = np.array([60.001, 90.0, 1e4 + 1e-3, 1e8 + 1.0, 1e17 + 64.0])
    probability, mean, variance = gaussian.interval_moments(low, high)
    np.testing.assert_array_equal(probability, 0.0)
    with mpmath.workdps(200):
        expected = [exact_inside(a, b) for a, b in zip(low, high, strict=True)]
    assert worst(mean, [e[1] for e in expected]) < TOLERANCE
    assert worst(variance, [e[2] for e in expected]) < TOLERANCE
    assert gaussian.interval_moments(-1e300, -1e299) == (0.0, -1e299, 0.0)


reals = st.floats(-60.0, 60.0)
widths = st.floats(-4.0, 2.0).map(lambda exponent: 10.0**exponent)


@given(low=reals, width=widths)
def test_interval_moments_are_moments(low: float, width: float) -> None:
    high = low + width
    probability, mean, variance = gaussian.interval_moments(low, high)
    ulp = np.spacing(max(abs(low), abs(high)))
    assert 0.0 <= probability <= 1.0
    assert low - ulp <= mean <= high + ulp
    assert 0.0 < variance <= min(1.0, (high - low) ** 2 / 12) * (1 + 1e-12)
    mirrored = gaussian.interval_moments(-high, -low)
    assert mirrored == (probability, -mean, variance)
