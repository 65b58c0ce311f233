"""The colours and marks of all figures of results.

The palette is from M. Okabe and K. Ito, for colour-blind readers. Rules are blue and agents orange,
lighter without memory; fixed elements are grey or black.
"""

import os
from typing import Any

import matplotlib

if "MPLBACKEND" not in os.environ:
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
        "text.parse_math": False,  # users' labels are text
    }
)
# Figures of pages: readable at half their width, with mathematics in their labels.
READABLE: Any = {
    "text.parse_math": True,
    "font.size": 11,
    "axes.titlesize": 12,
    "legend.fontsize": 10,
    "figure.dpi": 130,
    "savefig.dpi": 130,
}
# States, sensors and estimates in figures of papers.
TRUTH, MEASURED, FUSED, CENTRAL = BLACK, GREY, VERMILLION, GREEN
SENSORS = (BLUE, ORANGE, PURPLE, SKY)
