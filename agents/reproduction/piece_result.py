"""What a reproduction shows: numbers beside printed ones, pictures, and claims with verdicts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from ..papers.numbers import Number, Verdict

__all__ = ["Number", "Verdict"]


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
