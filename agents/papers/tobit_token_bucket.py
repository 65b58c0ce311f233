"""Tobit Kalman fusion filtering with a token bucket: Figures 2 to 10 and the theorems.

Source: tobit_token_bucket, Section 4.
"""

from functools import partial
from typing import Any

import numpy as np

from agents.papers import tobit_token_bucket_runs as runs
from agents.papers.drawing import legend, stack
from agents.papers.numbers import grid
from agents.papers.paper import Data, Paper, PaperFigure, Piece, Settings
from agents.papers.tobit_token_bucket_runs import SENSORS, TRIGGER, History, record_history, scheme
from agents.papers.walk import SomeSensors
from fusion_gym.arrays import Array
from fusion_gym.entries import Options
from fusion_gym.output.palette import FUSED, INK, MEASURED, TRUTH
from fusion_gym.output.palette import SENSORS as COLOURS
from fusion_gym.policies.registry import make_policy

_NODES = range(SENSORS)
_NODE_NAMES = tuple(f"node {m + 1}" for m in _NODES)
_WHO = (*_NODE_NAMES, "fused")
_STATES = ("first state", "second state")
_CURVES = ("local_error", "local_trace", "fused_error", "fused_trace")
_LONG, _WINDOW = 1000, 200  # steps
# What the paper's text leaves open; the environment's reading is the first.
READINGS: dict[str, Options] = {
    "one noise of variance 0.05 on B": {},
    "noise of covariance diag(0.05, 0.05) on the states": {"process_noise": "full"},
}
# Changes of the filter; the last is the standard Tobit Kalman filter in its place.
FILTERS: dict[str, Options] = {
    "as printed": {},
    "nothing arrives: prediction, no held update": {"silent": "predict"},
    "no event error κ₆ Ξ in a delivery": {"event_error": False},
    "neither held update nor event error": {"silent": "predict", "event_error": False},
    "standard Tobit Kalman filter": {"filter": "tobit"},
}
# Other filters and fusion rules under the paper's trigger and bucket.
_OTHERS: dict[str, Options] = {
    "ignoring": {"filter": "kalman"}, "ci": {"fusion": "ci"}, "sci": {"fusion": "sci"},
}  # fmt: skip


def _record(episodes: int, seed: int, settings: Settings, **options: Any) -> History:
    return record_history(
        scheme(**(settings["options"] | options)), episodes, seed, settings["policy"]
    )


# --- tokens, events and measurements --------------------------------------------------------------


def simulate_network(episodes: int, seed: int, settings: Settings) -> Data:
    """Return tokens, events, grants, and the measurements before and after the protocol."""
    bucket = scheme(**settings["options"]).network.bucket
    result = _record(episodes, seed, settings)
    free = _record(episodes, seed, settings, tokens="unlimited")
    costs = bucket.cost[:, 0]
    needed = costs.max() * SENSORS
    poor = (result.tokens_before < needed)[:, None]
    requested, granted = result.requested, result.granted
    return {
        "level": np.append(bucket.initial, result.tokens[:, 0]), "requested": requested[..., 0],
        "granted": granted[..., 0], "measured": result.measurement[..., 0],
        "held": result.held[..., 0], "rate_requested": requested.mean(0),
        "rate_granted": granted.mean(0),
        "grant_share": granted.sum((0, 1)) / np.maximum(requested.sum((0, 1)), 1),
        "tokens": result.tokens.mean(0), "lowest": float(result.tokens.min()),
        "highest": float(result.tokens.max()),
        "wanted": (free.requested.transpose(2, 0, 1) @ costs).mean(1),
        "spent": (granted.transpose(2, 0, 1) @ costs).mean(1),
        "poor_grants": int((granted & poor).sum()),
        "uncalled_grants": int((granted & ~requested).sum()),
        "rich_refusals": int((requested & ~granted & ~poor).sum()), "grants": int(granted.sum()),
        "rate": bucket.rate, "capacity": bucket.capacity, "needed": float(needed),
        "mse": result.fused_error.mean(0), "mse_unlimited": free.fused_error.mean(0),
    }  # fmt: skip


def _summarise_network(data: Data) -> Data:
    columns = ("events", "transmissions")
    rates = zip(data["rate_requested"], data["rate_granted"], strict=True)
    means = {
        "transmissions an event": [data["grant_share"]], "level of tokens": [data["tokens"]],
        "tokens spent a step": [data["spent"]],
        "tokens requested a step without a bucket": [data["wanted"]],
    }  # fmt: skip
    return {
        "columns": columns,
        "tables": {
            "rates": grid(columns, dict(zip(_NODE_NAMES, rates, strict=True))),
            "tokens": grid(("mean",), means),
        },
    }


# --- states and estimates -------------------------------------------------------------------------


def simulate_estimates(episodes: int, seed: int, settings: Settings) -> Data:
    """Return states, local, single and fused estimates, and their changes from step to step."""
    result = _record(episodes, seed, settings)
    local = np.abs(np.diff(result.truth[:, None] - result.local_mean, axis=0))
    fused = np.abs(np.diff(result.truth - result.mean, axis=0))
    censored = (result.measurement <= 0.0)[1:]
    alone = [runs.single_sensor(m, **settings["options"]) for m in _NODES]
    nodes = [record_history(task, episodes, seed) for task in alone]
    return {
        "truth": result.truth[..., 0], "local": result.local_mean[..., 0],
        "fused": result.mean[..., 0], "local_change": local.mean(0), "fused_change": fused.mean(0),
        "change_censored": _mean_where(local[:, 2, 1], censored[:, 2, 1]),
        "change_uncensored": _mean_where(local[:, 2, 1], ~censored[:, 2, 1]),
        "mse": result.fused_error.mean(0),
        "single_mse": np.array([item.fused_error.mean(0) for item in nodes]),
        "moved": np.abs(np.diff(result.mean, axis=0)).mean((0, 1)),
        "single_moved": np.array([np.abs(np.diff(o.mean, axis=0)).mean((0, 1)) for o in nodes]),
        "single_rate": [float(item.granted.mean()) for item in nodes],
        "rate": float(result.granted.mean()),
    }  # fmt: skip


def _mean_where(values: Any, selection: Any) -> Any:
    """Return the mean of values (H, E) by episode over ``selection``, or NaN."""
    with np.errstate(invalid="ignore"):
        return (values * selection).sum(0) / selection.sum(0)


def _summarise_estimates(data: Data) -> Data:
    local, fused = data["local_change"], data["fused_change"]
    strongest = np.unravel_index(int(local.mean(-1).argmax()), local.shape[:2])
    return {
        "states": _STATES, "strongest": [int(place) + 1 for place in strongest],
        "tables": {"fluctuation": grid(_STATES, dict(zip(_WHO, (*local, fused), strict=True)))},
    }  # fmt: skip


# --- errors and bounds ----------------------------------------------------------------------------


def simulate_errors(episodes: int, seed: int, settings: Settings) -> Data:
    """Return squared errors and traces of the bounds, local and fused."""
    history = _record(episodes, seed, settings)
    result: Data = {}
    for name in _CURVES:
        values = getattr(history, name)
        logarithm = np.log10(values)
        result[f"one_{name}"] = values[..., 0]
        result[f"mean_{name}"] = values.mean(-1)
        result[f"by_{name}"] = values.mean(0)
        result[f"lg_{name}"] = logarithm.mean(0)
        if name.endswith("error"):
            result[f"rough_{name}"] = np.abs(np.diff(logarithm, axis=0)).mean(0)
    error, trace = history.fused_error[:, None], history.fused_trace[:, None]
    result["share_error"] = (error < history.local_error).mean(0)
    result["share_trace"] = (trace < history.local_trace).mean(0)
    return result


def _summarise_errors(data: Data) -> Data:
    columns = {
        "squared error": "by_{}_error", "trace of the bound": "by_{}_trace",
        "lg squared error": "lg_{}_error", "lg trace": "lg_{}_trace",
    }  # fmt: skip
    rows = {
        node: [data[name.format("local")][m] for name in columns.values()]
        for m, node in enumerate(_NODE_NAMES)
    } | {"fused": [data[name.format("fused")] for name in columns.values()]}
    return {"columns": list(columns), "tables": {"errors": grid(tuple(columns), rows)}}


# --- theorems and failures of sensors -------------------------------------------------------------


def simulate_bucket_theorems(episodes: int, seed: int, settings: Settings) -> Data:
    """Return bounds, gains and condition (42); errors of long runs, starved runs, failures."""
    task, few = scheme(**settings["options"]), max(2, episodes // 10)
    result = _record(episodes, seed, settings)
    gaps = [result.truth - result.mean, *(result.truth - result.local_mean[:, m] for m in _NODES)]
    bounds = [result.bound, *(result.local_bound[:, m] for m in _NODES)]
    eigenvalues, deviations = zip(*map(runs.claimed, gaps, bounds), strict=True)
    recorded = _record(few, seed, settings)
    parts = runs.terms(task, recorded)
    long = _record(few, seed, settings, horizon=_LONG)
    windows, traces = (
        values.reshape(-1, _WINDOW, few).mean(1) for values in (long.fused_error, long.fused_trace)
    )
    others = [SomeSensors(make_policy(TRIGGER, task), {*_NODES} - {m}) for m in _NODES]
    failed = [record_history(task, episodes, seed, policy) for policy in others]
    silent = record_history(task, episodes, seed, "never")
    gains = runs.perturbed(parts, recorded, seed)
    return {
        "eigenvalue": np.array(eigenvalues), "eigenvalue_error": np.array(deviations),
        **{f"gain_{name}": values for name, values in gains.items()},
        **runs.conditioned(parts, task, recorded),
        "growth": np.exp(np.diff(np.log(silent.fused_trace[:, :few]), axis=0)).mean(0),
        "windows": windows, "traces": traces, "healthy": result.fused_error.mean(0),
        "failed": np.array([item.fused_error.mean(0) for item in failed]),
        "silent": silent.fused_error.mean(0), "few": few,
    }  # fmt: skip


def _summarise_bucket_theorems(data: Data) -> Data:
    means = {
        "share of gains near (37) with a larger bound": [data["gain_larger"]],
        "(42) holds, share of deliveries": [data["holds_delivered"]],
        "(42) holds, share of steps without": [data["holds_silent"]],
        "growth a step of the trace if nothing is sent": [data["growth"]],
    }
    each = {f"sensor {m + 1}": [failed] for m, failed in enumerate(data["failed"])}
    failures = {"no sensor": [data["healthy"]], **each, "all sensors": [data["silent"]]}
    return {
        "window": _WINDOW, "long": _LONG, "counted": runs.count_operations(),
        "printed": runs.PRINTED_OPERATIONS,
        "tables": {
            "theorems": grid(("mean",), means),
            "failures": grid(("fused squared error",), failures),
        },
    }  # fmt: skip


# --- other readings, other filters ----------------------------------------------------------------


def simulate_bucket_readings(episodes: int, seed: int, settings: Settings) -> Data:
    """Return local and fused squared errors of changed filters, and errors of other filters."""
    local, fused = [], []
    for options in FILTERS.values():
        result = _record(episodes, seed, settings, **options)
        local.append(result.local_error.mean(0))
        fused.append(result.fused_error.mean(0))
    task = scheme(**settings["options"])
    return {
        "local": np.array(local),
        "fused": np.array(fused),
        "extended": runs.filter_errors(task, result, runs.extended),
        "unscented": runs.filter_errors(task, result, runs.unscented),
        **{
            name: _record(episodes, seed, settings, **options).fused_error.mean(0)
            for name, options in _OTHERS.items()
        },
    }


def _summarise_bucket_readings(data: Data) -> Data:
    rows = {name: (*data["local"][i], data["fused"][i]) for i, name in enumerate(FILTERS)}
    return {"columns": _WHO, "tables": {"readings": grid(_WHO, rows)}}


# --- figures --------------------------------------------------------------------------------------

_CENSORED = "#e4e6ea"  # opaque, so that grid and palette leave it as it is
_TIME = "time t (steps)"
_legend = partial(legend, handlelength=1.6, columnspacing=1.2, handletextpad=0.5)


def _draw_tokens(figure: Any, data: Data) -> None:
    level, requested, granted = (data[name] for name in ("level", "requested", "granted"))
    requested, granted = requested.astype(bool), granted.astype(bool)
    upper, lower = stack(figure, 2, _TIME, height_ratios=(2, 1))
    upper.step(np.arange(len(level)), level, where="post", color=INK, lw=1.6, label="tokens")
    upper.axhline(data["needed"], color=MEASURED, lw=1.6, ls="--", label="needed for a grant")
    upper.set_ylabel("tokens")
    upper.set_ylim(0.0, data["capacity"] + 1.0)
    time = np.arange(1, len(requested) + 1)
    lower.plot([], [], "|", color=INK, ms=9, mew=1.8, label="event, sent")
    lower.plot([], [], "x", color=INK, ms=5, mew=1.0, label="event, refused")
    for sensor in _NODES:
        for selection, mark, size, width in (
            (granted[:, sensor], "|", 9, 1.8),
            (requested[:, sensor] & ~granted[:, sensor], "x", 4, 1.0),
        ):
            places = np.full(selection.sum(), SENSORS - sensor)
            style: Data = {"color": COLOURS[sensor], "ms": size, "mew": width}
            lower.plot(time[selection], places, mark, **style)
    lower.set_yticks(range(1, SENSORS + 1), _NODE_NAMES[::-1])
    lower.set_ylim(0.4, SENSORS + 0.6)
    lower.grid(axis="y", visible=False)
    _legend(figure, (upper, lower), 4)


def _draw_measurements(figure: Any, data: Data, component: int) -> None:
    """Draw a panel per node."""
    measured, held = (data[name][..., component] for name in ("measured", "held"))
    axes = stack(figure, SENSORS, _TIME, sharey=True)
    time = np.arange(1, len(measured) + 1)
    for sensor, axis in enumerate(axes):
        axis.plot(
            time, measured[:, sensor], color="#8d929b", lw=1.1,
            label="before the protocol: censored measurement $y$",
        )  # fmt: skip
        axis.step(time, held[:, sensor], where="post", color=COLOURS[sensor], lw=1.7)
        axis.set_ylabel(_NODE_NAMES[sensor])
    figure.supylabel(f"component {component + 1} of the measurement (no unit)", fontsize=11)
    label = "after: held by the filter, " + r"$\bar{y}$"
    axes[0].plot([], [], color=INK, lw=1.7, label=label)
    _legend(figure, axes, 1)


def _draw_states(figure: Any, data: Data, sensor: int) -> None:
    """Draw a panel per state."""
    truth, local, fused = data["truth"], data["local"][:, sensor], data["fused"]
    axes = stack(figure, truth.shape[1], _TIME)
    time = np.arange(1, len(truth) + 1)
    for state, axis in enumerate(axes):
        for values, mark, colour, width, label in (
            (local, "o-", COLOURS[sensor], 1.0, f"estimate, node {sensor + 1}"),
            (truth, "-", TRUTH, 1.4, "state"),
            (fused, "-", FUSED, 1.4, "fused estimate"),
        ):
            axis.plot(time, values[:, state], mark, color=colour, lw=width, ms=3, label=label)
        low, high = axis.get_ylim()
        axis.axhspan(low, 0.0, color=_CENSORED, lw=0, label="censored")
        axis.set_ylim(low, high)
        axis.set_ylabel(f"$x_{state + 1}$ (no unit)")
    _legend(figure, axes, 4)


def _draw_errors(figure: Any, data: Data, sensor: int) -> None:
    """Draw the logarithm of squared errors and of the bounds' traces, of a run and the mean."""
    axes = stack(figure, 2, _TIME)
    own, dashes = COLOURS[sensor], (0, (2.5, 0.8))
    kinds = (("one", "one episode"), ("mean", "mean over all episodes"))
    for axis, (kind, title) in zip(axes, kinds, strict=True):

        def curve(name: str, kind: str = kind) -> Array:
            values = data[f"{kind}_{name}"]
            return np.log10(values[:, sensor] if values.ndim > 1 else values)

        time = np.arange(1, len(curve("fused_error")) + 1)
        for name, colour, width, line, label in (
            ("local_trace", own, 2.4, "-", f"bound, node {sensor + 1}"),
            ("local_error", own, 1.3, dashes, f"squared error, node {sensor + 1}"),
            ("fused_trace", FUSED, 2.4, "-", "bound, fused"),
            ("fused_error", FUSED, 1.3, dashes, "squared error, fused"),
        ):
            axis.plot(time, curve(name), color=colour, lw=width, ls=line, label=label)
        axis.set_title(title, loc="left")
        axis.set_ylabel("lg (no unit)")
    _legend(figure, axes, 2)


_SIZE, _TALL = (7.2, 4.4), (7.2, 4.8)
PAPER = Paper(
    "tobit_token_bucket",
    (
        Piece("network", simulate_network, _summarise_network, 6.0, 2000),
        Piece("estimates", simulate_estimates, _summarise_estimates, 12.0, 2000),
        Piece("errors", simulate_errors, _summarise_errors, 5.0, 2000),
        Piece("theorems", simulate_bucket_theorems, _summarise_bucket_theorems, 25.0, 2000),
        Piece("readings", simulate_bucket_readings, _summarise_bucket_readings, 12.0, 2000),
    ),
    {
        "figure_2": PaperFigure("network", _draw_tokens, _SIZE),
        "figure_3": PaperFigure("network", partial(_draw_measurements, component=0), _TALL),
        "figure_4": PaperFigure("network", partial(_draw_measurements, component=1), _TALL),
        "figure_5": PaperFigure("estimates", partial(_draw_states, sensor=0), _SIZE),
        "figure_6": PaperFigure("estimates", partial(_draw_states, sensor=1), _SIZE),
        "figure_7": PaperFigure("estimates", partial(_draw_states, sensor=2), _SIZE),
        "figure_8": PaperFigure("errors", partial(_draw_errors, sensor=0), (7.2, 5.4)),
        "figure_9": PaperFigure("errors", partial(_draw_errors, sensor=1), (7.2, 5.4)),
        "figure_10": PaperFigure("errors", partial(_draw_errors, sensor=2), (7.2, 5.4)),
    },
    {"policy": TRIGGER},
    READINGS,
)
