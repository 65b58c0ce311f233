"""Robust sequential fusion under the adaptive innovation trigger: Figures 3 to 9 and the rates.

Source: adaptive_innovation, Section 6.
"""

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

import fusion_gym
from agents.papers import adaptive_innovation_runs as runs
from agents.papers.adaptive_innovation_claims import claims
from agents.papers.adaptive_innovation_runs import SENSORS, STEPS, Lane
from agents.papers.drawing import legend, set_ticks, stack
from agents.papers.numbers import Number, cite, grid
from agents.papers.paper import Data, Paper, PaperFigure, Piece, PieceData, Settings
from agents.papers.whitening import leading_sample
from fusion_gym.arrays import Array
from fusion_gym.core.knowledge import Signals
from fusion_gym.docstrings import table
from fusion_gym.output import palette
from fusion_gym.systems.correlated.environment import CorrelatedTrackingOptions

STATES = ("position", "velocity", "acceleration")
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
    threshold differs from the step before.
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
        "counts": [round(STEPS * printed) for printed in PRINTED],
        "away": [(100.0 * p - n.mean) / n.spread for p, n in zip(PRINTED, numbers, strict=True)],
        "usual": float(norm.ppf(0.5 + 0.5 * 0.95 ** (1.0 / len(numbers)))),
        "far": np.abs(percent[OURS].mean(-1) - 100.0 * np.array(PRINTED)).max(), "percent": percent,
        "agree": [number.verdict == "agrees" for number in numbers],
        "falls": [bool((np.diff(level) < 0.0).all()) for level in levels],
        "unmoved": float(np.ptp(runs.TriggerReading(sensitivity=0.0).threshold_after(size))),
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
    """Return the data of the claims on Figures 4 to 9, by fusion rule.

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
    square, level = (lanes.both(name, AT_BOUND).sum(1).mean(-1) for name in ("square", "level"))
    per_step = ("mse_steps", "conservative_steps")
    at_bound = ("mse", "conservative", "square", "level", "beats", *per_step)
    return {
        "tables": {
            "traces": traces(names), "scales": traces(low_names), "inside": grid(STATES, rows),
        },
        "left": square / level, "rules": list(NAMES.values()),
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
        "real": [leading_sample(lanes("sici", "whitened", lane)) for lane in (ALWAYS, AT_BOUND)],
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

_LATE = slice(399, 600)  # the steps of Figure 6
_COLOURS = {"sci": palette.SKY, "sici": palette.FUSED}
_TIME = np.arange(1, STEPS + 1)
_SUM = "sum over states (SI units)"


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


def _rates_by_reading(every: Mapping[str, Mapping[str, PieceData]]) -> dict[str, str]:
    heads = "rates of sensors 1 to 3, %", "largest distance from a printed rate, percentage points"
    rows = [
        (name, cite(runs["rates"].percent.ours), f"{runs['rates'].far:.1f}")
        for name, runs in every.items()
    ]
    return {"rates_by_reading": table(("reading", *heads), rows)}


PAPER = Paper(
    "adaptive_innovation",
    (
        Piece("rates", simulate_rates, _summarise_rates, 45.0, 200),
        Piece("fusion", simulate_fusion, _summarise_fusion, 100.0, 200),
    ),
    {
        "figure_5": PaperFigure("fusion", _draw_traces, (7.2, 6.0)),
        "figure_6": PaperFigure("fusion", _draw_comparison, (7.2, 3.6)),
    },
    {
        "scales": (0.8, 0.6, 0.4), "policy": TRIGGER, "process_ratio": 1.0, "own_ratio": 1.0,
        "start_ratio": None, "power": 1.0, "same_step": False,
    },
    READINGS,
    claims,
    _rates_by_reading,
)  # fmt: skip
