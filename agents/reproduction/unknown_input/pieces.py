"""Joint input and state filters under an adaptive threshold: Figures 1 to 7 and the theorems."""

from __future__ import annotations

from ..paper import Paper, Piece
from . import claims, filters, printed, readings

PAPER = Paper(
    name="unknown_input",
    title="Unknown inputs, several rates and an adaptive threshold",
    citation=(
        "Y. Sun, M. Fu, J. Mao and G. Wei, “Recursive filtering of multi-rate cyber-physical "
        "systems with unknown inputs under adaptive event-triggered mechanisms”, Frontiers of "
        "Information Technology & Electronic Engineering 24, 2023."
    ),
    pieces=(
        Piece(
            name="filters",
            title="The printed example beside two carts",
            compute=filters.compute,
            show=claims.show,
            weight=20.0,
            usual=1000,
        ),
        Piece(
            name="printed",
            title="The printed recursion itself",
            compute=printed.compute,
            show=readings.show,
            weight=60.0,
            usual=500,
        ),
    ),
)
