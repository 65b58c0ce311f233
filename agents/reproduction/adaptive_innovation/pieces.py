"""Robust sequential fusion under the adaptive innovation trigger: Figures 3 to 9 and the rates."""

from __future__ import annotations

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
            name="rates",
            title="Thresholds and communication rates",
            compute=rates.compute,
            show=rates.show,
            weight=45.0,
            usual=200,
        ),
        Piece(
            name="fusion",
            title="Errors, actual and conservative variances",
            compute=errors.compute,
            show=fusion.show,
            weight=100.0,
            usual=200,
        ),
    ),
)
