"""The figures of the token-bucket paper, in our own drawing."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.patches import Patch
from numpy.typing import NDArray

from fusion_gym.arrays import Array

from ...output.palette import FUSED, INK, MEASURED, SENSORS, TRUTH

_TOKENS = INK
_CENSORED = "#e4e6ea"  # opaque, so that grid and palette leave it as it is
_TIME = "time t (steps)"


def above(figure: Any, handles: Sequence[Any], columns: int) -> None:
    """A legend above all axes, off the data."""
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=columns,
        handlelength=1.6,
        columnspacing=1.2,
        handletextpad=0.5,
    )


def tokens(
    figure: Any, level: Array, requested: NDArray[np.bool_], granted: NDArray[np.bool_]
) -> None:
    """Figure 2: ``level`` (H + 1,) from t = 0, ``requested`` and ``granted`` (H, l)."""
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    upper.step(np.arange(len(level)), level, where="post", color=_TOKENS, lw=1.6)
    least = upper.axhline(9.0, color=MEASURED, lw=1.6, ls="--")
    upper.set_ylabel("tokens")
    upper.set_ylim(0.0, 31.0)
    time = np.arange(1, len(requested) + 1)
    count = requested.shape[1]
    (sent,) = lower.plot([], [], "|", color=INK, ms=9, mew=1.8)
    (refused,) = lower.plot([], [], "x", color=INK, ms=5, mew=1.0)
    for sensor in range(count):
        colour, row = SENSORS[sensor], count - sensor
        for selection, mark, size, width in (
            (granted[:, sensor], "|", 9, 1.8),
            (requested[:, sensor] & ~granted[:, sensor], "x", 4, 1.0),
        ):
            times = time[selection]
            lower.plot(times, np.full(len(times), row), mark, color=colour, ms=size, mew=width)
    lower.set_yticks(range(1, count + 1), [f"node {count - row}" for row in range(count)])
    lower.set_ylim(0.4, count + 0.6)
    lower.grid(axis="y", visible=False)
    lower.set_xlabel(_TIME)
    (line,) = upper.plot([], [], color=_TOKENS, lw=1.6)
    for handle, label in (
        (line, "tokens"),
        (least, "needed for a grant"),
        (sent, "event, sent"),
        (refused, "event, refused"),
    ):
        handle.set_label(label)
    above(figure, [line, least, sent, refused], 4)


def draw_measurements(figure: Any, measured: Array, held: Array, component: int) -> None:
    """Figures 3 and 4: ``measured`` and ``held`` (H, l, m), one panel a node."""
    count = measured.shape[1]
    axes = figure.subplots(count, 1, sharex=True, sharey=True)
    time = np.arange(1, len(measured) + 1)
    for sensor, axis in enumerate(axes):
        (before,) = axis.plot(
            time,
            measured[:, sensor, component],
            color="#8d929b",
            lw=1.1,
            label="before the protocol: censored measurement $y$",
        )
        axis.step(time, held[:, sensor, component], where="post", color=SENSORS[sensor], lw=1.7)
        axis.set_ylabel(f"node {sensor + 1}")
    figure.supylabel(f"component {component + 1} of the measurement (no unit)", fontsize=11)
    axes[-1].set_xlabel(_TIME)
    (after,) = axes[0].plot(
        [], [], color=INK, lw=1.7, label="after: held by the filter, " + r"$\bar{y}$"
    )
    above(figure, [before, after], 1)


def states(figure: Any, truth: Array, local: Array, fused: Array, sensor: int) -> None:
    """Figures 5 to 7: ``truth``, ``local`` and ``fused`` (H, n), one panel a state."""
    axes = figure.subplots(truth.shape[1], 1, sharex=True)
    time = np.arange(1, len(truth) + 1)
    for state, axis in enumerate(axes):
        handles = [
            axis.plot(time, values[:, state], mark, color=colour, lw=width, ms=3, label=label)[0]
            for values, mark, colour, width, label in (
                (local, "o-", SENSORS[sensor], 1.0, f"estimate, node {sensor + 1}"),
                (truth, "-", TRUTH, 1.4, "state"),
                (fused, "-", FUSED, 1.4, "fused estimate"),
            )
        ]
        low, high = axis.get_ylim()
        axis.axhspan(low, 0.0, color=_CENSORED, lw=0)
        axis.set_ylim(low, high)
        axis.set_ylabel(f"$x_{state + 1}$ (no unit)")
    axes[-1].set_xlabel(_TIME)
    handles.append(Patch(color=_CENSORED, lw=0, label="censored"))
    above(figure, handles, 4)


def draw_errors(figure: Any, item: dict[str, Array], mean: dict[str, Array], sensor: int) -> None:
    """Figures 8 to 10: lg of squared errors and of the traces of the bounds.

    ``item`` has curves (H,) of a run, ``mean`` those of the mean over runs: ``local_error``,
    ``fused_error``, ``local_trace`` and ``fused_trace``.
    """
    axes = figure.subplots(2, 1, sharex=True)
    own = SENSORS[sensor]
    for axis, value, title in zip(
        axes, (item, mean), ("one episode", "mean over all episodes"), strict=True
    ):
        time = np.arange(1, len(value["fused_error"]) + 1)
        handles = [
            axis.plot(time, np.log10(value[name]), color=colour, lw=width, ls=line, label=label)[0]
            for name, colour, width, line, label in (
                ("local_trace", own, 2.4, "-", f"bound, node {sensor + 1}"),
                ("local_error", own, 1.3, (0, (2.5, 0.8)), f"squared error, node {sensor + 1}"),
                ("fused_trace", FUSED, 2.4, "-", "bound, fused"),
                ("fused_error", FUSED, 1.3, (0, (2.5, 0.8)), "squared error, fused"),
            )
        ]
        axis.set_title(title, loc="left")
        axis.set_ylabel("lg (no unit)")
    axes[-1].set_xlabel(_TIME)
    above(figure, handles, 2)
