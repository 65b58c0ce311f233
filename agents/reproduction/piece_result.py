"""What a reproduction shows: numbers beside printed ones, pictures, and claims with verdicts."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from fusion_gym.evaluation.intervals import mean_interval

Verdict = Literal["holds", "holds partly", "does not hold"]


class Number(NamedTuple):
    """A number of ours, beside the printed one where there is one.

    ``low`` and ``high`` are the 95 % interval of ``mean``. ``spread`` is the standard deviation of
    what the paper prints, for its own number of runs: a single run's where it shows one.
    """

    what: str
    mean: float
    low: float
    high: float
    printed: float | None = None
    spread: float = 0.0
    unit: str = ""

    @classmethod
    def of(
        cls, what: str, sample: Any, printed: float | None = None, runs: int = 1, unit: str = ""
    ) -> Number:
        """From a sample (episodes,), of which the paper prints the mean over ``runs``."""
        values = np.asarray(sample, dtype=float)
        result = mean_interval(values)
        spread = float(values.std(ddof=1)) / np.sqrt(runs) if len(values) > 1 else 0.0
        return cls(what, result.mean, result.low, result.high, printed, spread, unit)

    @property
    def verdict(self) -> str:
        """Whether the printed number lies where 95 % of such runs would, ours being uncertain."""
        if self.printed is None:
            return "not printed"
        allowed = math.hypot(1.96 * self.spread, 0.5 * (self.high - self.low))
        return "agrees" if abs(self.printed - self.mean) <= allowed else "differs"


class NumbersTable(NamedTuple):
    """Numbers under a title, ``note`` says what they are and how they were made.

    With ``columns`` the numbers, none of which is printed, stand row by row under these heads; each
    is called "row: column".
    """

    name: str
    title: str
    numbers: Sequence[Number]
    note: str = ""
    columns: Sequence[str] = ()


class Picture(NamedTuple):
    """A figure of a paper: ``draw`` draws into an empty matplotlib Figure.

    ``name`` is that of its files (figure_5), ``title`` what the paper calls it (Figure 5: …), in
    our words; ``caption`` says what to see, and whether it looks as the paper's. ``size`` in
    inches.
    """

    name: str
    title: str
    caption: str
    draw: Callable[[Any], None]
    size: tuple[float, float] = (7.2, 4.2)


class Claim(NamedTuple):
    """A claim of a paper that simulation can touch, where it stands, a verdict and its evidence."""

    text: str
    source: str
    verdict: Verdict
    evidence: str


class PieceResult(NamedTuple):
    """All that is shown of a piece."""

    pictures: Sequence[Picture] = ()
    tables: Sequence[NumbersTable] = ()
    claims: Sequence[Claim] = ()
    notes: Sequence[str] = ()
    """Paragraphs of Markdown: readings that were tried, bounds that a printed value breaks."""
