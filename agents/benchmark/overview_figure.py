"""The figure of the overview: what knowing and learning are worth, a row a setting."""

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import matplotlib.pyplot as plt
import matplotlib.ticker
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from fusion_gym.output.figures import save_figure
from fusion_gym.output.palette import INK, KINDS, LARGE

# Who is meant, the mark, whether it is filled.
MARKS: dict[str, tuple[str, Literal["full", "none"]]] = {
    "rules": ("o", "none"),
    "agents": ("^", "full"),
    "scheduler": ("s", "full"),
    "alone": ("D", "none"),
    "centre": ("P", "full"),
}


class Dot(NamedTuple):
    """A relative difference with its interval."""

    who: str
    interval: Mapping[str, float]


class OverviewRow(NamedTuple):
    """The dots of a setting, or why there are none."""

    dots: Sequence[Dot]
    reason: str = ""


def draw_overview_figure(
    paths: Sequence[Path],
    settings: Sequence[str],
    columns: Mapping[str, tuple[str, Sequence[OverviewRow]]],
) -> None:
    """A column of panels for each head, with its kind and one row a setting."""
    with plt.rc_context(LARGE):
        figure, panels = plt.subplots(
            1, len(columns), sharey=True, layout="constrained", squeeze=False,
            figsize=(11.0, 2.6 + 0.82 * len(settings)),
        )  # fmt: skip
        for axes, (head, (kind, rows)) in zip(panels[0], columns.items(), strict=True):
            _panel(axes, kind, rows)
            axes.set_title(textwrap.fill(head, 13), loc="left")
        first = panels[0, 0]
        first.set_yticks(range(len(settings)), [textwrap.fill(name, 13) for name in settings])
        first.set_ylim(len(settings) - 0.4, -0.6)
        figure.supxlabel("relative difference of the mean squared error at equal rate", fontsize=15)
        handles = {
            who: Line2D([], [], ls="", color=INK, marker=mark, fillstyle=fill, ms=9, mew=1.6)
            for who, (mark, fill) in MARKS.items()
        }
        figure.legend(
            handles.values(), handles.keys(), loc="outside upper left", ncols=len(handles),
            columnspacing=1.2, handletextpad=0.2,
        )  # fmt: skip
        save_figure(figure, *paths)


def _panel(axes: Axes, kind: str, rows: Sequence[OverviewRow]) -> None:
    colour = KINDS[kind]
    axes.axvline(0.0, color=INK, lw=1.2, zorder=1)
    axes.grid(axis="y", visible=False)
    for place, row in enumerate(rows):
        for number, dot in enumerate(row.dots):
            height = place + 0.24 * (number - (len(row.dots) - 1) / 2)
            mark, fill = MARKS[dot.who]
            mean, low, high = (dot.interval[end] for end in ("mean", "low", "high"))
            axes.errorbar(
                [mean], [height], xerr=[[mean - low], [high - mean]], color=colour, marker=mark,
                fillstyle=fill, ms=8.5, mew=1.6, elinewidth=1.8, zorder=3,
            )  # fmt: skip
        if row.reason:
            axes.text(
                0.03, place, textwrap.fill(row.reason, 15), va="center", fontsize=12, color="0.3",
                transform=axes.get_yaxis_transform(), linespacing=1.0,
            )  # fmt: skip
    for place in range(1, len(rows)):
        axes.axhline(place - 0.5, color="0.88", lw=0.8, zorder=0)
    ends = [dot.interval[end] for row in rows for dot in row.dots for end in ("low", "high")]
    low, high = min([-0.02, *ends]), max([0.01, *ends])
    axes.set_xlim(low - 0.08 * (high - low), high + 0.12 * (high - low))
    axes.xaxis.set_major_locator(matplotlib.ticker.MaxNLocator(2, steps=[1, 2, 4, 5, 10]))
    axes.xaxis.set_major_formatter(
        matplotlib.ticker.FuncFormatter(lambda value, _: f"{100 * value:.3g} %" if value else "0")
    )
