"""Robust sequential fusion under the adaptive innovation trigger: Figures 3 to 9 and the rates."""

from __future__ import annotations

from ..paper import Paper, Piece
from . import errors, fusion, rates

_INTRODUCTION = """
Section 6 of the paper: a target's position, velocity and acceleration, three sensors, 600 steps.
All numbers are those of [CorrelatedTracking-v0](../correlated_tracking.md), whose defaults are the
paper's and whose page has our reading of it: time 0 is the posterior, the threshold's exponent is
-(b + c |ε|), without a request the estimate is the prediction, and the fused estimate's own
prediction is always fused. The paper names no actual variances for Figures 3 to 6; we take the
bounds themselves, whose rates come closest to the printed ones. Figures 1 and 2 are block diagrams.
"""

PAPER = Paper(
    name="adaptive_innovation",
    title="Sequential fusion under the adaptive innovation trigger",
    citation=(
        "K. Xu, X. Li, J. Wang and Y. Gao, “Robust sequential fusion estimation based on adaptive "
        "innovation event-triggered mechanism for uncertain networked systems”, 2022."
    ),
    environments=("fusion_gym/CorrelatedTracking-v0",),
    introduction=_INTRODUCTION,
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
