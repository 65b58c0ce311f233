"""The colours and marks of all figures of results: one for each kind of policy, everywhere.

From the palette of M. Okabe and K. Ito, which people who are colour-blind tell apart. Rules are
blue, agents orange, lighter without memory; what stands still is grey or black.
"""

from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

INK = "#30343b"
GREY = "#c9ccd1"
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILLION, PURPLE = "#0072B2", "#D55E00", "#CC79A7"
AGENT = VERMILLION

plt.rcParams.update(
    {
        "figure.dpi": 130,
        "font.size": 9,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.edgecolor": INK,
        "axes.grid": True,
        "grid.alpha": 0.25,
        "legend.frameon": False,
        "svg.hashsalt": "fusion-gym",
        "text.parse_math": False,  # labels of users are text
    }
)
LARGE: Any = {
    "font.size": 15,
    "axes.titlesize": 15,
    "legend.fontsize": 14,
    "figure.dpi": 100,
}  # at half width still read


class Style(NamedTuple):
    """How one kind of policy is drawn; legends list them by ``order``."""

    label: str
    colour: str
    marker: str
    line: str = "-"
    size: float = 6.0
    order: int = 0


RULES = Style("rules", SKY, "o", "--", 5.0, 0)
RULES_MEMORY = Style("rules, memory", BLUE, "o", "-", 5.0, 1)
AGENTS = Style("agents", ORANGE, "s", "--", 7.5, 2)
AGENTS_MEMORY = Style("agents, memory", VERMILLION, "^", "-", 8.5, 3)
ROLLOUT = Style("rule improved by simulation", PURPLE, "D", "", 8.0, 4)
REFERENCE = Style("reference", BLACK, "x", ":", 7.0, 5)
SCHEDULES = Style("best periodic schedules", BLACK, "+", "-.", 8.0, 6)
BOUND = Style("proven: none lies below", GREEN, "", "-")

# What the worths of the overview are drawn in.
KINDS = {
    "memory": BLUE,
    "hearing": GREEN,
    "deciding together": PURPLE,
    "packets that hold the estimate": SKY,
    "learning": VERMILLION,
}

# Figures of pages: still read at half their width, and their own labels are mathematics.
READABLE: Any = {
    "text.parse_math": True,
    "font.size": 11,
    "axes.titlesize": 12,
    "legend.fontsize": 10,
    "figure.dpi": 130,
    "savefig.dpi": 130,
}
# States, sensors and estimates in figures of papers, everywhere the same.
TRUTH, MEASURED, FUSED, CENTRAL = BLACK, GREY, VERMILLION, GREEN
SENSORS = (BLUE, ORANGE, PURPLE, SKY)
