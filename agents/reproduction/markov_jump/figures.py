"""The figures of the Markov jump paper, in our own drawing."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array

from ...output.palette import BLUE, GREEN, ORANGE, SENSORS, TRUTH, VERMILLION
from .runs import STATES, THRESHOLDS, UNITS

# A colour and a line for each threshold, the same in all figures.
_LINES = {
    0.0: (GREEN, "-"),
    0.9: (BLUE, (0, (5, 1))),
    1.3: (ORANGE, "-"),
    1.5: (VERMILLION, (0, (1.5, 0.8))),
}
_TIME = "time k (steps of 0.5 s)"
_LANE = 1.7


def instants(figure: Any, sent: NDArray[np.bool_]) -> None:
    """Figure 2: ``sent`` (thresholds above 0, H, l), a panel a threshold."""
    axes = figure.subplots(len(sent), 1, sharex=True)
    count = sent.shape[-1]
    for letter, m, axis, received in zip("abc", THRESHOLDS[1:], axes, sent, strict=True):
        time = np.arange(1, len(received) + 1)
        for sensor in range(count):
            base, colour = _LANE * (count - 1 - sensor), SENSORS[sensor]
            there = received[:, sensor]
            axis.plot(time[there], base + there[there], "o", ms=4, color=colour)
            axis.plot(
                time[~there], 0.0 * time[~there] + base, "o", ms=2.6, mfc="none", color=colour
            )
        axis.set_yticks(
            [_LANE * lane + up for lane in range(count) for up in (0, 1)], ["0", "1"] * count
        )
        axis.set_ylim(-0.5, _LANE * count - 0.2)
        axis.set_title(f"({letter}) m = {m:g}", loc="left")
        for sensor in range(count):
            axis.text(
                1.01,
                (_LANE * (count - 1 - sensor) + 1.0) / (_LANE * count + 0.3),
                f"node {sensor + 1}",
                transform=axis.transAxes,
                va="center",
                color=SENSORS[sensor],
            )
    axes[len(sent) // 2].set_ylabel("received (1) or not (0)")
    axes[-1].set_xlabel(_TIME)


def draw_tracking(figure: Any, truth: Array, means: Array) -> None:
    """Figure 3: ``truth`` (H, n), ``means`` (thresholds, H, n)."""
    axes = figure.subplots(len(STATES), 1, sharex=True)
    time = np.arange(1, len(truth) + 1)
    for state, axis in enumerate(axes):
        handles = axis.plot(time, truth[:, state], color=TRUTH, lw=1.8, label="state")
        handles += _curves(axis, time, means[..., state])
        _named(axis, state, STATES[state])
    axes[-1].set_xlabel(_TIME)
    _above(figure, handles)


def draw_node_errors(figure: Any, few: Array, all_runs: Array) -> None:
    """Figure 4: RMSE (thresholds, H, n) over ``few`` runs, as in the paper, and over all."""
    axes = figure.subplots(len(STATES), 1, sharex=True)
    time = np.arange(1, all_runs.shape[1] + 1)
    for state, axis in enumerate(axes):
        _curves(axis, time, few[..., state], width=0.7, alpha=0.55)
        handles = _curves(axis, time, all_runs[..., state], width=2.0)
        axis.set_ylim(bottom=0.0)
        _named(axis, state, f"RMSE of {STATES[state]}")
    axes[-1].set_xlabel(_TIME)
    _above(figure, handles)


def traces(figure: Any, values: Array) -> None:
    """Figure 5: traces (thresholds, H) of the fused covariance."""
    axis = figure.subplots()
    handles = _curves(axis, np.arange(1, values.shape[1] + 1), values, width=1.8)
    axis.set_ylabel("trace of $P_0$ (m² and m²/s²)")
    axis.set_ylim(bottom=0.0)
    axis.set_xlabel(_TIME)
    _above(figure, handles)


def _named(axis: Any, state: int, what: str) -> None:
    letter = "ab"[state]
    axis.set_title(f"({letter}) {what}", loc="left")
    axis.set_ylabel(f"{STATES[state]} ({UNITS[state]})")


def _curves(axis: Any, time: Any, values: Array, width: float = 1.4, alpha: float = 1.0) -> Any:
    """A curve (H,) of each threshold, and its handles."""
    handles = []
    for m, curve in zip(THRESHOLDS, values, strict=True):
        colour, line = _LINES[m]
        handles += axis.plot(
            time, curve, color=colour, lw=width, ls=line if alpha == 1.0 else "-", alpha=alpha,
            label=f"m = {m:g}",
        )  # fmt: skip
    return handles


def _above(figure: Any, handles: Any) -> None:
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=len(handles),
        handlelength=1.8,
        columnspacing=1.2,
        handletextpad=0.5,
    )
