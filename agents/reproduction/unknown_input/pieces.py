"""Joint input and state filters under an adaptive threshold: Figures 1 to 7 and the theorems."""

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
            "filters", "The printed example beside two carts",
            filters.compute_filters, claims.show_unknown_input_claims, 20.0, 1000,
        ),
        Piece(
            "printed",
            "The printed recursion itself",
            printed.compute_printed,
            readings.show_unknown_input_readings,
            60.0,
            500,
        ),
    ),
)  # fmt: skip
