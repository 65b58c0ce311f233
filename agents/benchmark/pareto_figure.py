"""The figure of a setting: errors against rates, a panel for each who decides by what they know."""

import math
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import matplotlib.ticker
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.lines import Line2D

from fusion_gym.output.figures import save_figure
from fusion_gym.output.palette import BLUE, BOUND, GREY, LARGE, Style

Points = Sequence[tuple[float, float]]  # rate and error, by rate
# Of a logarithmic axis: the coarsest of these with enough numbers in its range is written.
_STEPS = ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 5.0, 7.0))


class Series(NamedTuple):
    """One kind of policy: a ``line`` through many points, ``marks`` on it, and a band around it.

    ``band`` has rates with the least and the greatest error there.
    """

    style: Style
    line: Points
    marks: Points = ()
    band: Sequence[tuple[float, float, float]] = ()


class Differences(NamedTuple):
    """Rates with the relative difference of agents to rules there, and its interval's ends."""

    style: Style
    points: Sequence[tuple[float, float, float, float]]


class Panel(NamedTuple):
    """One set of axes: its ``series`` over single rules in grey, the bound that none undercuts, and
    a ``level`` with its label. Below it stand ``differences`` of agents to the rules of their own
    class, with intervals."""

    title: str
    series: Sequence[Series]
    single: Sequence[Points] = ()
    bound: Points = ()
    level: tuple[str, float] | None = None
    differences: Sequence[Differences] = ()


class Limits(NamedTuple):
    """The axes, of all panels."""

    rates: tuple[float, float]
    errors: tuple[float, float]
    differences: tuple[float, float] = (-0.1, 0.1)


def draw_pareto(
    paths: Sequence[Path], title: str, main: Panel, small: Sequence[Panel], limits: Limits
) -> None:
    """The main panel with the legend beside it, and a row of small ones on the same axes."""
    with plt.rc_context(LARGE):
        figure = plt.figure(figsize=(10.0, 11.6 if small else 7.2), layout="constrained")
        rows = [2.1, 1.35] if small else [1.0]
        parts = figure.add_gridspec(len(rows), 1, height_ratios=rows)
        above = parts[0].subgridspec(2, 2, width_ratios=[1.75, 1.0], height_ratios=[2.7, 1.0])
        axes = figure.add_subplot(above[0, 0])
        under = figure.add_subplot(above[1, 0], sharex=axes)
        beside = figure.add_subplot(above[:, 1])
        beside.axis("off")
        _panel(axes, main, limits)
        _strip(under, main, limits)
        axes.set_ylabel("mean squared error")
        under.set_ylabel("agents\nto rules")
        handles = dict(_handles(main, small))
        beside.legend(handles.values(), handles.keys(), loc="upper left", borderaxespad=0.0)
        if small:
            below = parts[1].subgridspec(2, len(small), wspace=0.05, height_ratios=[1.7, 1.0])
            for place, panel in enumerate(small):
                inner = figure.add_subplot(below[0, place], sharex=axes, sharey=axes)
                strip = figure.add_subplot(below[1, place], sharex=axes, sharey=under)
                _panel(inner, panel._replace(series=[bare(item) for item in panel.series]), limits)
                _strip(strip, panel, limits)
                for each, label in ((inner, "mean sq. error"), (strip, "agents\nto rules")):
                    each.tick_params(labelleft=place == 0)
                    each.set_ylabel(label if place == 0 else "")
        figure.supxlabel("transmissions per sensor and step", fontsize=LARGE["font.size"])
        figure.suptitle(textwrap.fill(title, 72), x=0.01, ha="left", fontsize=LARGE["font.size"])
        figure.align_ylabels()
        save_figure(figure, *paths)


def bare(series: Series) -> Series:
    """Rules without marks, agents with smaller ones: for small panels."""
    style = series.style
    marks = () if style.marker == "o" else series.marks
    return series._replace(marks=marks, style=style._replace(size=0.75 * style.size))


def _panel(axes: Axes, panel: Panel, limits: Limits) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    for single in panel.single:
        axes.plot(*_columns(single), color=GREY, lw=0.9, zorder=1)
    if panel.bound:
        rates, errors = _columns(panel.bound)
        axes.plot(rates, errors, color=BOUND.colour, lw=2.0, zorder=2)
        axes.fill_between(rates, limits.errors[0] / 10, errors, color=BOUND.colour, alpha=0.1, lw=0)
    if panel.level:
        axes.axhline(panel.level[1], color=BOUND.colour, lw=1.6, ls="-.", zorder=2)
    for place, series in enumerate(panel.series):
        style, order = series.style, 3 + place
        if series.band:
            places, low, high = zip(*series.band, strict=True)
            axes.fill_between(places, low, high, color=style.colour, alpha=0.25, lw=0, zorder=order)
        if style.line:
            line = _columns(series.line)
            axes.plot(*line, style.line, color=style.colour, lw=1.9, zorder=order)
        marks = _columns(series.marks)
        axes.plot(*marks, ls="", color=style.colour, zorder=order + 0.5, **_mark(style))
    axes.set_title(panel.title, loc="left")
    axes.set_xlim(*limits.rates)
    axes.set_ylim(*limits.errors)
    _write(axes.xaxis, ticks(*limits.rates, 3))
    _write(axes.yaxis, ticks(*limits.errors, 4))
    axes.tick_params(labelbottom=False)


def _strip(axes: Axes, panel: Panel, limits: Limits) -> None:
    """Agents relative to rules; zero is the envelope."""
    axes.axhline(0.0, color=BLUE, lw=1.6, zorder=2)
    for visible in panel.differences:
        rates, means, low, high = np.reshape(visible.points, (-1, 4)).T
        style = visible.style
        mark = _mark(style._replace(size=0.75 * style.size))
        axes.errorbar(
            rates, means, yerr=[means - low, high - means], ls=style.line, color=style.colour,
            lw=1.2, elinewidth=1.6, zorder=4, **mark,
        )  # fmt: skip
    axes.set_ylim(*limits.differences)
    axes.yaxis.set_major_locator(matplotlib.ticker.MaxNLocator(3, steps=[1, 2, 5, 10]))
    axes.yaxis.set_major_formatter(
        matplotlib.ticker.FuncFormatter(lambda value, _: f"{100 * value:+.0f} %" if value else "0")
    )


def _mark(style: Style) -> dict[str, Any]:
    """Agents are filled and edged, so that they stand out of what they lie on."""
    plain = style.marker in ("", "x", "+", "o")
    edge: dict[str, Any] = {} if plain else {"mec": "white", "mew": 0.7}
    return {"marker": style.marker or None, "ms": style.size, **edge}


def _handles(main: Panel, small: Sequence[Panel]) -> Iterator[tuple[str, Line2D]]:
    """What the legend shows, by its label: each kind once."""
    styles = [series.style for panel in (main, *small) for series in panel.series]
    for style in sorted(styles, key=lambda style: style.order):
        line = Line2D([], [], color=style.colour, ls=style.line or "none", lw=1.9, **_mark(style))
        yield style.label, line
    if any(panel.single for panel in (main, *small)):
        yield "single tuned rules", Line2D([], [], color=GREY, lw=1.2)
    if main.bound:
        yield BOUND.label, Line2D([], [], color=BOUND.colour, lw=2.0)
    for panel in (main, *small):
        if panel.level:
            yield panel.level[0], Line2D([], [], color=BOUND.colour, lw=1.6, ls="-.")


def _write(axis: Axis, places: Sequence[float]) -> None:
    """Plain numbers at these places of a logarithmic axis."""
    axis.set_major_locator(matplotlib.ticker.FixedLocator(places))
    axis.set_major_formatter(matplotlib.ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(matplotlib.ticker.NullLocator())


def ticks(low: float, high: float, least: int) -> list[float]:
    """At least so many round numbers between two positive ones, if there are, and few more."""
    result: list[float] = []
    for steps in _STEPS:
        decades = range(math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 1)
        every = [step * 10.0**decade for decade in decades for step in steps]
        result = [float(f"{value:.6g}") for value in every if low <= value <= high]
        if len(result) >= least:
            break
    return result


def _columns(points: Points) -> tuple[list[float], list[float]]:
    """Rates and errors, without what a logarithm does not know."""
    mask = [(rate, error) for rate, error in sorted(points) if rate > 0.0 and error > 0.0]
    return [rate for rate, _ in mask], [error for _, error in mask]
