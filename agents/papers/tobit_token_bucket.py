"""Tobit Kalman fusion filtering with a token bucket: Figures 2 to 10 and the theorems.

Source: tobit_token_bucket, Section 4.
"""

from typing import Any

import numpy as np

from agents.papers import tobit_token_bucket_runs as runs
from agents.papers.drawing import legend, stack
from agents.papers.numbers import grid
from agents.papers.paper import Data, Paper, PaperFigure, Piece, Settings
from agents.papers.tobit_token_bucket_claims import LONG, WINDOW, claims
from agents.papers.tobit_token_bucket_runs import SENSORS, TRIGGER, History, record_history, scheme
from agents.papers.walk import SomeSensors
from fusion_gym.entries import Options
from fusion_gym.output.palette import FUSED
from fusion_gym.output.palette import SENSORS as COLOURS
from fusion_gym.policies.registry import make_policy

_NODES = range(SENSORS)
_NODE_NAMES = tuple(f"node {m + 1}" for m in _NODES)
_WHO = (*_NODE_NAMES, "fused")
_CURVES = ("local_error", "local_trace", "fused_error", "fused_trace")
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
    """Return tokens, events and grants."""
    bucket = scheme(**settings["options"]).network.bucket
    result = _record(episodes, seed, settings)
    free = _record(episodes, seed, settings, tokens="unlimited")
    costs = bucket.cost[:, 0]
    needed = costs.max() * SENSORS
    poor = (result.tokens_before < needed)[:, None]
    requested, granted = result.requested, result.granted
    return {
        "rate_requested": requested.mean(0),
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
        "tokens spent per step": [data["spent"]],
        "tokens requested per step without a bucket": [data["wanted"]],
    }  # fmt: skip
    return {
        "tables": {
            "rates": grid(columns, dict(zip(_NODE_NAMES, rates, strict=True))),
            "tokens": grid(("mean",), means),
        },
    }


# --- states and estimates -------------------------------------------------------------------------


def simulate_estimates(episodes: int, seed: int, settings: Settings) -> Data:
    """Return errors of local, single and fused estimates, and changes from step to step."""
    result = _record(episodes, seed, settings)
    local = np.abs(np.diff(result.truth[:, None] - result.local_mean, axis=0))
    fused = np.abs(np.diff(result.truth - result.mean, axis=0))
    censored = (result.measurement <= 0.0)[1:]
    alone = [runs.single_sensor(m, **settings["options"]) for m in _NODES]
    nodes = [record_history(task, episodes, seed) for task in alone]
    return {
        "local_change": local.mean(0), "fused_change": fused.mean(0),
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
    rows = dict(zip(_WHO, (*data["local_change"], data["fused_change"]), strict=True))
    return {"tables": {"fluctuation": grid(("first state", "second state"), rows)}}


# --- errors and bounds ----------------------------------------------------------------------------


def simulate_errors(episodes: int, seed: int, settings: Settings) -> Data:
    """Return squared errors and traces of the bounds, local and fused."""
    history = _record(episodes, seed, settings)
    result: Data = {}
    for name in _CURVES:
        values = getattr(history, name)
        logarithm = np.log10(values)
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
    return {"tables": {"errors": grid(tuple(columns), rows)}}


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
    long = _record(few, seed, settings, horizon=LONG)
    windows, traces = (
        values.reshape(-1, WINDOW, few).mean(1) for values in (long.fused_error, long.fused_trace)
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
        "silent": silent.fused_error.mean(0),
    }  # fmt: skip


def _summarise_bucket_theorems(data: Data) -> Data:
    means = {
        "share of gains near (37) with a larger bound": [data["gain_larger"]],
        "(42) holds, share of deliveries": [data["holds_delivered"]],
        "(42) holds, share of steps without": [data["holds_silent"]],
        "growth per step of the trace if nothing is sent": [data["growth"]],
    }
    each = {f"sensor {m + 1}": [failed] for m, failed in enumerate(data["failed"])}
    failures = {"no sensor": [data["healthy"]], **each, "all sensors": [data["silent"]]}
    return {
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
    return {"tables": {"readings": grid(_WHO, rows)}}


# --- figures --------------------------------------------------------------------------------------


def _draw_errors(figure: Any, data: Data) -> None:
    """Draw the logarithm of the mean squared errors and of the bounds' mean traces, by node."""
    axes = stack(figure, SENSORS, "time t (steps)", sharey=True)
    for node, axis in enumerate(axes):
        for name, colour, label in (("local", COLOURS[node], "node"), ("fused", FUSED, "fused")):
            for kind, width, line, what in (
                ("trace", 2.4, "-", "bound"),
                ("error", 1.3, (0, (2.5, 0.8)), "squared error"),
            ):
                values = data[f"mean_{name}_{kind}"]
                curve = np.log10(values[:, node] if values.ndim > 1 else values)
                style: Data = {"color": colour, "lw": width, "ls": line}
                axis.plot(np.arange(1, len(curve) + 1), curve, label=f"{what}, {label}", **style)
        axis.set_title(_NODE_NAMES[node], loc="left")
        axis.set_ylabel("lg (no unit)")
    legend(figure, axes[:1], 4)


PAPER = Paper(
    "tobit_token_bucket",
    (
        Piece("network", simulate_network, _summarise_network, 6.0, 2000),
        Piece("estimates", simulate_estimates, _summarise_estimates, 12.0, 2000),
        Piece("errors", simulate_errors, _summarise_errors, 5.0, 2000),
        Piece("theorems", simulate_bucket_theorems, _summarise_bucket_theorems, 25.0, 2000),
        Piece("readings", simulate_bucket_readings, _summarise_bucket_readings, 12.0, 2000),
    ),
    {"figures_8_to_10": PaperFigure("errors", _draw_errors, (7.2, 6.4))},
    {"policy": TRIGGER},
    READINGS,
    claims,
)
