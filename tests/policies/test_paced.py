"""Requests at an even pace: counts in every window, against exact rational arithmetic."""

import math
from fractions import Fraction
from typing import Any

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fusion_gym.policies.rules import Paced

LENGTH = 400


def requests(policy: Any, sensors: int, first: int = 0, length: int = LENGTH) -> NDArray[np.bool_]:
    """Requests (sensors, length) at the steps ``first``, ``first + 1``, …"""
    signals: Any = {
        "tokens": np.ones(length),
        "token_cost": np.ones((sensors, 1)),
        "step": np.arange(first, first + length),
    }
    answer = policy(signals)
    assert answer.shape == (sensors, length)
    assert answer.dtype == np.bool_
    return answer


def widest_miss(taken: NDArray[Any], rate: Fraction) -> Fraction:
    """The largest |count - n · rate| over all windows, in exact arithmetic.

    With D(t) the count of the first t steps less t · rate, a window misses by D(b) - D(a).
    """
    drift, lowest, highest = Fraction(0), Fraction(0), Fraction(0)
    for count in taken.astype(int).tolist():
        drift += count - rate
        lowest, highest = min(lowest, drift), max(highest, drift)
    return highest - lowest


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    parts=st.lists(st.integers(1, 300), min_size=1, max_size=4),
    numerator=st.integers(0, 300),
    staggered=st.booleans(),
    first=st.integers(0, 100_000),
)
@example(parts=[49], numerator=1, staggered=False, first=0)  # 49 · (1/49) rounds to below 1
@example(parts=[3, 3, 3], numerator=1, staggered=True, first=0)
def test_every_window_has_its_share(
    parts: list[int], numerator: int, staggered: bool, first: int
) -> None:
    """Rates p/q: a miss is a multiple of 1/q, so that < 1 is a sharp limit."""
    rates = [Fraction(min(numerator, part), part) for part in parts]
    policy = Paced(tuple(float(rate) for rate in rates), staggered)
    taken = requests(policy, len(rates), first)
    for row, rate in zip(taken, rates, strict=True):
        assert widest_miss(row, rate) < 1
        if rate > 0:  # as even as possible: gaps are ⌊1/r⌋ or ⌈1/r⌉
            gaps = np.diff(np.flatnonzero(row)).tolist()
            assert set(gaps) <= {math.floor(1 / rate), math.ceil(1 / rate)}


@settings(max_examples=60, deadline=None, derandomize=True)
@given(rate=st.floats(0.0, 1.0), staggered=st.booleans(), first=st.integers(0, 10_000))
def test_every_window_has_its_share_at_any_real_rate(
    rate: float, staggered: bool, first: int
) -> None:
    taken = requests(Paced(rate, staggered), 3, first)
    for row in taken:
        assert widest_miss(row, Fraction(rate)) < 1 + Fraction(1, 10**9)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(sensors=st.integers(1, 6), numerator=st.integers(0, 120), denominator=st.integers(1, 120))
def test_staggered_sensors_of_one_rate_are_even_together(
    sensors: int, numerator: int, denominator: int
) -> None:
    """Σ ⌊x + i/l⌋ = ⌊l x⌋: the sum over sensors is paced at l · r."""
    rate = Fraction(min(numerator, denominator), denominator)
    together = requests(Paced(float(rate)), sensors).sum(0)
    assert widest_miss(together, sensors * rate) < 1
    at_once = requests(Paced(float(rate), staggered=False), sensors)
    np.testing.assert_array_equal(at_once, np.broadcast_to(at_once[0], at_once.shape))
