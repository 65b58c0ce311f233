"""Figures of results: the Pareto front and the costs."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np

from fusion_gym.evaluation.episodes import EpisodeResults
from fusion_gym.evaluation.metrics import mean_interval
from fusion_gym.output.files import replacing
from fusion_gym.output.palette import AGENT, BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY


class FigureLine(NamedTuple):
    """A curve of the Pareto figure: its label and its policies' results, in sweep order."""

    label: str
    results: Sequence[EpisodeResults]


def pareto(path: Path, title: str, lines: Sequence[FigureLine], span: tuple[float, float]) -> None:
    """Draw MSE against transmission rate, and each curve's cost above the least at prices.

    Bars are 95 % intervals over episodes.
    """
    figure, (front, costs) = plt.subplots(1, 2, figsize=(10.5, 4.6), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=11)
    rest = itertools.cycle((BLUE, SKY, GREEN, PURPLE, ORANGE, BLACK))
    colours = [AGENT if line.label.startswith(("model:", "zoo:")) else next(rest) for line in lines]
    prices = np.geomspace(*span, 40)
    each = [
        np.min([[r.cost(price).mean() for price in prices] for r in line.results], axis=0)
        for line in lines
    ]
    for line, own, colour in zip(lines, each, colours, strict=True):
        _draw(front, line, colour)
        costs.plot(prices, 100.0 * (own / np.min(each, axis=0) - 1.0), color=colour)
    front.set(xlabel="transmissions per sensor and step", ylabel="mean squared error")
    front.set_xlim(left=-0.005)
    front.legend(fontsize=8, loc="upper right")
    label = "cost = error + price · tokens,\nabove the least cost of all [%]"
    costs.set(xscale="log", ylim=(-2, 60), xlabel="price of a token", ylabel=label)
    costs.xaxis.set(major_formatter=plain_tick, minor_formatter=plain_tick)
    errors = np.array([np.nanmean(result.mse) for line in lines for result in line.results])
    if errors.max() > 6 * errors.min():
        front.set_yscale("log")
        front.yaxis.set(major_formatter=plain_tick, minor_formatter=plain_tick)
    save_figure(figure, path)


def plain_tick(value: float, place: float | None = None) -> str:
    """Return the label of a logarithmic axis at 1, 2, 3 and 5 times powers of ten."""
    text = f"{value:g}"
    return text if f"{value:.0e}"[0] in "1235" else ""


def _draw(axes: plt.Axes, line: FigureLine, colour: str) -> None:
    rate = np.array([np.nanmean(result.rate) for result in line.results])
    order = np.argsort(rate, kind="stable")
    mean, low, high = np.array([mean_interval(line.results[i].mse) for i in order]).T
    axes.errorbar(
        rate[order], mean, yerr=np.abs([mean - low, high - mean]), label=line.label, color=colour,
        marker="o", ms=3.5, lw=1.1, elinewidth=0.8, capsize=1.5,
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
