"""Both examples under the paper's filter and trigger, and other filters beside it."""

from typing import Any

import numpy as np

import fusion_gym
from fusion_gym.arrays import Array
from fusion_gym.policies.rules.adaptive_threshold import AdaptiveThreshold

from .runs import (
    EXAMPLES,
    PRINTED,
    TRIGGER,
    Record,
    halves,
    leading,
    make_example,
    record_run,
    tables,
)

OURS, FIXED = "paper's filter and trigger", "paper's filter, fixed threshold ρ̄"
WALK = "Kalman filter with a random-walk input, paper's trigger"
_HOLD = {PRINTED: {"hold_variance": 0.05}}  # as the example's page does

SETTINGS: dict[str, tuple[str, dict[str, Any]]] = {
    OURS: (TRIGGER, {"filter": "paper"}),
    FIXED: (TRIGGER, {"filter": "paper"}),
    "paper's filter, always": ("always", {"filter": "paper"}),
    "exact filter, always": ("always", {"filter": "predict", "fusion": "exact_ci"}),
    WALK: (TRIGGER, {"filter": "random_walk"}),
    "Kalman filter with a random-walk input, always": ("always", {"filter": "random_walk"}),
}


def compute_filters(episodes: int, seed: int) -> dict[str, Any]:
    """Everything by example; ``mse`` (settings, 2, E) and ``rates`` (settings, l, E) by setting."""
    data: dict[str, Any] = {"settings": list(SETTINGS)}
    for example in EXAMPLES:
        stored = _example(example, episodes, seed)
        data |= {f"{example}_{name}": value for name, value in stored.items()}
    return data


def _example(example: str, episodes: int, seed: int) -> dict[str, Any]:
    data: dict[str, Any] = {}
    mse, rates = [], []
    for name, (policy, options) in SETTINGS.items():
        settings = dict(options)
        if name == WALK:
            settings |= _HOLD.get(example, {})
        if name == FIXED:
            limit = _rule(example).rho_bar
            settings |= {"rho_initial": limit}
        task, system = make_example(example=example, **settings)
        run = record_run(task, policy, episodes, seed)
        states = system.plant.size
        mse.append(halves((run.errors[:, 0] ** 2).mean(0), states, 0))
        rates.append(run.granted.mean(0))
        if name == OURS:
            data |= _under_the_trigger(example, run)
        if name == WALK:
            data["walk"] = run.fused[..., 0]
    return data | {"mse": np.array(mse), "rates": np.array(rates)}


def _rule(example: str) -> AdaptiveThreshold:
    rule = fusion_gym.make_policy(TRIGGER, make_example(example=example, filter="paper")[0])
    assert isinstance(rule, AdaptiveThreshold)
    return rule


def _under_the_trigger(example: str, run: Record) -> dict[str, Any]:
    """The paper's figures, and how far errors fill their bounds.

    Estimates are the fused one, then the nodes'. ``truth`` (H, s), ``local`` (H, l, s), ``fused``
    (H, s) and ``granted`` (H, l) are of the first episode; ``square`` and ``bound`` (H, l + 1, s)
    are mean squared errors and bounds; ``each`` (l + 1, 2, E) squared errors and ``filled``
    (l + 1, 2, E) how far they fill their bounds, of states and inputs; ``power`` (2, E) the mean
    square of both, ``steady`` (2, E) the fused squared errors in the two halves of the episodes;
    ``kept`` the share of silent steps with |σ|² at most ρ̄; ``rho`` (H + 1, l) the mean threshold,
    ``rho_range`` its least step and its extremes over ρ₀ and ρ̄.
    """
    nodes = tables(make_example(example=example, filter="paper")[1])
    n, errors = nodes.model.size, run.errors
    bounds = np.concatenate((nodes.fused[None], nodes.tables.covariance))[..., 1:]
    blocks = (slice(None, n), slice(n, None))
    filled = [
        [leading(errors[:, place, block], bounds[place, block, block]) for block in blocks]
        for place in range(len(bounds))
    ]
    rule = _rule(example)
    rho = _thresholds(rule, run.square)
    low, high = (rule.column(name, rho.shape[1]) for name in ("rho_initial", "rho_bar"))
    silent = ~run.granted
    each = halves((errors**2).mean(0), n, 1)
    steady = [(part[:, 0] ** 2).sum(1).mean(0) for part in np.array_split(errors, 2)]
    return {
        "truth": run.truth[..., 0],
        "local": run.local[..., 0],
        "fused": run.fused[..., 0],
        "granted": run.granted[..., 0].astype(np.int64),
        "square": (errors**2).mean(-1),
        "bound": np.moveaxis(np.diagonal(bounds, axis1=1, axis2=2), 1, 0),
        "each": each,
        "filled": np.array(filled),
        "power": halves((run.truth**2).mean(0), n, 0),
        "steady": np.array(steady),
        "kept": float((run.square[silent] <= np.broadcast_to(high, silent.shape)[silent]).mean()),
        "rho": rho.mean(-1),
        "rho_range": [
            float(np.diff(rho, axis=0).min()),
            float((rho / low).min()),
            float((rho / high).max()),
        ],
        "settled": _settled(rho, np.broadcast_to(high, rho.shape[1:])),
        "radius": nodes.tables.radius,
    }


def _thresholds(rule: AdaptiveThreshold, square: Array) -> Array:
    """ρ (H + 1, l, E), at first that of the first judgement."""
    rho = np.broadcast_to(rule.column("rho_initial", square.shape[1]), square.shape[1:])
    rows = [rho]
    for row in square:
        rho = rule.threshold_after(rho, row)
        rows.append(rho)
    return np.array(rows)


def _settled(rho: Array, limit: Array) -> Array:
    """Judgements (E,) after which every threshold is at 99 % of ρ̄ at least."""
    below = rho < 0.99 * limit
    return below.sum(0).max(0).astype(float)
