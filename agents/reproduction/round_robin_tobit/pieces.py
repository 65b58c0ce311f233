"""The simulation section of round_robin_tobit: Figures 2 to 11, Tables II and III, the claims."""

from ..paper import Paper, Piece
from . import bias, claims, nodes, tables, theory

PAPER = Paper(
    name="round_robin_tobit",
    title="Federated Tobit Kalman filtering under the round-robin protocol",
    citation=(
        "H. Geng, Z. Wang, F. E. Alsaadi, K. H. Alharbi and Y. Cheng, “Federated Tobit Kalman "
        "Filtering Fusion with Dead-Zone-Like Censoring and Dynamical Bias under the Round-Robin "
        "Protocol”, IEEE Transactions on Signal and Information Processing over Networks 7, 2021."
    ),
    pieces=(
        Piece(
            "oscillator", "The oscillator: the bias in the filter, or ignored by it",
            bias.compute_oscillator, bias.show_oscillator, 12.0, 2000,
        ),
        Piece(
            "nodes", "The oscillator: local filters and the fused one",
            nodes.compute_nodes, nodes.show_nodes, 12.0, 2000,
        ),
        Piece(
            "tables", "The oscillator: censoring intervals and noise variances",
            tables.compute_tables, tables.show_tables, 30.0, 2000,
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
            theory.compute_theory, claims.show_round_robin_claims, 20.0, 1000,
        ),
        Piece(
            "bounds", "The bounds of Theorems 4 and 5",
            theory.compute_bounds, claims.show_bounds, 30.0, 100,
        ),
    ),
)  # fmt: skip
