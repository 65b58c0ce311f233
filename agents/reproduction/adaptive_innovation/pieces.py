"""Robust sequential fusion under the adaptive innovation trigger: Figures 3 to 9 and the rates."""

from ..paper import Paper, Piece
from . import errors, fusion, rates

PAPER = Paper(
    name="adaptive_innovation",
    title="Sequential fusion under the adaptive innovation trigger",
    citation=(
        "K. Xu, X. Li, J. Wang and Y. Gao, “Robust sequential fusion estimation based on adaptive "
        "innovation event-triggered mechanism for uncertain networked systems”, 2022."
    ),
    pieces=(
        Piece(
            "rates",
            "Thresholds and communication rates",
            rates.compute_rates,
            rates.show_rates,
            45.0,
            200,
        ),
        Piece(
            "fusion", "Errors, actual and conservative variances",
            errors.compute_errors, fusion.show_fusion, 100.0, 200,
        ),
    ),
)  # fmt: skip
