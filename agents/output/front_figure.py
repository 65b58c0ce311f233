"""The figure of one learned front over the rules of its classes."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np

from fusion_gym.evaluation.intervals import Interval

from .figures import save_figure
from .palette import AGENTS_MEMORY, BOUND, GREY, ROLLOUT, RULES, RULES_MEMORY

Points = Sequence[tuple[float, float]]  # rate and error


class Layers(NamedTuple):
    """What is drawn, from back to front; what is empty is left out.

    ``single`` tuned rules, each by itself · ``plain`` and ``with_memory`` rules of the committed
    envelopes without memory and with it · ``rollout`` · ``bound`` no policy lies below · ``agent``
    rates and errors with their intervals.
    """

    single: Points
    plain: Points
    with_memory: Points
    rollout: Points
    bound: Points
    agent: Sequence[tuple[float, Interval]]


def front(path: Path, title: str, caption: str, layers: Layers) -> None:
    """Error against transmission rate, over the agent's range."""
    figure, axes = plt.subplots(figsize=(8.0, 5.4))
    rates = np.array([rate for rate, _ in layers.agent])
    errors = [interval for _, interval in layers.agent]
    right = 1.12 * max(rates.max(), 0.02)
    if layers.single:
        axes.plot(*_columns(layers.single), "o", ms=2.5, color=GREY, label="single tuned rules")
    axes.plot(
        *_columns(layers.plain), "o--", ms=3.5, color=RULES.colour, label="rules without memory"
    )
    axes.plot(
        *_columns(layers.with_memory),
        "o-",
        ms=3.5,
        color=RULES_MEMORY.colour,
        label="rules with memory",
    )
    if layers.rollout:
        label = "these, improved once by simulation"
        axes.plot(
            *_columns(layers.rollout), "D", ms=5, mfc="none", color=ROLLOUT.colour, label=label
        )
    if layers.bound:
        rate, lower = _columns(layers.bound)
        axes.plot(rate, lower, color=BOUND.colour, lw=1.2, label="proven: no policy lies below")
        axes.fill_between(rate, 0.0, lower, color=BOUND.colour, alpha=0.08, lw=0)
    spread = [
        [error.mean - error.low for error in errors],
        [error.high - error.mean for error in errors],
    ]
    axes.errorbar(
        rates, [error.mean for error in errors], yerr=spread, fmt="^-", ms=7, lw=1.2,
        elinewidth=0.9, capsize=2, color=AGENTS_MEMORY.colour, label="the agent, at seven prices",
        zorder=4,
    )  # fmt: skip
    axes.set_xlim(0.0, right)
    least = min([mse for _, mse in layers.bound] or [error.low for error in errors])
    tallest = max(
        [mse for rate, mse in layers.plain if rates.min() <= rate <= right]
        + [error.high for error in errors]
    )
    axes.set_ylim(0.9 * least, 1.15 * tallest)
    axes.set_xlabel("transmissions per sensor and step")
    axes.set_ylabel("mean squared error of the fused estimate")
    axes.set_title(title, loc="left", fontsize=10)
    figure.text(0.01, -0.01, caption, fontsize=7.5, va="top", color="0.35")
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.01, 1.0))
    save_figure(figure, path)


def _columns(points: Points) -> tuple[list[float], list[float]]:
    ordered = sorted(points)
    return [rate for rate, _ in ordered], [mse for _, mse in ordered]
