"""Figures 4 to 9 of the adaptive innovation paper."""

from typing import Any

import numpy as np
from matplotlib.ticker import FixedLocator, FormatStrFormatter, NullLocator

from fusion_gym.arrays import Array

from ...output import palette
from ..judging import percent
from ..piece_result import Picture
from .errors import AT_BOUND, ELLIPSES, FUSIONS
from .runs import SCALES, SENSORS, STATES, STEPS, UNITS

_COLOURS = {"sci": palette.SKY, "sici": palette.FUSED}
_NAMES = {"sci": "SCI", "sici": "SICI"}
_WINDOW = (400, 600)  # the steps of Figure 6
_ENLARGED = 0.8  # the noise scale of Figure 9
_DRAWN = 5  # steps from one point of a crowded line to the next
_TIME = np.arange(1, STEPS + 1)
_SUM = "sum over states (SI units)"


def tracking_pictures(data: dict[str, Any]) -> list[Picture]:
    """All of them, in the paper's order."""
    return [
        _tracking(data),
        _traces(data),
        _compared(data),
        _errors(data, "sci", 7),
        _errors(data, "sici", 8),
        _ellipses(data),
    ]


def _lane(data: dict[str, Any], name: str) -> int:
    return data["lanes"].index(name)


def _tracking(data: dict[str, Any]) -> Picture:
    lane = _lane(data, AT_BOUND)
    truth = data["sci_truth"][lane]

    def draw(figure: Any) -> None:
        axes = figure.subplots(3, 1, sharex=True)
        for state, axis in enumerate(axes):
            axis.plot(_TIME, truth[:, state], color=palette.TRUTH, lw=3.0, label="true value")
            for fusion in FUSIONS:
                axis.plot(
                    _TIME,
                    data[f"{fusion}_mean"][lane][:, state],
                    color=_COLOURS[fusion],
                    lw=2.0 if fusion == "sci" else 1.0,
                    label=_NAMES[fusion],
                )
            axis.set_title(f"({'abc'[state]}) {STATES[state]}", loc="left")
            axis.set_ylabel(f"$x_{state + 1}$ ({UNITS[state]})")
        axes[-1].set_xlabel("step k")
        axes[-1].set_xlim(0, STEPS)
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)

    share = [
        float(
            1.0 - data[f"{f}_square"][lane].mean(-1).sum() / data[f"{f}_level"][lane].sum(0).mean()
        )
        for f in FUSIONS
    ]
    return Picture(
        "figure_4",
        "Figure 4: true value and fused estimates",
        "One run at the bounds of the variances, 600 steps. Both fused estimates lie on the true "
        "value but for the acceleration's noise; over all runs what is left is "
        f"{percent(1 - share[0])} (SCI) and {percent(1 - share[1])} (SICI) of the states' mean "
        "square about their start. As the paper's, but for the run itself.",
        draw,
        (7.2, 6.4),
    )


def _traces(data: dict[str, Any]) -> Picture:
    lane = _lane(data, AT_BOUND)

    def draw(figure: Any) -> None:
        axes = figure.subplots(2, 1, sharex=True, sharey=True)
        for place, (fusion, axis) in enumerate(zip(FUSIONS, axes, strict=True)):
            for name, colour, style, label in (
                ("conservative", palette.BLACK, "-", "trace of conservative variance"),
                ("actual", palette.GREEN, "-", "trace of actual variance"),
                ("mse", _COLOURS[fusion], "-", f"MSE of {_NAMES[fusion]}"),
            ):
                axis.plot(
                    _TIME, data[f"{fusion}_{name}_steps"][lane],
                    color=colour, ls=style, lw=1.6, label=label,
                )  # fmt: skip
            axis.set_yscale("log")
            axis.set_ylabel(_SUM)
            axis.set_title(f"({'ab'[place]}) {_NAMES[fusion]}", loc="left")
            axis.legend(loc="upper right", ncols=3, fontsize=9, columnspacing=1.0)
            axis.set_ylim(0.2, 4.0)
            axis.yaxis.set_major_locator(FixedLocator([0.2, 0.3, 0.5, 1.0, 2.0, 4.0]))
            axis.yaxis.set_major_formatter(FormatStrFormatter("%g"))
            axis.yaxis.set_minor_locator(NullLocator())
        axes[-1].set_xlabel("step k")
        axes[-1].set_xlim(0, STEPS)

    return Picture(
        "figure_5",
        "Figure 5: MSE and traces of actual and conservative variances",
        f"Means over all {_runs(data)} runs at the bounds, at each step. The MSE lies below the "
        "conservative trace, as in the paper, but well below the actual trace too, where the "
        "paper sees both close together.",
        draw,
        (7.2, 6.0),
    )


def _compared(data: dict[str, Any]) -> Picture:
    lane = _lane(data, AT_BOUND)
    window = slice(_WINDOW[0] - 1, _WINDOW[1])

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        for fusion in FUSIONS:
            mse = data[f"{fusion}_mse_steps"][lane][window]
            colour, name = _COLOURS[fusion], _NAMES[fusion]
            axis.plot(_TIME[window], mse, color=colour, lw=1.8, label=name)
        axis.set_xlabel("step k")
        axis.set_ylabel(f"MSE, {_SUM}")
        axis.set_xlim(*_WINDOW)
        axis.set_ylim(bottom=0.0)
        figure.legend(*axis.get_legend_handles_labels(), loc="outside upper center", ncols=2)

    return Picture(
        "figure_6",
        "Figure 6: MSE of both fusion rules",
        f"Means over all {_runs(data)} runs at the bounds, steps 400 to 600: SICI lies below "
        "SCI, as in the paper.",
        draw,
        (7.2, 3.6),
    )


def _errors(data: dict[str, Any], fusion: str, number: int) -> Picture:
    def draw(figure: Any) -> None:
        axes = figure.subplots(3, 3, sharex=True, sharey="row")
        time = _TIME[::_DRAWN]
        for column, scale in enumerate(SCALES):
            lane = _lane(data, f"scale {scale}")
            error = (data[f"{fusion}_truth"][lane] - data[f"{fusion}_mean"][lane])[::_DRAWN]
            actual = 3.0 * data[f"{fusion}_actual_deviation"][lane][::_DRAWN]
            bound = 3.0 * data[f"{fusion}_conservative_deviation"][lane][::_DRAWN]
            for state in range(3):
                axis = axes[state, column]
                for sign in (1.0, -1.0):
                    (robust,) = axis.plot(time, sign * bound[:, state], color=palette.BLACK)
                    (own,) = axis.plot(time, sign * actual[:, state], color=palette.GREEN)
                    robust.set_linewidth(0.9)
                    own.set_linewidth(0.9)
                (curve,) = axis.plot(time, error[:, state], color=_COLOURS[fusion], lw=1.1)
                if state == 0:
                    axis.set_title(f"({'abc'[column]}) {scale:g} of bounds", loc="left")
                if column == 0:
                    axis.set_ylabel(f"{STATES[state]}\nerror ({UNITS[state]})")
                if state == 2:
                    axis.set_xlabel("step k")
        for row, state in zip(axes, range(3), strict=True):
            lanes = [_lane(data, f"scale {scale}") for scale in SCALES]
            bound = data[f"{fusion}_conservative_deviation"][lanes, 60:, state]
            limit = 3.0 * float(bound.max()) * 1.05
            row[0].set_ylim(-limit, limit)
        names = ("error of the fused estimate", "robust ±3σ", "actual ±3σ")
        figure.legend((curve, robust, own), names, loc="outside upper center", ncols=3)

    lanes = [_lane(data, f"scale {scale}") for scale in SCALES]
    errors = data[f"{fusion}_truth"][lanes] - data[f"{fusion}_mean"][lanes]
    within = np.abs(errors) <= 3.0 * data[f"{fusion}_actual_deviation"][lanes]
    share = float(within.mean())
    return Picture(
        f"figure_{number}",
        f"Figure {number}: errors of {_NAMES[fusion]} with ±3 deviations, three sets of variances",
        "One run; columns (a) to (c) are the paper's three groups of actual variances. The smaller "
        "the variances, the further the actual bounds lie within the robust ones. "
        f"{percent(share)} of this run's errors lie inside the actual bounds. As the paper's; all "
        "three states are shown, every fifth step.",
        draw,
        (7.2, 5.6),
    )


def _ellipses(data: dict[str, Any]) -> Picture:
    lane = _lane(data, f"scale {_ENLARGED}")
    around = np.linspace(0.0, 2.0 * np.pi, 181)
    circle = np.stack((np.cos(around), np.sin(around)))

    def ellipse(covariance: Array) -> Array:
        return np.linalg.cholesky(covariance[:2, :2]) @ circle

    def draw(figure: Any) -> None:
        axes = figure.subplots(2, 2)
        for row, fusion in zip(axes, FUSIONS, strict=True):
            both = data[f"{fusion}_ellipses"][lane]
            colours = (_COLOURS[fusion], *palette.SENSORS)
            names = (_NAMES[fusion], *SENSORS)
            for axis in row:
                for place in (3, 2, 1, 0):
                    for kind, style in ((0, "-"), (1, ":")):
                        axis.plot(
                            *ellipse(both[kind, place]), style, color=colours[place], lw=1.8,
                            label=names[place] if kind == 0 else None,
                        )  # fmt: skip
                axis.set_xlabel("position error (m)")
            row[0].set_ylabel("velocity error (m/s)")
            row[0].set_title(f"({'ab'[FUSIONS.index(fusion)]}) {_NAMES[fusion]}", loc="left")
            row[1].set_title("enlarged", loc="left")
            near = np.abs(ellipse(both[0, 1])).max(1)
            row[1].set_xlim(-1.3 * near[0], 1.3 * near[0])
            row[1].set_ylim(-1.3 * near[1], 1.3 * near[1])
        both_fused = [axis.get_legend_handles_labels() for axis in axes[:, 0]]
        handles = [each[0][-1] for each in both_fused] + both_fused[0][0][-2::-1]
        labels = [each[1][-1] for each in both_fused] + both_fused[0][1][-2::-1]
        for label, style in (("conservative", "-"), ("actual", ":")):
            handles.append(axes[0, 0].plot([], [], style, color=palette.INK, lw=1.8)[0])
            labels.append(label)
        figure.legend(handles, labels, loc="outside upper center", ncols=7, columnspacing=0.8)

    return Picture(
        "figure_9",
        "Figure 9: ellipses of conservative and actual covariances",
        f"Position and velocity at step {ELLIPSES} of one run, actual variances {_ENLARGED:g} of "
        "the bounds (the paper names neither step nor states); one standard deviation. Every "
        "node's actual ellipse lies in its conservative one, as in the paper; the fused "
        "conservative one sticks out of some nodes', where the paper sees it in all three.",
        draw,
        (7.6, 6.6),
    )


def _runs(data: dict[str, Any]) -> int:
    return data["sci_mse"].shape[-1]
