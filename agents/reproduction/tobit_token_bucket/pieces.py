"""Tobit Kalman fusion filtering with a token bucket: Section 4 made anew, Figures 2 to 10.

Source: tobit_token_bucket, X. Chen, F. Han, Y. Song and J. Zhang, Complex Engineering Systems 4:19,
2024.
"""

from functools import partial
from typing import Any

import numpy as np

from ..paper import Paper, Piece
from ..shown import Number, Picture, Shown, Table
from . import claims, figures
from .readings import READINGS
from .runs import SENSORS, alone, record, scheme
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
    found = record(task, episodes, seed)
    free = record(scheme(tokens="unlimited"), episodes, seed)
    costs = task.bucket.cost[:, 0]
    wanted = free.requested.transpose(2, 0, 1) @ costs
    spent = found.granted.transpose(2, 0, 1) @ costs
    needed = costs.max() * SENSORS
    return {
        "level": np.append(task.bucket.initial, found.tokens[:, 0]),
        "requested": found.requested[..., 0],
        "granted": found.granted[..., 0],
        "measured": found.measurement[..., 0],
        "held": found.held[..., 0],
        "rate_requested": found.requested.mean(0),
        "rate_granted": found.granted.mean(0),
        "grant_share": found.granted.sum((0, 1)) / found.requested.sum((0, 1)),
        "tokens": found.tokens.mean(0),
        "lowest": float(found.tokens.min()),
        "highest": float(found.tokens.max()),
        "wanted": wanted.mean(1),
        "spent": spent.mean(1),
        "poor_grants": int((found.granted & (found.tokens_before < needed)[:, None]).sum()),
        "uncalled_grants": int((found.granted & ~found.requested).sum()),
        "rich_refusals": int(
            (found.requested & ~found.granted & (found.tokens_before >= needed)[:, None]).sum()
        ),
        "grants": int(found.granted.sum()),
        "rate": task.bucket.rate,
        "capacity": task.bucket.capacity,
        "needed": float(needed),
        "mse": found.fused_error.mean(0),
        "mse_unlimited": free.fused_error.mean(0),
    }


def show_network(found: dict[str, Any]) -> Shown:
    """Figures 2 to 4."""
    nodes = [
        Number.of(f"node {m + 1}: {what}", found[name][m])
        for m in _NODES
        for what, name in _RATES.items()
    ]
    numbers = [
        Number.of("transmissions an event: mean", found["grant_share"]),
        Number.of("level of tokens: mean", found["tokens"]),
        Number.of("tokens spent a step: mean", found["spent"]),
        Number.of("tokens asked for a step without a bucket: mean", found["wanted"]),
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
                figures.measurements,
                measured=found["measured"],
                held=found["held"],
                component=component,
            ),
            (7.2, 4.8),
        )
        for component in (0, 1)
    ]
    level = Picture(
        "figure_2",
        "Figure 2: tokens and triggering instants of the three nodes",
        f"Above, the level climbs by {found['rate']:g} a step and falls when nodes send; nothing "
        f"is sent below {found['needed']:g}. Below, every event of a node: a bar where it was "
        "sent, a cross where the bucket refused it. While both states are negative all "
        "measurements stay at the threshold: no events, and the bucket fills. The paper marks the "
        "events by asterisks, circles and crosses beside a green line of tokens.",
        partial(
            figures.tokens,
            level=found["level"],
            requested=found["requested"].astype(bool),
            granted=found["granted"].astype(bool),
        ),
        _SIZE,
    )
    tables = [
        Table("rates", "Events and transmissions a step", nodes, columns=tuple(_RATES)),
        Table("tokens", "Use of the bucket", numbers, _NO_NUMBERS, ("mean",)),
    ]
    return Shown([level, *parts], tables, claims.of_network(found))


def estimates(episodes: int, seed: int) -> dict[str, Any]:
    """States, local and fused estimates, and how far they fluctuate from step to step."""
    found = record(scheme(), episodes, seed)
    local = np.abs(np.diff(found.truth[:, None] - found.local_mean, axis=0))
    fused = np.abs(np.diff(found.truth - found.mean, axis=0))
    censored = (found.measurement <= 0.0)[1:]
    beside = [record(alone(m), episodes, seed) for m in _NODES]
    return {
        "truth": found.truth[..., 0],
        "local": found.local_mean[..., 0],
        "fused": found.mean[..., 0],
        "local_change": local.mean(0),
        "fused_change": fused.mean(0),
        "change_censored": _share(local[:, 2, 1], censored[:, 2, 1]),
        "change_uncensored": _share(local[:, 2, 1], ~censored[:, 2, 1]),
        "mse": found.fused_error.mean(0),
        "alone_mse": np.array([one.fused_error.mean(0) for one in beside]),
        "moved": np.abs(np.diff(found.mean, axis=0)).mean((0, 1)),
        "alone_moved": np.array([np.abs(np.diff(o.mean, axis=0)).mean((0, 1)) for o in beside]),
        "alone_rate": [float(one.granted.mean()) for one in beside],
        "rate": float(found.granted.mean()),
    }


def _share(values: Any, chosen: Any) -> Any:
    """Mean of values (H, E) by episode where ``chosen``; not a number where nothing is."""
    with np.errstate(invalid="ignore"):
        return (values * chosen).sum(0) / chosen.sum(0)


def show_estimates(found: dict[str, Any]) -> Shown:
    """Figures 5 to 7."""
    numbers = [
        Number.of(f"{who}: {_STATES[state]}", change[state])
        for who, change in zip(_WHO, (*found["local_change"], found["fused_change"]), strict=True)
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
                truth=found["truth"],
                local=found["local"][:, m],
                fused=found["fused"],
                sensor=m,
            ),
            _SIZE,
        )
        for m in _NODES
    ]
    table = Table(
        "fluctuation",
        "Fluctuation of the estimates",
        numbers,
        "Mean size of the change of an estimate's error from one step to the next.",
        _STATES,
    )
    return Shown(pictures, [table], claims.of_estimates(found))


def errors(episodes: int, seed: int) -> dict[str, Any]:
    """Squared errors and traces of the bounds, local and fused."""
    found = record(scheme(), episodes, seed)
    curves = {
        "local_error": found.local_error,
        "local_trace": found.local_trace,
        "fused_error": found.fused_error,
        "fused_trace": found.fused_trace,
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
    error, trace = found.fused_error[:, None], found.fused_trace[:, None]
    result["share_error"] = (error < found.local_error).mean(0)
    result["share_trace"] = (trace < found.local_trace).mean(0)
    return result


def show_errors(found: dict[str, Any]) -> Shown:
    """Figures 8 to 10."""
    pictures = []
    for m in _NODES:
        one, mean = (
            {
                name: found[f"{kind}_{name}"][:, m] if name.startswith("local") else
                found[f"{kind}_{name}"]
                for name in ("local_error", "local_trace", "fused_error", "fused_trace")
            }
            for kind in ("one", "mean")
        )  # fmt: skip
        ratio = found["by_local_error"][m].mean() / found["by_fused_error"].mean()
        picture = Picture(
            f"figure_{8 + m}",
            f"Figure {8 + m}: lg of squared errors and of the traces of the bounds, node {m + 1}",
            "Above one episode, as in the paper; below the mean over all, which the paper does not "
            "show. Thick: the bounds, the fused always below the local one. Dashed: the squared "
            f"errors, far below their bounds; node {m + 1} has {ratio:.2f} times the error of the "
            "centre.",
            partial(figures.errors, one=one, mean=mean, sensor=m),
            (7.2, 5.4),
        )
        pictures.append(picture)
    numbers = []
    for place, who in enumerate(_WHO):
        for what, name in _CURVES.items():
            of = "local" if place in _NODES else "fused"
            sample = found[name.format(of)]
            numbers.append(Number.of(f"{who}: {what}", sample[place] if of == "local" else sample))
    table = Table(
        "errors",
        "Squared errors and bounds",
        numbers,
        "Means over time and episodes; squared errors are summed over both states.",
        tuple(_CURVES),
    )
    return Shown(pictures, [table], claims.of_errors(found))


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
