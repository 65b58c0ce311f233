"""Figures: the Pareto front, and one episode in the manner of the token-bucket paper."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np

from fusion_gym.evaluation.envelope import EnvelopePoint
from fusion_gym.evaluation.episodes import EpisodeResults, Trajectory
from fusion_gym.evaluation.intervals import mean_interval
from fusion_gym.output.files import replacing
from fusion_gym.output.palette import AGENT, INK


class FigureLine(NamedTuple):
    """One curve of the Pareto figure: its label and its policies' results, in sweep order."""

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
    """MSE against transmission rate, with 95 % intervals over episodes.

    ``lines`` are the swept baselines, ``points`` single policies, ``agent`` the learned one at each
    of its prices, ``envelope`` the lower convex hull of the baselines.
    """
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
    errors = np.interp(rates, known, [point.mse for point in hull])  # a mixture's, on any axis
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
    """The labels of a logarithmic axis: 0.1, 0.2, 0.3, 0.5, 1, …"""
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


def episode(path: Path, title: str, trajectory: Trajectory, capacity: float) -> None:
    """One episode: tokens with requests and grants above, states and estimates below."""
    steps = np.arange(1, len(trajectory.truth) + 1)
    sensors, states = trajectory.granted.shape[1], trajectory.truth.shape[1]
    figure, axes = plt.subplots(
        1 + states, 1, figsize=(9, 2.2 * (1 + states)), sharex=True, constrained_layout=True
    )
    top = axes[0]
    top.plot(steps, trajectory.tokens, color="#2a8c4a", lw=1.3, label="tokens")
    for sensor in range(sensors):
        height = capacity * (1.08 + 0.1 * sensor)
        for kind, mask in (
            ("denied", trajectory.requested[:, sensor] & ~trajectory.granted[:, sensor]),
            ("granted", trajectory.granted[:, sensor]),
        ):
            style = {"marker": "o", "color": f"C{sensor}"} if kind == "granted" else {
                "marker": "x", "color": "0.6"}  # fmt: skip
            top.plot(
                steps[mask], np.full(mask.sum(), height), linestyle="", ms=3.5,
                label=f"sensor {sensor + 1}" if kind == "granted" else None, **style,
            )  # fmt: skip
    top.set_ylabel("tokens")
    top.set_title(f"{title} (× = denied request)", loc="left", fontsize=10)
    top.legend(ncols=1 + sensors, fontsize=7.5, loc="lower right", bbox_to_anchor=(1, 1))
    for state, panel in enumerate(axes[1:]):
        deviation = np.sqrt(trajectory.variance[:, state])
        mean = trajectory.mean[:, state]
        panel.fill_between(
            steps, mean - 2 * deviation, mean + 2 * deviation, color=AGENT, alpha=0.12, lw=0,
            label="fused ± 2 claimed deviations",
        )  # fmt: skip
        for sensor in range(sensors):
            panel.plot(
                steps, trajectory.local_mean[:, sensor, state], color=f"C{sensor}", lw=0.7,
                alpha=0.7, label=f"node {sensor + 1}",
            )  # fmt: skip
        panel.plot(steps, trajectory.truth[:, state], color=INK, lw=1.4, label="state")
        panel.plot(steps, mean, color=AGENT, lw=1.2, label="fused estimate")
        reach = np.abs(trajectory.truth[:, state]).max() * 2
        panel.set_ylim(*np.clip(panel.get_ylim(), -reach, reach))
        panel.set_ylabel(f"x{state + 1}")
    axes[1].legend(ncols=6, fontsize=7, loc="lower right", bbox_to_anchor=(1, 1))
    axes[-1].set_xlabel("step")
    save_figure(figure, path)


def save_figure(figure: plt.Figure, *paths: Path) -> None:
    """Write a figure in one move a path, and close it; the same figure gives the same bytes."""
    try:
        for path in paths:
            metadata = {"Date": None} if path.suffix == ".svg" else {}
            with replacing(path) as partial:
                figure.savefig(partial, bbox_inches="tight", metadata=metadata)
    finally:
        plt.close(figure)
