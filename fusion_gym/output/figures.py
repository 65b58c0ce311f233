"""Figures of results: the Pareto front."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np

from fusion_gym.evaluation.envelope import EnvelopePoint
from fusion_gym.evaluation.episodes import EpisodeResults
from fusion_gym.evaluation.intervals import mean_interval
from fusion_gym.output.files import replacing
from fusion_gym.output.palette import AGENT, INK


class FigureLine(NamedTuple):
    """A curve of the Pareto figure: its label and its policies' results, in sweep order."""

    label: str
    results: Sequence[EpisodeResults]


def pareto(
    path: Path,
    title: str,
    lines: Sequence[FigureLine],
    points: Mapping[str, EpisodeResults],
    agent: FigureLine,
    envelope: Sequence[EnvelopePoint],
) -> None:
    """Draw MSE against transmission rate, with 95 % intervals over episodes."""
    figure, axes = plt.subplots(figsize=(8.6, 5.6))
    colours = plt.get_cmap("tab20")
    for place, line in enumerate(lines):
        _draw(axes, line.label, line.results, colours(place % 20), marker="o")
    for place, (name, value) in enumerate(points.items()):
        _draw(axes, name, [value], INK, marker="sD^vPX"[place % 6], size=4.5)
    hull = [*envelope]
    right = axes.get_xlim()[1]
    known = [point.rate for point in hull]
    rates = np.union1d(known, np.linspace(known[0], max(right, known[-1]), 400))
    errors = np.interp(rates, known, [point.mse for point in hull])  # of mixtures
    axes.plot(rates, errors, "--", color=INK, lw=1, label="lower envelope of the baselines")
    size = 15.0 if len(agent.results) == 1 else 9.0
    _draw(axes, agent.label, agent.results, AGENT, marker="*", size=size)
    axes.set_xlabel("transmissions per sensor and step")
    axes.set_ylabel("mean squared error of the fused estimate")
    every = [r for line in lines for r in line.results] + [*points.values(), *agent.results]
    means = np.array([r.mse.mean() for r in every])
    if means.max() > 6 * means.min():
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(_plain_tick)
        axes.yaxis.set_minor_formatter(_plain_tick)
    axes.set_xlim(left=-0.005)
    axes.set_title(title, loc="left", fontsize=10)
    axes.legend(fontsize=7.5, loc="upper left", bbox_to_anchor=(1.01, 1.0))
    save_figure(figure, path)


def _plain_tick(value: float, place: float | None = None) -> str:
    """Return the label of a logarithmic axis at 1, 2, 3 and 5 times powers of ten."""
    text = f"{value:g}"
    return text if f"{value:.0e}"[0] in "1235" else ""


def _draw(
    axes: plt.Axes,
    label: str | None,
    results: Sequence[EpisodeResults],
    colour: object,
    marker: str,
    size: float = 3.5,
) -> None:
    rate = np.array([r.rate.mean() for r in results])
    order = np.argsort(rate, kind="stable")
    mean, low, high = np.array([mean_interval(results[i].mse) for i in order]).T
    spread = np.abs([mean - low, high - mean])
    axes.errorbar(
        rate[order], mean, yerr=spread, label=label, color=colour, marker=marker,
        ms=size, lw=1.1, elinewidth=0.8, capsize=1.5, zorder=3 if size > 5 else 2,
    )  # fmt: skip


def save_figure(figure: plt.Figure, *paths: Path) -> None:
    """Write a figure to each path atomically, and close it; equal figures give equal bytes."""
    try:
        for path in paths:
            metadata = {"Date": None} if path.suffix == ".svg" else {}
            with replacing(path) as partial:
                figure.savefig(partial, bbox_inches="tight", metadata=metadata)
    finally:
        plt.close(figure)
