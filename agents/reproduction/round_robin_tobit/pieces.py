"""The simulation section of round_robin_tobit: Figures 2 to 11, Tables II and III, the claims."""

from __future__ import annotations

from ..paper import Paper, Piece
from . import bias, claims, nodes, tables, theory
from .runs import OSCILLATOR, TRACKING

_INTRODUCTION = """
Section IV anew. The oscillator's state, bias and measurements have no units in the paper; the
target's are metres, metres a second and metres a second squared. The filters are those of
Theorems 1 to 3 with the text's mistakes corrected: [the environment's page](../biased.md) says
which. FTKF-DB is the filter of state and bias together, FTKF the one that believes that there is
no bias. Figures have the paper's quantities, axes and order; what is judged is what its text says
of them. Figure 1 is a block diagram and Table I pseudocode, which is not repeated here.

Under heavy censoring the paper's filter is overconfident: where it holds an uncensored packet for
next to impossible, one makes it jump far off. A few runs carry the mean errors, which is why the
curves have jags and the intervals of its means are wide.
"""

PAPER = Paper(
    name="round_robin_tobit",
    title="Federated Tobit Kalman filtering under the round-robin protocol",
    citation=(
        "H. Geng, Z. Wang, F. E. Alsaadi, K. H. Alharbi and Y. Cheng, “Federated Tobit Kalman "
        "Filtering Fusion with Dead-Zone-Like Censoring and Dynamical Bias under the Round-Robin "
        "Protocol”, IEEE Transactions on Signal and Information Processing over Networks 7, 2021."
    ),
    environments=(OSCILLATOR, TRACKING),
    introduction=_INTRODUCTION,
    pieces=(
        Piece(
            "oscillator", "The oscillator: the bias in the filter, or ignored by it",
            bias.compute_oscillator, bias.show_oscillator, 12.0, 2000,
        ),
        Piece(
            "nodes", "The oscillator: local filters and the fused one",
            nodes.compute, nodes.show, 12.0, 2000,
        ),
        Piece(
            "tables", "The oscillator: censoring intervals and noise variances",
            tables.compute, tables.show, 30.0, 2000,
        ),
        Piece(
            "readings", "What was tried to reach the printed values",
            tables.compute_readings, tables.show_readings, 30.0, 1000,
        ),
        Piece(
            "target", "Distributed target tracking",
            bias.compute_target, bias.show_target, 5.0, 1000,
        ),
        Piece(
            "theory", "Lemma 1, Theorems 1 and 2, remarks",
            theory.compute, claims.show, 20.0, 1000,
        ),
        Piece(
            "bounds", "The bounds of Theorems 4 and 5",
            theory.compute_bounds, claims.show_bounds, 30.0, 100,
        ),
    ),
)  # fmt: skip
