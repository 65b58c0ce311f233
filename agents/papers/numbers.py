"""Numbers of a reproduction with the printed ones, verdicts from data, and their text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np

from fusion_gym.evaluation.metrics import Interval, mean_interval

Verdict = Literal["holds", "holds partly", "does not hold"]


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


def verdict(parts: Any) -> Verdict:
    """Return the verdict on a claim: all of its parts hold, some, or none.

    Args:
        parts: A condition, an array of conditions, or a list of both.
    """
    entries = parts if isinstance(parts, list | tuple) else [parts]
    result = np.concatenate([np.ravel(np.asarray(entry, dtype=float)) for entry in entries])
    if result.all():
        return "holds"
    return "holds partly" if result.any() else "does not hold"


def estimate(sample: Any) -> Interval:
    """Return the mean of a sample (…, episodes) with its 95 % interval, each (…,)."""
    values = np.asarray(sample, dtype=float)
    return Interval(*np.moveaxis(np.apply_along_axis(mean_interval, -1, values), -1, 0))


def below(first: Any, second: Any) -> Any:
    """Return whether paired samples (…, episodes) show the first mean below the second.

    The whole interval of the difference must be below zero.
    """
    return estimate(np.asarray(first) - np.asarray(second)).high < 0.0


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
