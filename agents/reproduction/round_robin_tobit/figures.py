"""Drawings of Figures 2 to 11 of round_robin_tobit."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from fusion_gym.arrays import Array

from ...output import palette

STEP = "time step k"
TARGET_STEP = "time step k (0.1 s each)"
_THIN, _WIDE = 1.3, 2.0


class CurveLine(NamedTuple):
    """A curve over time with its name, colour and dashes; ``values`` (H,), or (3, H) with ends."""

    label: str
    values: Array
    colour: str
    style: str = "-"
    width: float = _WIDE


def unaware(values: Array) -> CurveLine:
    """The filter that ignores the bias."""
    return CurveLine("FTKF (bias ignored)", values, palette.PURPLE, "--")


def aware(values: Array) -> CurveLine:
    """The paper's own filter."""
    return CurveLine("FTKF-DB (fused)", values, palette.FUSED)


def node(number: int, values: Array, style: str = "-", label: str = "") -> CurveLine:
    """A local filter."""
    name = label or f"LTKF-DB-S{number + 1}"
    return CurveLine(name, values, palette.SENSORS[number], style, _THIN)


def true(values: Array) -> CurveLine:
    """What the filters want to know."""
    return CurveLine("true", values, palette.TRUTH, "-", _THIN)


def least(values: Array, label: str) -> CurveLine:
    """What nobody can go below."""
    return CurveLine(label, values, palette.CENTRAL, ":", _WIDE)


def curves(
    figure: Any,
    panels: Sequence[tuple[str, Sequence[CurveLine]]],
    step: str = STEP,
    from_zero: bool = False,
) -> None:
    """Panels one over another over a common time, each with the name of its axis."""
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axis, (name, lines) in zip(axes, panels, strict=True):
        for line in lines:
            _draw(axis, line)
        axis.set_ylabel(name)
        axis.margins(x=0.01)
        if from_zero:
            axis.set_ylim(bottom=0.0)
    axes[-1].set_xlabel(step)
    legend(figure, axes)


def _draw(axis: Any, line: CurveLine) -> None:
    curve = np.atleast_2d(line.values)
    steps = np.arange(1, curve.shape[1] + 1)
    axis.plot(
        steps, curve[0], color=line.colour, linestyle=line.style, linewidth=line.width,
        label=line.label,
    )  # fmt: skip
    if len(curve) > 1:
        axis.fill_between(steps, curve[1], curve[2], color=line.colour, alpha=0.18, linewidth=0)


def legend(figure: Any, axes: Sequence[Any], columns: int = 4) -> None:
    """Below the axes, each name once."""
    named: dict[str, Any] = {}
    for axis in axes:
        handles, labels = axis.get_legend_handles_labels()
        named.update(zip(labels, handles, strict=True))
    figure.legend(
        named.values(), named.keys(), loc="outside lower center", ncols=min(columns, len(named))
    )


def biased_measurements(figure: Any, whole: Array, clipped: Array, limits: Sequence[float]) -> None:
    """Figure 2: what the estimators hold, (H, sensors), uncensored and censored."""
    axes = figure.subplots(whole.shape[1], 1, sharex=True)
    steps = np.arange(1, len(whole) + 1)
    for number, axis in enumerate(axes):
        colour = palette.SENSORS[number]
        axis.step(
            steps, whole[:, number], where="post", color=palette.BLACK, linewidth=_THIN,
            label="uncensored",
        )  # fmt: skip
        axis.step(
            steps, clipped[:, number], where="post", color=colour, linewidth=_WIDE,
            label=f"censored, sensor {number + 1}",
        )  # fmt: skip
        for limit in limits:
            axis.axhline(limit, color=palette.INK, linewidth=0.8, linestyle="--")
        axis.set_ylabel(f"measurement\nof x{number + 1} (sensor {number + 1})")
        axis.margins(x=0.01)
    axes[-1].set_xlabel(STEP)
    legend(figure, axes)


class Marks(NamedTuple):
    """Values at the rows of a table, (rows, 3 states), with ends where there are any."""

    label: str
    values: Array
    colour: str
    marker: str
    low: Array | None = None
    high: Array | None = None


def table_marks(
    figure: Any, rows: Sequence[str], marks: Sequence[Marks], floors: Array, title: str
) -> None:
    """Tables II and III as pictures: printed values, ours, and what no filter can be below.

    ``floors`` (rows, 3 states).
    """
    axes = figure.subplots(1, 3)
    places = np.arange(len(rows))
    for state, axis in enumerate(axes):
        for shift, mark in zip(np.linspace(-0.18, 0.18, len(marks)), marks, strict=True):
            values = mark.values[:, state]
            ends = None
            if mark.low is not None and mark.high is not None:
                ends = np.stack([values - mark.low[:, state], mark.high[:, state] - values])
            axis.errorbar(
                places + shift, values, yerr=ends, fmt=mark.marker, color=mark.colour,
                markersize=8, markeredgewidth=2, label=mark.label, capsize=3,
            )  # fmt: skip
        axis.bar(
            places, floors[:, state], width=0.8, color=palette.GREY,
            label="no filter lies in here", zorder=0,
        )  # fmt: skip
        axis.set_xticks(places, rows)
        axis.set_title(f"ARMSE{state + 1} (of {('x1', 'x2', 'b')[state]})")
        axis.set_ylim(bottom=0.0)
        axis.set_xlim(-0.6, len(rows) - 0.4)
    axes[1].set_xlabel(title)
    legend(figure, axes)
