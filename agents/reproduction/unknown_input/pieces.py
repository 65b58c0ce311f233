"""Joint input and state filters under an adaptive threshold: Figures 1 to 7 and the theorems."""

from __future__ import annotations

from ..paper import Paper, Piece
from . import claims, filters, printed, readings

_INTRODUCTION = """
Section 4 of the paper: two states under two unknown inputs, two sensors, sampled every second step,
100 sampling instants. It prints no numbers but its parameters, and its figures show trajectories,
bounds and triggering instants. All runs are those of [UnknownInput-v0](../unknown_input.md), whose
page has our reading: the input is held over a sampling interval, and the filter's bound is computed
in a form that can be proven. **The printed example is degenerate**, so each figure shows it beside
the environment's own well-posed example, two carts under an unknown force, with the same filter and
trigger. Not given in the paper, our choice: the inputs (sinusoids of 0.1), ε = ξ = 1 and
Ξ(0) = 0.01 I.
"""

PAPER = Paper(
    name="unknown_input",
    title="Unknown inputs, several rates and an adaptive threshold",
    citation=(
        "Y. Sun, M. Fu, J. Mao and G. Wei, “Recursive filtering of multi-rate cyber-physical "
        "systems with unknown inputs under adaptive event-triggered mechanisms”, Frontiers of "
        "Information Technology & Electronic Engineering 24, 2023."
    ),
    environments=("fusion_gym/UnknownInput-v0",),
    introduction=_INTRODUCTION,
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
