"""Robust sequential fusion under the adaptive innovation trigger: Figures 3 to 9 and the rates.

Source: adaptive_innovation, Section 6.
"""

from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

import fusion_gym
from agents.papers import adaptive_innovation_runs as runs
from agents.papers.adaptive_innovation_runs import SENSORS, STEPS, Lane
from agents.papers.drawing import legend, set_ticks, stack
from agents.papers.numbers import Number, grid
from agents.papers.paper import Data, Paper, PaperFigure, Piece, Settings
from fusion_gym.arrays import Array
from fusion_gym.core.knowledge import Signals
from fusion_gym.output import palette
from fusion_gym.systems.correlated.environment import CorrelatedTrackingOptions

STATES = ("position", "velocity", "acceleration")
UNITS = ("m", "m/s", "m/s²")
FUSIONS = ("sci", "sici")
NAMES = {"sci": "SCI", "sici": "SICI"}
INVERSES = {"sci": 3, "sici": 4}  # of matrices in (42) and (54) at a weight
TRIGGER = "adaptive_innovation"
PRINTED = (0.6067, 0.485, 0.7067)  # Section 6, one run
TRIGGERS = OURS, PRINTED_SIGN, FIXED, TIMED = "ours", "printed_sign", "fixed", "timed"
AT_BOUND, OTHERS, ALWAYS = "at the bounds", "requests of another episode", "always"
# What the text leaves open; the actual variances Q̄ and σ̄_η² are of Figures 3 to 6.
READINGS: dict[str, Settings] = {
    "our reading": {},
    "P̄(0) = P₀, as in (7) and (23)": {"start_ratio": 1.0},
    "x(0) exactly at its mean": {"start_ratio": 0.0},
    "Q̄ = 0.8 Q, σ̄_η² = 0.4 σ_η²": {"process_ratio": 0.8, "own_ratio": 0.4},
    "l(k) = k in (10)": {"same_step": True},
    "|ε|² in (10)": {"power": 2.0},
}


# --- thresholds and rates -------------------------------------------------------------------------


def _lane(
    settings: Settings, scale: float | None = None, rule: runs.RequestFunction | None = None
) -> Lane:
    """Return a lane at a noise scale, by default at the ratios of Figures 3 to 6."""
    process, own = settings["process_ratio"], settings["own_ratio"]
    if scale is not None:
        process = own = scale
    start = settings["start_ratio"]
    return Lane((process, own, process if start is None else start), rule)


def _replaced(**changes: Any) -> runs.RequestFunction:
    """Return the requests of the printed trigger with changed parameters."""
    rule = runs.TriggerReading(**changes)
    rule.reset(1)
    return lambda signals, event: rule(signals)


def simulate_rates(episodes: int, seed: int, settings: Settings) -> Data:
    """Return rates (lanes, sensors, E); innovations and requests of the trigger, the first lane.

    ``changes`` (2, E): shares of the steps after a request, then after silence, in which a
    threshold differs from the step before. ``levels`` (H, sensors) are the thresholds in force.
    """
    rules = {
        OURS: None, PRINTED_SIGN: _replaced(sign=1.0), FIXED: _replaced(sensitivity=0.0),
        TIMED: _replaced(threshold=0.0),
    }  # fmt: skip
    every = [_lane(settings, rule=rules[name]) for name in TRIGGERS]
    requested = np.empty((STEPS, len(SENSORS), len(every) * episodes), dtype=np.bool_)
    innovation = np.empty((STEPS, len(SENSORS), episodes))
    for step in runs.steps(every, episodes, seed, settings, fusion="sici"):
        requested[step.number] = step.outcome.requested
        innovation[step.number] = step.innovation[:, :episodes]
    rates = requested.mean(0).reshape(len(SENSORS), len(every), episodes).swapaxes(0, 1)
    task = fusion_gym.make_task(CorrelatedTrackingOptions(**settings["options"]))
    rule = runs.make_trigger(settings, task)
    first, last = requested[..., :episodes], np.zeros((len(SENSORS), episodes))
    levels = np.empty(innovation.shape)
    for k, (size, requests) in enumerate(zip(np.abs(innovation), first, strict=True)):
        levels[k] = rule.threshold_after(last)
        last = np.where(requests, size, last)
    moved, after = np.diff(levels, axis=0) != 0.0, first[:-1]
    sums = [((moved & where).sum((0, 1)), where.sum((0, 1))) for where in (after, ~after)]
    changes = [changed / np.maximum(count, 1) for changed, count in sums]
    return {
        "lanes": list(TRIGGERS), "rates": rates, "changes": np.array(changes),
        "levels": levels[..., 0],
        "ceiling": float(rule.threshold_after(np.zeros((len(SENSORS), 1))).max()),
        "requested": first[..., 0].astype(np.int64),
    }  # fmt: skip


def _summarise_rates(data: Data) -> Data:
    percent = dict(zip(data["lanes"], 100.0 * data["rates"], strict=True))
    numbers = [
        Number.from_sample(f"{name}, rate", sample, 100.0 * printed, unit="%")
        for name, sample, printed in zip(SENSORS, percent[OURS], PRINTED, strict=True)
    ]
    size = np.tile(np.linspace(0.0, 5.0, 51), (len(SENSORS), 1))
    levels = [runs.TriggerReading(sign=sign).threshold_after(size) for sign in (1.0, -1.0)]
    return {
        "tables": {"rates": numbers},
        "steps": STEPS, "counts": [round(STEPS * printed) for printed in PRINTED],
        "away": [(100.0 * p - n.mean) / n.spread for p, n in zip(PRINTED, numbers, strict=True)],
        "usual": float(norm.ppf(0.5 + 0.5 * 0.95 ** (1.0 / len(numbers)))),
        "far": np.abs(percent[OURS].mean(-1) - 100.0 * np.array(PRINTED)).max(), "percent": percent,
        "agree": [number.verdict == "agrees" for number in numbers],
        "falls": [bool((np.diff(level) < 0.0).all()) for level in levels],
        "unmoved": float(np.ptp(runs.TriggerReading(sensitivity=0.0).threshold_after(size))),
        "shares": data["requested"][WINDOW].mean(0),
    }  # fmt: skip


# --- errors, actual and conservative variances ----------------------------------------------------


def _of_other_episodes(episodes: int) -> runs.RequestFunction:
    """Return the trigger's requests in the next episode of the first lane.

    They have the same rates and patterns, and are independent of the episode's own noise.
    """

    def request(signals: Signals, event: NDArray[np.bool_]) -> NDArray[np.bool_]:
        others = np.roll(event[:, :episodes], -1, axis=1)
        return np.tile(others, event.shape[1] // episodes)

    return request


def simulate_fusion(episodes: int, seed: int, settings: Settings) -> Data:
    """Return the data of Figures 4 to 9 and their claims, by fusion rule.

    See :class:`ErrorRecord`. The lanes are the trigger at the bounds of the variances and at every
    noise scale, and two other policies at the bounds.
    """
    lane = partial(_lane, settings)
    lanes = {AT_BOUND: lane()} | {f"scale {scale}": lane(scale) for scale in settings["scales"]}
    lanes |= {
        OTHERS: lane(rule=_of_other_episodes(episodes)),
        ALWAYS: lane(rule=lambda signals, event: np.ones_like(event)),
    }
    data: Data = {
        "lanes": list(lanes), "scales": list(settings["scales"]),
        "reached": all(ratio == 1.0 for ratio in lane().ratios),
    }  # fmt: skip
    for fusion in FUSIONS:
        record = runs.ErrorRecord(len(lanes), episodes, with_nodes=fusion == FUSIONS[0])
        options = {"fusion": fusion, "track_actual": True}
        for step in runs.steps(lanes.values(), episodes, seed, settings, **options):
            record.add(step)
        data |= {f"{fusion}_{name}": value for name, value in record.arrays().items()}
    return data


class _Lanes:
    """The data by fusion rule, name and setting."""

    def __init__(self, data: Data) -> None:
        self.data = data

    def __call__(self, fusion: str, name: str, lane: str) -> Array:
        result: Array = self.data[f"{fusion}_{name}"][self.data["lanes"].index(lane)]
        return result

    def both(self, name: str, lane: str) -> Array:
        """Return the data of both fusion rules, stacked."""
        return np.stack([self(fusion, name, lane) for fusion in FUSIONS])

    def means(self, name: str, lanes: Iterable[str]) -> Array:
        """Return means over episodes (fusion rules, lanes, …)."""
        return np.stack([self.both(name, lane).mean(-1) for lane in lanes], axis=1)


def _summarise_fusion(data: Data) -> Data:
    """The page's tables, ``at`` the bounds the arrays of both rules, and shares by setting."""
    lanes, scaled = _Lanes(data), {f"scale {scale}": scale for scale in data["scales"]}
    names = {AT_BOUND: "trigger", OTHERS: "trigger's requests of another episode", ALWAYS: "always"}
    low_names = {lane: f"trigger, variances {scaled[lane]} of the bounds" for lane in scaled}
    quantities = {"mse": "MSE", "actual": "actual trace", "conservative": "conservative trace"}

    def traces(group: dict[str, str]) -> list[Number]:
        rows = {
            f"{NAMES[f]}, {label}": [lanes(f, quantity, lane) for quantity in quantities]
            for f in FUSIONS
            for lane, label in group.items()
        }
        return grid(tuple(quantities.values()), rows)

    rows = {
        f"{NAMES[f]}, variances {scale:g} of the bounds": 100.0 * lanes(f, "inside", lane)
        for f in FUSIONS
        for lane, scale in scaled.items()
    }
    every, first = [AT_BOUND, *scaled], next(iter(scaled))
    per_step = ("mse_steps", "conservative_steps")
    at_bound = ("mse", "conservative", "square", "level", "beats", *per_step)
    return {
        "tables": {
            "traces": traces(names), "scales": traces(low_names), "inside": grid(STATES, rows),
        },
        "quantities": list(quantities.values()), "states": STATES, "rules": list(NAMES.values()),
        "runs": data["sci_mse"].shape[-1], "ellipses": runs.ELLIPSES,
        "late": lanes.both("mse_steps", AT_BOUND)[:, _LATE],
        "at": {name: lanes.both(name, AT_BOUND) for name in at_bound},
        "inside": lanes.means("inside", scaled),
        "relative": _relative(lanes, "actual", AT_BOUND, AT_BOUND),
        "independent": _relative(lanes, "actual", OTHERS, OTHERS),
        "inverses": list(INVERSES.values()),
        "reached": data["reached"], "price": _relative(lanes, "mse", AT_BOUND, ALWAYS),
        "other": lanes.both("mse", OTHERS),
        "ordered": lanes.means("ordered", scaled).min(-1),
        "bounded": lanes.means("bounded", every),
        "settings": [name.removeprefix("scale ") for name in every],
        "worst": np.max([lanes.both("worst", lane).max(-1) for lane in every], axis=0),
        "real": [runs.top(lanes("sici", "whitened", lane)) for lane in (ALWAYS, AT_BOUND)],
        "node": lanes("sci", "node_mse", AT_BOUND),
        "node_share": min(float(lanes("sci", "node_bounded", lane).min()) for lane in every),
        "gap": float(lanes("sci", "node_gap", AT_BOUND).max()),
        "whole": lanes.both("encloses", first).mean(-1),
        "plane": lanes.both("encloses_plane", first).mean(-1),
    }  # fmt: skip


def _relative(lanes: _Lanes, name: str, lane: str, other: str) -> Array:
    """MSE over the mean of another quantity, or of another setting, minus 1, in per cent."""
    mean = lanes.both(name, other).mean(-1, keepdims=True)
    return np.asarray(100.0 * (lanes.both("mse", lane) / mean - 1.0))


# --- figures --------------------------------------------------------------------------------------

WINDOW = slice(299, 400)  # the steps of Figure 3
_LATE = slice(399, 600)  # and of Figure 6
_COLOURS = {"sci": palette.SKY, "sici": palette.FUSED}
_DRAWN = 5  # steps from one point of a crowded line to the next
_TIME = np.arange(1, STEPS + 1)
_SUM = "sum over states (SI units)"


def _draw_thresholds(figure: Any, data: Data) -> None:
    time, requested = _TIME[WINDOW], data["requested"].astype(bool)[WINDOW]
    axes = stack(figure, len(SENSORS), "step k", sharey=True)
    for i, (axis, name) in enumerate(zip(axes, SENSORS, strict=True)):
        colour, requests = palette.SENSORS[i], requested[:, i]
        axis.step(time, data["levels"][WINDOW, i], where="mid", color=colour, lw=1.6)
        axis.plot(time[requests], np.full(requests.sum(), 0.01), "|", color=palette.BLACK, ms=6)
        axis.set_title(f"({'abc'[i]}) {name}", loc="left", color=colour)
        axis.set_ylim(0.0, 1.02 * data["ceiling"] or 1.0)
        axis.set_ylabel("θ (m²)" if i == 0 else "θ (m²/s²)" if i == 1 else "θ (m²/s⁴)")
    axes[-1].set_xlim(time[0], time[-1])


def _draw_tracking(figure: Any, data: Data) -> None:
    lanes = _Lanes(data)
    axes = stack(figure, 3, "step k")
    for state, axis in enumerate(axes):
        truth = lanes("sci", "truth", AT_BOUND)[:, state]
        axis.plot(_TIME, truth, color=palette.TRUTH, lw=3.0, label="true value")
        for fusion in FUSIONS:
            axis.plot(
                _TIME, lanes(fusion, "mean", AT_BOUND)[:, state], color=_COLOURS[fusion],
                lw=2.0 if fusion == "sci" else 1.0, label=NAMES[fusion],
            )  # fmt: skip
        axis.set_title(f"({'abc'[state]}) {STATES[state]}", loc="left")
        axis.set_ylabel(f"$x_{state + 1}$ ({UNITS[state]})")
    axes[-1].set_xlim(0, STEPS)
    legend(figure, axes[0], 3)


def _draw_traces(figure: Any, data: Data) -> None:
    lanes = _Lanes(data)
    axes = stack(figure, 2, "step k", sharey=True)
    for place, (fusion, axis) in enumerate(zip(FUSIONS, axes, strict=True)):
        for name, colour, label in (
            ("conservative", palette.BLACK, "trace of conservative variance"),
            ("actual", palette.GREEN, "trace of actual variance"),
            ("mse", _COLOURS[fusion], f"MSE of {NAMES[fusion]}"),
        ):
            curve = lanes(fusion, f"{name}_steps", AT_BOUND)
            axis.plot(_TIME, curve, color=colour, lw=1.6, label=label)
        axis.set_yscale("log")
        axis.set_ylabel(_SUM)
        axis.set_title(f"({'ab'[place]}) {NAMES[fusion]}", loc="left")
        axis.legend(loc="upper right", ncols=3, fontsize=9, columnspacing=1.0)
        axis.set_ylim(0.2, 4.0)
        set_ticks(axis, [0.2, 0.3, 0.5, 1.0, 2.0, 4.0])
    axes[-1].set_xlim(0, STEPS)


def _draw_comparison(figure: Any, data: Data) -> None:
    (axis,) = stack(figure, 1, "step k")
    for fusion in FUSIONS:
        mse = _Lanes(data)(fusion, "mse_steps", AT_BOUND)[_LATE]
        axis.plot(_TIME[_LATE], mse, color=_COLOURS[fusion], lw=1.8, label=NAMES[fusion])
    axis.set_ylabel(f"MSE, {_SUM}")
    axis.set_xlim(_TIME[_LATE][0], STEPS)
    axis.set_ylim(bottom=0.0)
    legend(figure, axis, 2)


def _draw_errors(figure: Any, data: Data, fusion: str) -> None:
    lanes, scales = _Lanes(data), data["scales"]
    axes = figure.subplots(3, len(scales), sharex=True, sharey="row", squeeze=False)
    time = _TIME[::_DRAWN]
    for column, scale in enumerate(scales):
        truth, mean, actual, bound = (
            lanes(fusion, name, f"scale {scale}")[::_DRAWN]
            for name in ("truth", "mean", "actual_deviation", "conservative_deviation")
        )
        for state in range(3):
            axis = axes[state, column]
            for sign in (3.0, -3.0):
                (robust,) = axis.plot(time, sign * bound[:, state], color=palette.BLACK, lw=0.9)
                (own,) = axis.plot(time, sign * actual[:, state], color=palette.GREEN, lw=0.9)
            error = (truth - mean)[:, state]
            (curve,) = axis.plot(time, error, color=_COLOURS[fusion], lw=1.1)
        axes[0, column].set_title(f"({chr(ord('a') + column)}) {scale:g} of bounds", loc="left")
        axes[2, column].set_xlabel("step k")
    for state, row in enumerate(axes):
        row[0].set_ylabel(f"{STATES[state]}\nerror ({UNITS[state]})")
        limit = max(
            lanes(fusion, "conservative_deviation", f"scale {scale}")[60:, state].max()
            for scale in scales
        )
        row[0].set_ylim(-3.0 * limit * 1.05, 3.0 * limit * 1.05)
    names = ("error of the fused estimate", "robust ±3σ", "actual ±3σ")
    figure.legend((curve, robust, own), names, loc="outside upper center", ncols=3)


def _ellipse(covariance: Array) -> Array:
    around = np.linspace(0.0, 2.0 * np.pi, 181)
    root = np.linalg.cholesky(covariance[:2, :2])
    return np.asarray(root @ np.stack((np.cos(around), np.sin(around))))


def _draw_ellipses(figure: Any, data: Data) -> None:
    axes = figure.subplots(2, 2)
    for row, fusion in zip(axes, FUSIONS, strict=True):
        both = _Lanes(data)(fusion, "ellipses", f"scale {data['scales'][0]}")
        colours = (_COLOURS[fusion], *palette.SENSORS)
        names = (NAMES[fusion], *SENSORS)
        for axis in row:
            for place in (3, 2, 1, 0):
                for kind, style in ((0, "-"), (1, ":")):
                    axis.plot(
                        *_ellipse(both[kind, place]), style, color=colours[place], lw=1.8,
                        label=names[place] if kind == 0 else None,
                    )  # fmt: skip
            axis.set_xlabel("position error (m)")
        row[0].set_ylabel("velocity error (m/s)")
        row[0].set_title(f"({'ab'[FUSIONS.index(fusion)]}) {NAMES[fusion]}", loc="left")
        row[1].set_title("enlarged", loc="left")
        near = np.abs(_ellipse(both[0, 1])).max(1)
        row[1].set_xlim(-1.3 * near[0], 1.3 * near[0])
        row[1].set_ylim(-1.3 * near[1], 1.3 * near[1])
    entries = [axis.get_legend_handles_labels() for axis in axes[:, 0]]
    handles, labels = (
        [each[part][-1] for each in entries] + entries[0][part][-2::-1] for part in (0, 1)
    )
    for label, style in (("conservative", "-"), ("actual", ":")):
        handles.append(axes[0, 0].plot([], [], style, color=palette.INK, lw=1.8)[0])
        labels.append(label)
    figure.legend(handles, labels, loc="outside upper center", ncols=7, columnspacing=0.8)


PAPER = Paper(
    "adaptive_innovation",
    (
        Piece("rates", simulate_rates, _summarise_rates, 45.0, 200),
        Piece("fusion", simulate_fusion, _summarise_fusion, 100.0, 200),
    ),
    {
        "figure_3": PaperFigure("rates", _draw_thresholds, (7.2, 5.6)),
        "figure_4": PaperFigure("fusion", _draw_tracking, (7.2, 6.4)),
        "figure_5": PaperFigure("fusion", _draw_traces, (7.2, 6.0)),
        "figure_6": PaperFigure("fusion", _draw_comparison, (7.2, 3.6)),
        "figure_7": PaperFigure("fusion", partial(_draw_errors, fusion="sci"), (7.2, 5.6)),
        "figure_8": PaperFigure("fusion", partial(_draw_errors, fusion="sici"), (7.2, 5.6)),
        "figure_9": PaperFigure("fusion", _draw_ellipses, (7.6, 6.6)),
    },
    {
        "scales": (0.8, 0.6, 0.4), "policy": TRIGGER, "process_ratio": 1.0, "own_ratio": 1.0,
        "start_ratio": None, "power": 1.0, "same_step": False,
    },
    READINGS,
)  # fmt: skip
