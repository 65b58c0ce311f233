"""Verdicts from data, and the words in which their evidence is told."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from fusion_gym.evaluation.intervals import Interval, mean_interval

from .piece_result import Verdict


def verdict(parts: Iterable[bool]) -> Verdict:
    """Of a claim with several parts: all of them hold, some, or none."""
    result = [bool(part) for part in parts]
    if all(result):
        return "holds"
    return "holds partly" if any(result) else "does not hold"


def estimate(sample: Any) -> Interval:
    """Mean of a sample (episodes,) with its 95 % interval."""
    return mean_interval(np.asarray(sample, dtype=float))


def cite(interval: Interval, digits: int = 3) -> str:
    """An interval in words: mean [low, high], with as many significant digits."""
    mean, low, high = (f"{number:#.{digits}g}".rstrip(".") for number in interval)
    return f"{mean} [{low}, {high}]"


def percent(share: float) -> str:
    """A share between 0 and 1 in per cent; neither 0 nor 100 unless it is."""
    for digits in range(7):
        text = f"{100.0 * share:.{digits}f}"
        if float(text) not in (0.0, 100.0) or share in (0.0, 1.0):
            return f"{text} %"
    return f"{100.0 * share:g} %"


def below(first: Any, second: Any) -> bool:
    """Whether paired samples say that the first mean is below the second: the whole interval."""
    return estimate(np.asarray(first) - np.asarray(second)).high < 0.0
