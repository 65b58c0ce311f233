"""Common parts of figures: panels, legends over all axes, and fixed ticks."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from fusion_gym.entries import Plain


def stack(figure: Any, count: int, label: str, **style: Any) -> Any:
    """Return axes (count,) in one column, with one label of their common horizontal axis."""
    axes = np.ravel(figure.subplots(count, 1, sharex=True, **style))
    axes[-1].set_xlabel(label)
    return axes


def legend(figure: Any, axes: Any, columns: int, place: str = "upper", **style: Any) -> None:
    """Draw one legend above or below all axes, with each label once."""
    entries: Plain = {}
    for axis in np.ravel(axes):
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    keys = {"loc": f"outside {place} center", "ncols": min(columns, len(entries))}
    figure.legend(entries.values(), entries, **keys, **style)


def set_ticks(axis: Any, values: Sequence[float]) -> None:
    """Label a logarithmic vertical axis at these values only."""
    axis.set_yticks(values, [f"{value:g}" for value in values])
    axis.minorticks_off()
