"""Figures of results: the Pareto front and the costs."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np

from fusion_gym.evaluation.episodes import EpisodeResults
from fusion_gym.evaluation.metrics import PriceComparison, mean_interval
from fusion_gym.output.files import replacing
from fusion_gym.output.palette import AGENT, BLUE, GREEN, PURPLE, SKY


class FigureLine(NamedTuple):
    """A curve of the Pareto figure: its label and its policies' results, in sweep order."""

    label: str
    results: Sequence[EpisodeResults]


def pareto(
    path: Path, title: str, lines: Sequence[FigureLine], costs: Sequence[PriceComparison]
) -> None:
    """Draw MSE against transmission rate, and the last line's cost beside the best baseline's.

    Bars are 95 % intervals over episodes.
    """
    figure, (front, beside) = plt.subplots(1, 2, figsize=(10.5, 4.6), layout="constrained")
    _draw_front(front, lines, [*[BLUE, SKY, GREEN, PURPLE][: len(lines) - 1], AGENT])
    figure.suptitle(title, x=0.01, ha="left", fontsize=11)
    mean, low, high = np.array([c.difference for c in costs]).T / [c.cost or np.nan for c in costs]
    spread, places = 100.0 * np.abs([mean - low, high - mean]), np.arange(len(costs))
    beside.axhline(0.0, color=BLUE, lw=1.6)
    beside.errorbar(places, 100.0 * mean, yerr=spread, color=AGENT, marker="o", ms=5, capsize=3)
    beside.set_xticks(places, [f"{c.price:.3g}" for c in costs])
    cost = f"cost above the best rule's [%]\n(below 0: {lines[-1].label} is cheaper)"
    beside.set(xlabel="price of a token", ylabel=cost)
    save_figure(figure, path)


def rules(path: Path, title: str, lines: Sequence[FigureLine], span: tuple[float, float]) -> None:
    """Draw MSE against transmission rate, and each rule's cost at prices above the least cost."""
    figure, (front, costs) = plt.subplots(1, 2, figsize=(10.5, 4.6), layout="constrained")
    colours = [f"C{place}" for place in range(len(lines))]
    _draw_front(front, lines, colours)
    figure.suptitle(title, x=0.01, ha="left", fontsize=11)
    prices = np.geomspace(*span, 40)
    means = [[(r.error_cost.mean(), r.tokens.mean()) for r in line.results] for line in lines]
    each = [(np.array(own) @ [np.ones(40), prices]).min(0) for own in means]
    for own, colour in zip(each, colours, strict=True):
        costs.plot(prices, 100.0 * (own / np.min(each, axis=0) - 1.0), color=colour)
    label = "cost = error + price · tokens,\nabove the cheapest rule's [%]"
    costs.set_xscale("log")
    costs.xaxis.set(major_formatter=plain_tick, minor_formatter=plain_tick)
    costs.set(ylim=(-2, 60), xlabel="price of a token", ylabel=label)
    save_figure(figure, path)


def _draw_front(axes: plt.Axes, lines: Sequence[FigureLine], colours: Sequence[str]) -> None:
    for line, colour in zip(lines, colours, strict=True):
        _draw(axes, line, colour)
    axes.set(xlabel="transmissions per sensor and step", ylabel="mean squared error")
    means = np.array([result.mse.mean() for line in lines for result in line.results])
    if means.max() > 6 * means.min():
        axes.set_yscale("log")
        axes.yaxis.set(major_formatter=plain_tick, minor_formatter=plain_tick)
    axes.set_xlim(left=-0.005)
    axes.legend(fontsize=8, loc="upper right")


def plain_tick(value: float, place: float | None = None) -> str:
    """Return the label of a logarithmic axis at 1, 2, 3 and 5 times powers of ten."""
    text = f"{value:g}"
    return text if f"{value:.0e}"[0] in "1235" else ""


def _draw(axes: plt.Axes, line: FigureLine, colour: str) -> None:
    rate = np.array([result.rate.mean() for result in line.results])
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
