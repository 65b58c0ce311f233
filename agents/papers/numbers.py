"""Numbers of a reproduction with the printed ones, verdicts from data, and their text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from fusion_gym.evaluation.metrics import LEVEL, Interval, mean_interval

_ENOUGH = 185  # episodes without an exception: with 97.5 %, at most 2 % of all have one
LOOKS, LARGER = 2, 5  # sizes of a sample, and the second over the first


class Number(NamedTuple):
    """A reproduced number, with the printed one if there is one.

    ``low`` and ``high`` are the 95 % interval of ``mean``. ``spread`` is the standard deviation of
    the printed number over the paper's number of runs: a single run's if it shows one.
    """

    what: str
    mean: float
    low: float
    high: float
    printed: float | None = None
    spread: float = 0.0
    unit: str = ""

    @classmethod
    def from_sample(
        cls, what: str, sample: Any, printed: float | None = None, runs: int = 1, unit: str = ""
    ) -> Number:
        """Return the number of a sample (episodes,); the paper prints its mean over ``runs``."""
        values = np.asarray(sample, dtype=float)
        result = mean_interval(values)
        spread = float(values.std(ddof=1)) / np.sqrt(runs) if len(values) > 1 else 0.0
        return cls(what, result.mean, result.low, result.high, printed, spread, unit)

    @property
    def verdict(self) -> str:
        """Whether the printed number lies where 95 % of such runs would, given our uncertainty."""
        if self.printed is None:
            return "not printed"
        allowed = math.hypot(1.96 * self.spread, 0.5 * (self.high - self.low))
        return "agrees" if abs(self.printed - self.mean) <= allowed else "differs"

    @property
    def text(self) -> str:
        """The number with its interval, if it depends on random draws."""
        exact = self.low == self.mean == self.high
        interval = "" if exact else f" [{self.low:.4g}, {self.high:.4g}]"
        return f"{self.mean:.4g}{interval} {self.unit}".strip()

    @property
    def printed_text(self) -> str:
        """The printed number, or a dash."""
        return "–" if self.printed is None else f"{self.printed:.4g} {self.unit}".strip()


def grid(columns: Iterable[str], rows: Mapping[str, Iterable[Any]], unit: str = "") -> list[Number]:
    """Return a number named "row: column" for each sample of each row."""
    names = tuple(columns)
    return [
        Number.from_sample(f"{row}: {column}", sample, unit=unit)
        for row, samples in rows.items()
        for column, sample in zip(names, samples, strict=True)
    ]


def estimate(sample: Any) -> Interval:
    """Return the mean of a sample (…, episodes) with its 95 % interval, each (…,)."""
    values = np.asarray(sample, dtype=float)
    return Interval(*np.moveaxis(np.apply_along_axis(mean_interval, -1, values), -1, 0))


def above_zero(low: Any, high: Any) -> Any:
    """Return 1 where an interval is above zero, 0 where it is not, and NaN where it is open."""
    return np.where(np.asarray(low) > 0.0, 1.0, np.where(np.asarray(high) <= 0.0, 0.0, np.nan))


def always(shares: Any, episodes: int) -> Any:
    """Return 0 where a share is below 1, and else 1, or NaN where too few episodes tell."""
    enough = 1.0 if episodes >= _ENOUGH else np.nan
    return np.where(np.asarray(shares) < 1.0, 0.0, enough)


def by_mean(condition: Any, episodes: int) -> Any:
    """Return a condition on means, or NaN where the episodes are few."""
    return condition if episodes >= _ENOUGH else np.nan


def below(first: Any, second: Any) -> Any:
    """Return whether paired samples (…, episodes) show the first mean below the second.

    1 where the whole interval of the difference and its median are below zero, 0 where they are
    not below, else NaN. The level of 95 % is corrected for two looks and the number of means.
    """
    difference = np.asarray(first, dtype=float) - np.asarray(second, dtype=float)
    count, number = difference.shape[-1], difference[..., 0].size
    mean, median = difference.mean(-1), np.median(difference, -1)
    error = difference.std(-1, ddof=1) / np.sqrt(count)
    reach = stats.t.ppf(1.0 - (1.0 - LEVEL) / (2 * LOOKS * number), count - 1) * error
    result = above_zero(-mean - reach, reach - mean)
    return np.where((median < 0.0) == (result == 1.0), result, np.nan)


def cite(value: Any, digits: int = 3) -> str:
    """Write an interval as mean [low, high] with significant digits.

    A sample (episodes,) represents its mean and interval; commas separate several.
    """
    if isinstance(value, list | tuple | np.ndarray) and not isinstance(value, Interval):
        if isinstance(value, list | tuple) or value.ndim > 1:
            return ", ".join(cite(item, digits) for item in value)
        value = estimate(value)
    mean, low, high = (f"{item:#.{digits}g}".rstrip(".") for item in value)
    return f"{mean} [{low}, {high}]"


def percent(share: Any) -> str:
    """Write a share in per cent, rounded to 0 or 100 only if exact; or several shares."""
    if isinstance(share, list | tuple | np.ndarray):
        return ", ".join(percent(float(item)) for item in share)
    for digits in range(7):
        text = f"{100.0 * share:.{digits}f}"
        if float(text) not in (0.0, 100.0) or share in (0.0, 1.0):
            return f"{text} %"
    return f"{100.0 * share:g} %"


def number_text(value: Any, form: str = ".3g") -> str:
    """Write a number, or several, in a format of Python."""
    if isinstance(value, list | tuple | np.ndarray):
        return ", ".join(number_text(item, form) for item in value)
    return format(value, form)
