"""Tobit Kalman fusion filtering with a token bucket: Section 4 made anew, Figures 2 to 10.

Source: tobit_token_bucket, X. Chen, F. Han, Y. Song and J. Zhang, Complex Engineering Systems 4:19,
2024.
"""

from functools import partial
from typing import Any

import numpy as np

from ..paper import Paper, Piece
from ..piece_result import Number, NumbersTable, Picture, PieceResult
from . import claims, figures
from .readings import READINGS
from .runs import SENSORS, record_history, scheme, single_sensor
from .theorems import THEOREMS

_SIZE = (7.2, 4.4)
_NODES = range(SENSORS)
_WHO = (*(f"node {m + 1}" for m in _NODES), "fused")
_STATES = ("first state", "second state")
_CURVES = {
    "squared error": "by_{}_error",
    "trace of the bound": "by_{}_trace",
    "lg squared error": "lg_{}_error",
    "lg trace": "lg_{}_trace",
}
_RATES = {"events": "rate_requested", "transmissions": "rate_granted"}
_NO_NUMBERS = (
    "The paper prints no numbers in its Section 4, only curves of one episode; these are ours, "
    "means over time and episodes."
)


def network(episodes: int, seed: int) -> dict[str, Any]:
    """Tokens, events, grants, and the measurements before and after the protocol."""
    task = scheme()
    result = record_history(task, episodes, seed)
    free = record_history(scheme(tokens="unlimited"), episodes, seed)
    costs = task.bucket.cost[:, 0]
    required = free.requested.transpose(2, 0, 1) @ costs
    spent = result.granted.transpose(2, 0, 1) @ costs
    needed = costs.max() * SENSORS
    return {
        "level": np.append(task.bucket.initial, result.tokens[:, 0]),
        "requested": result.requested[..., 0],
        "granted": result.granted[..., 0],
        "measured": result.measurement[..., 0],
        "held": result.held[..., 0],
        "rate_requested": result.requested.mean(0),
        "rate_granted": result.granted.mean(0),
        "grant_share": result.granted.sum((0, 1)) / result.requested.sum((0, 1)),
        "tokens": result.tokens.mean(0),
        "lowest": float(result.tokens.min()),
        "highest": float(result.tokens.max()),
        "wanted": required.mean(1),
        "spent": spent.mean(1),
        "poor_grants": int((result.granted & (result.tokens_before < needed)[:, None]).sum()),
        "uncalled_grants": int((result.granted & ~result.requested).sum()),
        "rich_refusals": int(
            (result.requested & ~result.granted & (result.tokens_before >= needed)[:, None]).sum()
        ),
        "grants": int(result.granted.sum()),
        "rate": task.bucket.rate,
        "capacity": task.bucket.capacity,
        "needed": float(needed),
        "mse": result.fused_error.mean(0),
        "mse_unlimited": free.fused_error.mean(0),
    }


def show_network(data: dict[str, Any]) -> PieceResult:
    """Figures 2 to 4."""
    nodes = [
        Number.of(f"node {m + 1}: {what}", data[name][m])
        for m in _NODES
        for what, name in _RATES.items()
    ]
    numbers = [
        Number.of("transmissions an event: mean", data["grant_share"]),
        Number.of("level of tokens: mean", data["tokens"]),
        Number.of("tokens spent a step: mean", data["spent"]),
        Number.of("tokens asked for a step without a bucket: mean", data["wanted"]),
    ]
    parts = [
        Picture(
            f"figure_{3 + component}",
            f"Figure {3 + component}: measurements before and after the protocol, component "
            f"{component + 1}",
            "Grey: what each node measures, never below the censoring threshold 0. Coloured: what "
            "its filter holds, which stays where it is until an event finds tokens. The same "
            "curves as in the paper, a panel a node.",
            partial(
                figures.draw_measurements,
                measured=data["measured"],
                held=data["held"],
                component=component,
            ),
            (7.2, 4.8),
        )
        for component in (0, 1)
    ]
    level = Picture(
        "figure_2",
        "Figure 2: tokens and triggering instants of the three nodes",
        f"Above, the level climbs by {data['rate']:g} a step and falls when nodes send; nothing "
        f"is sent below {data['needed']:g}. Below, every event of a node: a bar where it was "
        "sent, a cross where the bucket refused it. While both states are negative all "
        "measurements stay at the threshold: no events, and the bucket fills. The paper marks the "
        "events by asterisks, circles and crosses beside a green line of tokens.",
        partial(
            figures.tokens,
            level=data["level"],
            requested=data["requested"].astype(bool),
            granted=data["granted"].astype(bool),
        ),
        _SIZE,
    )
    tables = [
        NumbersTable("rates", "Events and transmissions a step", nodes, columns=tuple(_RATES)),
        NumbersTable("tokens", "Use of the bucket", numbers, _NO_NUMBERS, ("mean",)),
    ]
    return PieceResult([level, *parts], tables, claims.of_network(data))


def estimates(episodes: int, seed: int) -> dict[str, Any]:
    """States, local and fused estimates, and how far they fluctuate from step to step."""
    result = record_history(scheme(), episodes, seed)
    local = np.abs(np.diff(result.truth[:, None] - result.local_mean, axis=0))
    fused = np.abs(np.diff(result.truth - result.mean, axis=0))
    censored = (result.measurement <= 0.0)[1:]
    beside = [record_history(single_sensor(m), episodes, seed) for m in _NODES]
    return {
        "truth": result.truth[..., 0],
        "local": result.local_mean[..., 0],
        "fused": result.mean[..., 0],
        "local_change": local.mean(0),
        "fused_change": fused.mean(0),
        "change_censored": _share(local[:, 2, 1], censored[:, 2, 1]),
        "change_uncensored": _share(local[:, 2, 1], ~censored[:, 2, 1]),
        "mse": result.fused_error.mean(0),
        "alone_mse": np.array([item.fused_error.mean(0) for item in beside]),
        "moved": np.abs(np.diff(result.mean, axis=0)).mean((0, 1)),
        "alone_moved": np.array([np.abs(np.diff(o.mean, axis=0)).mean((0, 1)) for o in beside]),
        "alone_rate": [float(item.granted.mean()) for item in beside],
        "rate": float(result.granted.mean()),
    }


def _share(values: Any, selection: Any) -> Any:
    """Mean of values (H, E) by episode where ``selection``; not a number where nothing is."""
    with np.errstate(invalid="ignore"):
        return (values * selection).sum(0) / selection.sum(0)


def show_estimates(data: dict[str, Any]) -> PieceResult:
    """Figures 5 to 7."""
    numbers = [
        Number.of(f"{who}: {_STATES[state]}", change[state])
        for who, change in zip(_WHO, (*data["local_change"], data["fused_change"]), strict=True)
        for state in range(2)
    ]
    pictures = [
        Picture(
            f"figure_{5 + m}",
            f"Figure {5 + m}: state, local estimate of node {m + 1} and fused estimate",
            "Where a state is negative its sensors show 0 (shaded), and the estimates leave it "
            "most. Node and centre stay together, for every node starts each step from the fused "
            "estimate. The same three curves as in the paper, a panel a state.",
            partial(
                figures.states,
                truth=data["truth"],
                local=data["local"][:, m],
                fused=data["fused"],
                sensor=m,
            ),
            _SIZE,
        )
        for m in _NODES
    ]
    table = NumbersTable(
        "fluctuation",
        "Fluctuation of the estimates",
        numbers,
        "Mean size of the change of an estimate's error from one step to the next.",
        _STATES,
    )
    return PieceResult(pictures, [table], claims.of_estimates(data))


def errors(episodes: int, seed: int) -> dict[str, Any]:
    """Squared errors and traces of the bounds, local and fused."""
    results = record_history(scheme(), episodes, seed)
    curves = {
        "local_error": results.local_error,
        "local_trace": results.local_trace,
        "fused_error": results.fused_error,
        "fused_trace": results.fused_trace,
    }
    logarithm = {name: np.log10(values) for name, values in curves.items()}
    result: dict[str, Any] = {}
    for name, values in curves.items():
        result[f"one_{name}"] = values[..., 0]
        result[f"mean_{name}"] = values.mean(-1)
        result[f"by_{name}"] = values.mean(0)
        result[f"lg_{name}"] = logarithm[name].mean(0)
    for name in ("local_error", "fused_error"):
        result[f"rough_{name}"] = np.abs(np.diff(logarithm[name], axis=0)).mean(0)
    error, trace = results.fused_error[:, None], results.fused_trace[:, None]
    result["share_error"] = (error < results.local_error).mean(0)
    result["share_trace"] = (trace < results.local_trace).mean(0)
    return result


def show_errors(data: dict[str, Any]) -> PieceResult:
    """Figures 8 to 10."""
    pictures = []
    for m in _NODES:
        single, mean = (
            {
                name: data[f"{kind}_{name}"][:, m] if name.startswith("local") else
                data[f"{kind}_{name}"]
                for name in ("local_error", "local_trace", "fused_error", "fused_trace")
            }
            for kind in ("one", "mean")
        )  # fmt: skip
        ratio = data["by_local_error"][m].mean() / data["by_fused_error"].mean()
        picture = Picture(
            f"figure_{8 + m}",
            f"Figure {8 + m}: lg of squared errors and of the traces of the bounds, node {m + 1}",
            "Above one episode, as in the paper; below the mean over all, which the paper does not "
            "show. Thick: the bounds, the fused always below the local one. Dashed: the squared "
            f"errors, far below their bounds; node {m + 1} has {ratio:.2f} times the error of the "
            "centre.",
            partial(figures.draw_errors, item=single, mean=mean, sensor=m),
            (7.2, 5.4),
        )
        pictures.append(picture)
    numbers = []
    for place, who in enumerate(_WHO):
        for what, name in _CURVES.items():
            of = "local" if place in _NODES else "fused"
            sample = data[name.format(of)]
            numbers.append(Number.of(f"{who}: {what}", sample[place] if of == "local" else sample))
    table = NumbersTable(
        "errors",
        "Squared errors and bounds",
        numbers,
        "Means over time and episodes; squared errors are summed over both states.",
        tuple(_CURVES),
    )
    return PieceResult(pictures, [table], claims.of_errors(data))


PAPER = Paper(
    name="tobit_token_bucket",
    title="Tobit Kalman fusion filtering with a token bucket",
    citation=(
        "X. Chen, F. Han, Y. Song and J. Zhang, “Tobit Kalman fusion filtering under dynamic "
        "event-triggering protocol with token bucket specification”, Complex Engineering Systems "
        "4:19, 2024."
    ),
    pieces=(
        Piece(
            "network", "Tokens, events and measurements (Figures 2 to 4)",
            network, show_network, 6.0, 2000,
        ),
        Piece(
            "estimates", "States and estimates (Figures 5 to 7)",
            estimates, show_estimates, 12.0, 2000,
        ),
        Piece(
            "errors", "Errors and bounds (Figures 8 to 10)",
            errors, show_errors, 5.0, 2000,
        ),
        THEOREMS,
        READINGS,
    ),
)  # fmt: skip
