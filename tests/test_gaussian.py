"""Truncated and censored normal moments against many-digit arithmetic, and their properties."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
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


def exact_censored(mean: float, std: float, lower: float, upper: float) -> tuple[Any, Any, Any]:
    """Mean, variance and distance of the mean from the nearer threshold of clip(x, lower, upper).

    From the first two moments about the nearer threshold. One threshold may be infinite.
    """
    centre, deviation = mpmath.mpf(mean), mpmath.mpf(std)
    if abs(upper - mean) < abs(lower - mean):
        value, variance, distance = exact_censored(-mean, std, -upper, -lower)
        return -value, variance, distance
    low = (mpmath.mpf(lower) - centre) / deviation
    if upper == INFINITY:
        hazard, excess, _ = exact_beyond(low)
        first = exact_tail(low) * excess
        second = exact_tail(low) * (1 + low * hazard - 2 * low * hazard + low**2)
    else:
        high = (mpmath.mpf(upper) - centre) / deviation
        probability, inside, variance = exact_inside(low, high)
        first = probability * (inside - low) + exact_tail(high) * (high - low)
        second = probability * (variance + (inside - low) ** 2)
        second += exact_tail(high) * (high - low) ** 2
    distance = deviation * first
    return mpmath.mpf(lower) + distance, deviation**2 * (second - first**2), distance


def error(actual: Any, expected: Any) -> float:
    """Relative error, where both underflow to nothing zero."""
    size = abs(expected)
    return float(abs(mpmath.mpf(float(actual)) - expected) / (size if size > FLOOR else FLOOR))


def worst(actual: Any, expected: list[Any]) -> float:
    return max(error(a, e) for a, e in zip(np.ravel(actual), expected, strict=True))


def test_reference_agrees_with_quadrature() -> None:
    for low, high in [(-2, 3), (4, 6), (-1, 1)]:
        points = mpmath.linspace(low, high, 6)
        moments = [mpmath.quad(lambda x, n=n: x**n * exact_density(x), points) for n in range(3)]
        probability, mean, variance = exact_inside(low, high)
        assert abs(probability - moments[0]) < mpmath.mpf("1e-60")
        assert abs(mean - moments[1] / moments[0]) < mpmath.mpf("1e-55")
        square = moments[2] / moments[0] - (moments[1] / moments[0]) ** 2
        assert abs(variance - square) < mpmath.mpf("1e-50")
        total = [
            mpmath.quad(lambda x, n=n: (2 * x + 1) ** n * exact_density(x), points)
            + (2 * mpmath.mpf(low) + 1) ** n * exact_tail(-low)
            + (2 * mpmath.mpf(high) + 1) ** n * exact_tail(high)
            for n in (1, 2)
        ]
        censored = exact_censored(1.0, 2.0, 2.0 * low + 1.0, 2.0 * high + 1.0)
        assert abs(censored[0] - total[0]) < mpmath.mpf("1e-55")
        assert abs(censored[1] - (total[1] - total[0] ** 2)) < mpmath.mpf("1e-50")
    hazard, _, variance = exact_beyond(1.0)
    truncated = exact_inside(1.0, 40.0)
    assert abs(hazard - truncated[1]) < mpmath.mpf("1e-100")
    assert abs(variance - truncated[2]) < mpmath.mpf("1e-100")
    one_sided = exact_censored(0.0, 1.0, 1.0, INFINITY)
    two_sided = exact_censored(0.0, 1.0, 1.0, 40.0)
    assert abs(one_sided[0] - two_sided[0]) < mpmath.mpf("1e-100")
    assert abs(one_sided[1] - two_sided[1]) < mpmath.mpf("1e-100")


def test_density_and_upper_tail() -> None:
    assert worst(gaussian.density(Z_GRID), [exact_density(z) for z in Z_GRID]) < TOLERANCE
    assert worst(gaussian.upper_tail(Z_GRID), [exact_tail(z) for z in Z_GRID]) < TOLERANCE


@pytest.mark.parametrize(
    ("function", "position"),
    [(gaussian.hazard, 0), (gaussian.hazard_excess, 1), (gaussian.truncated_variance, 2)],
)
def test_moments_beyond_z(function: Callable[[Any], Any], position: int) -> None:
    expected = [exact_beyond(z)[position] for z in Z_GRID]
    assert worst(function(Z_GRID), expected) < TOLERANCE
    alone = [function(float(z)) for z in Z_GRID]
    np.testing.assert_array_equal(alone, function(Z_GRID))


def test_moments_beyond_z_far_out() -> None:
    z = np.geomspace(40.0, 1e8, 60)
    hazard, excess, variance = (
        f(z) for f in (gaussian.hazard, gaussian.hazard_excess, gaussian.truncated_variance)
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
        (
            gaussian.upper_tail,
            gaussian.hazard,
            gaussian.hazard_excess,
            gaussian.truncated_variance,
        ),
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
    alone = [gaussian.interval_moments(a, b) for a, b in zip(lows, highs, strict=True)]
    np.testing.assert_array_equal(np.transpose(alone), [probability, mean, variance])


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


@pytest.mark.parametrize("threshold", [0.0, -3.5, 250.0])
@pytest.mark.parametrize("std", [1.0, 2e-3, 70.0])
def test_one_sided_censoring(threshold: float, std: float) -> None:
    means = threshold + std * np.linspace(-40.0, 40.0, 81)
    expected = [exact_censored(m, std, threshold, INFINITY) for m in means]
    for arguments in [(threshold,), (threshold, None), (threshold, INFINITY)]:
        mean = gaussian.censored_mean(means, std, *arguments)
        variance = gaussian.censored_variance(means, std, *arguments)
        assert worst(mean, [e[0] for e in expected]) < TOLERANCE
        assert worst(variance, [e[1] for e in expected]) < TOLERANCE
    for lower in (None, -INFINITY):
        mirrored = gaussian.censored_mean(-means, std, lower, -threshold)
        assert worst(mirrored, [-e[0] for e in expected]) < TOLERANCE
        mirrored = gaussian.censored_variance(-means, std, lower, -threshold)
        assert worst(mirrored, [e[1] for e in expected]) < TOLERANCE


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("std", [1.0, 0.01])
def test_two_sided_censoring(width: float, std: float) -> None:
    means = std * LOWS
    lower, upper = 0.0, std * width  # a threshold at zero shows the distance from it
    expected = [exact_censored(m, std, lower, upper) for m in means]
    mean = gaussian.censored_mean(means, std, lower, upper)
    variance = gaussian.censored_variance(means, std, lower, upper)
    assert worst(mean, [e[0] for e in expected]) < TOLERANCE
    assert worst(variance, [e[1] for e in expected]) < TOLERANCE
    mean = gaussian.censored_mean(-means, std, -upper, -lower)
    np.testing.assert_array_equal(mean, -gaussian.censored_mean(means, std, lower, upper))
    alone = [float(gaussian.censored_variance(m, std, lower, upper)) for m in means]
    np.testing.assert_array_equal(alone, variance)


def test_thresholds_may_be_absent_per_element() -> None:
    lower = np.array([-INFINITY, -1.0, -INFINITY, -1.0, -1e10])
    upper = np.array([INFINITY, INFINITY, 2.0, 2.0, 2.0])
    mean = gaussian.censored_mean(0.5, 1.5, lower, upper)
    variance = gaussian.censored_variance(0.5, 1.5, lower, upper)
    assert mean[0] == 0.5
    assert variance[0] == 2.25
    for i in range(1, 5):
        finite_lower = max(lower[i], -1e4)  # 1e4 stands for infinity, 6,000 deviations out
        exact = exact_censored(0.5, 1.5, finite_lower, upper[i])
        assert error(mean[i], exact[0]) < TOLERANCE
        assert error(variance[i], exact[1]) < TOLERANCE


def test_no_censoring_broadcasts() -> None:
    mean = gaussian.censored_mean(np.array([1.0, 2.0]), np.array([[1.0], [3.0]]), None)
    np.testing.assert_array_equal(mean, [[1.0, 2.0], [1.0, 2.0]])
    variance = gaussian.censored_variance(np.array([1.0, 2.0]), np.array([[1.0], [3.0]]), None)
    np.testing.assert_array_equal(variance, [[1.0, 1.0], [9.0, 9.0]])


@pytest.mark.parametrize("function", [gaussian.censored_mean, gaussian.censored_variance])
def test_refused_arguments(function: Callable[..., Any]) -> None:
    for std in (0.0, -2.0, float("nan"), INFINITY):
        with pytest.raises(ValueError, match=rf"std = {std} is not allowed.*finite and > 0"):
            function(0.0, np.array([1.0, std]), 0.0)
    for lower, upper in [(2.0, 2.0), (3.0, -1.0), (float("nan"), 1.0)]:
        with pytest.raises(ValueError, match=rf"lower = {lower} and upper = {upper} .*below"):
            function(0.0, 1.0, np.array([-9.0, lower]), upper)
    with pytest.raises(ValueError, match=r"low = 1.0 and high = 0.5 .*low must be below high"):
        gaussian.interval_moments(1.0, 0.5)


reals = st.floats(-60.0, 60.0)
widths = st.floats(-4.0, 2.0).map(lambda exponent: 10.0**exponent)


@given(z=st.floats(-1e8, 1e8))
def test_truncated_variance_within_bounds(z: float) -> None:
    hazard, excess = gaussian.hazard(z), gaussian.hazard_excess(z)
    assert 0.0 < gaussian.truncated_variance(z) <= 1.0
    assert excess > 0.0
    assert hazard >= max(z, 0.0)


@given(z=st.floats(-37.0, 1e6), step=st.floats(1e-3, 10.0))
def test_monotone(z: float, step: float) -> None:
    assert gaussian.hazard(z + step) > gaussian.hazard(z)
    assert gaussian.hazard_excess(z + step) < gaussian.hazard_excess(z)
    assert gaussian.truncated_variance(z + step) <= gaussian.truncated_variance(z)
    assert gaussian.upper_tail(z + step) <= gaussian.upper_tail(z)


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


@settings(deadline=None)
@given(mean=reals, lower=reals, width=widths, std=st.floats(0.1, 10.0))
def test_censoring_reduces_variance(mean: float, lower: float, width: float, std: float) -> None:
    upper = lower + width
    for thresholds in [(lower, upper), (lower, None), (None, upper)]:
        value = gaussian.censored_mean(mean, std, *thresholds)
        variance = gaussian.censored_variance(mean, std, *thresholds)
        ulp = np.spacing(max(abs(lower), abs(upper), abs(mean)))
        below = -INFINITY if thresholds[0] is None else lower
        above = INFINITY if thresholds[1] is None else upper
        assert below - ulp <= value <= above + ulp
        assert 0.0 <= variance <= std * std * (1 + 1e-12)
        mirrored = [None if t is None else -t for t in reversed(thresholds)]
        assert gaussian.censored_mean(-mean, std, *mirrored) == -value
        assert gaussian.censored_variance(-mean, std, *mirrored) == variance
