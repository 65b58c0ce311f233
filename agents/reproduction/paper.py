"""A paper as pieces of work: what is simulated, and what is shown of it."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from .piece_result import PieceResult

# Episodes and a seed to whatever JSON and arrays can hold, by name.
Compute = Callable[[int, int], dict[str, Any]]


class OldPiece(NamedTuple):
    """A part of a simulation section: its runs, kept in the work folder, and what they show.

    ``compute(episodes, seed)`` returns numbers, texts, lists and arrays by name; ``show`` takes
    what was kept of them, where arrays are arrays again. ``weight`` is about how many seconds of
    one core a run of ``usual`` episodes takes. ``compute`` must be a function of a module, so that
    another process finds it.
    """

    name: str
    title: str
    compute: Compute
    show: Callable[[dict[str, Any]], PieceResult]
    weight: float
    usual: int = 1000


class OldPaper(NamedTuple):
    """A paper: ``name`` is that of its page and its package, which has its ``introduction.md``."""

    name: str
    title: str
    citation: str
    pieces: Sequence[OldPiece]


Piece = OldPiece
Paper = OldPaper
