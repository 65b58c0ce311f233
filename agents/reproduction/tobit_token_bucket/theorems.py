"""The theorems of the token-bucket paper, and its claim of resilience."""

from typing import Any

import numpy as np

import fusion_gym

from ..judging import below, cite, estimate, percent, verdict
from ..paper import Piece
from ..piece_result import Claim, Number, NumbersTable, PieceResult
from .runs import SENSORS, TRIGGER, Failing, record_history, scheme
from .theory import claimed, conditioned, perturbed, terms

_NODES = range(SENSORS)
_CLEAR = 4.0  # standard errors: of 400 eigenvalues none of 1 is likely to lie as far above
_LONG = 1000  # steps
_WINDOW = 200


def compute_token_bucket_theorems(episodes: int, seed: int) -> dict[str, Any]:
    """Bounds, gains and condition (42) on recorded episodes; long runs, starved runs, failures."""
    task = scheme()
    few = max(2, episodes // 10)
    result = record_history(task, episodes, seed)
    gaps = [result.truth - result.mean, *(result.truth - result.local_mean[:, m] for m in _NODES)]
    bounds = [result.bound, *(result.local_bound[:, m] for m in _NODES)]
    eigenvalues = [claimed(gap, bound) for gap, bound in zip(gaps, bounds, strict=True)]
    recorded = record_history(task, few, seed)
    parts = terms(task, recorded)
    never = record_history(task, few, seed, fusion_gym.make_policy("never", task))
    long = record_history(scheme(horizon=_LONG), few, seed)
    windows = long.fused_error.reshape(-1, _WINDOW, few).mean(1)
    traces = long.fused_trace.reshape(-1, _WINDOW, few).mean(1)
    failed = [
        record_history(task, episodes, seed, Failing(fusion_gym.make_policy(TRIGGER, task), m))
        for m in _NODES
    ]
    single = record_history(task, episodes, seed, fusion_gym.make_policy("never", task))
    return {
        "eigenvalue": np.array([value for value, _ in eigenvalues]),
        "eigenvalue_error": np.array([error for _, error in eigenvalues]),
        **{f"gain_{name}": values for name, values in perturbed(parts, recorded, seed).items()},
        **conditioned(parts),
        "growth": np.exp(np.diff(np.log(never.fused_trace), axis=0)).mean(0),
        "windows": windows,
        "traces": traces,
        "healthy": result.fused_error.mean(0),
        "failed": np.array([item.fused_error.mean(0) for item in failed]),
        "failed_local": np.array([failed[m].local_error[:, m].mean(0) for m in _NODES]),
        "silent": single.fused_error.mean(0),
        "few": few,
    }


def show_token_bucket_theorems(data: dict[str, Any]) -> PieceResult:
    """Verdicts of the theorems; the numbers behind them."""
    theorems = [
        Number.of("share of gains beside (37) with a larger bound: mean", data["gain_larger"]),
        Number.of("(42) holds, share of deliveries: mean", data["holds_delivered"]),
        Number.of("(42) holds, share of steps without: mean", data["holds_silent"]),
        Number.of("growth a step of the trace if nothing is sent: mean", data["growth"]),
    ]
    failures = [
        Number.of("no sensor: fused squared error", data["healthy"]),
        *(Number.of(f"sensor {m + 1}: fused squared error", data["failed"][m]) for m in _NODES),
        Number.of("all sensors: fused squared error", data["silent"]),
    ]
    tables = [
        NumbersTable(
            "theorems",
            "Theorems",
            theorems,
            f"Means over time and {data['few']:,} of the episodes.",
            ("mean",),
        ),
        NumbersTable(
            "failures",
            "Sensors that have failed",
            failures,
            "A sensor that has failed never sends; its filter goes on with its last measurement.",
            ("fused squared error",),
        ),
    ]
    return PieceResult((), tables, [*_bounds(data), _gain(data), _bounded(data), _resilient(data)])


def _bounds(data: dict[str, Any]) -> list[Claim]:
    value, error = data["eigenvalue"], data["eigenvalue_error"]
    covered = (value - _CLEAR * error <= 1.0).all(-1)
    largest = value.max(-1)
    what = (
        "Largest eigenvalue of E[P^(-1/2) e eᵀ P^(-1/2)], P the bound and e the error, which is at "
        "most 1 where the bound holds"
    )
    loose = 1.0 / value[1:].mean()
    return [
        Claim(
            "The local bound is above the covariance of the local error.",
            "Theorem 1, (28)",
            verdict(covered[1:]),
            f"{what}: its highest value over time is "
            + ", ".join(f"{item:.2f}" for item in largest[1:])
            + f" at nodes 1, 2, 3; its mean says that the bound is {loose:.0f} times too large. "
            "The proof takes censoring as independent of the noise, so this is found, not proven.",
        ),
        Claim(
            "The fused bound is above the covariance of the fused error.",
            "Theorem 5, (52)",
            verdict(covered[:1]),
            f"{what}: highest {largest[0]:.2f} ± {_CLEAR * error[0][value[0].argmax()]:.2f}, at "
            f"t = {int(value[0].argmax()) + 1}; mean over time {value[0].mean():.3f}. The proof "
            "puts (53), which holds of what is fed back, for what is fused.",
        ),
    ]


def _gain(data: dict[str, Any]) -> Claim:
    share, used = data["gain_larger"], data["gain_counted"].mean()
    return Claim(
        "The gain (37) minimises the trace of the bound (30).",
        "Theorem 2",
        verdict([bool(np.all(share >= 1.0 - 1e-12)), bool(data["gain_difference"].max() < 1e-9)]),
        f"Of random other gains {percent(float(share.mean()))} have a larger trace. (30) written "
        "out as printed, with the readings of the environment's page, agrees with the filter's "
        f"trace to a relative {data['gain_difference'].max():.0e}, in the {percent(float(used))} "
        "of steps in which no component is nearly surely censored.",
    )


def _bounded(data: dict[str, Any]) -> Claim:
    first, last = data["windows"][1], data["windows"][-1]
    least = float(data["least_silent"].min())
    always = bool(
        data["holds_silent"].min() == 1.0 and data["holds_delivered"].min() == 1.0
    )  # in every step, as the theorem asks
    stays = not below(first * 1.2, last) and not below(data["traces"][1] * 1.5, data["traces"][-1])
    return Claim(
        "Condition (42) holds in the example, and the error is bounded in mean square.",
        "Theorem 3, (42)",
        verdict((always, stays)),
        f"(42) holds in {percent(float(data['holds_delivered'].mean()))} of the steps in which a "
        f"node receives and in {percent(float(data['holds_silent'].mean()))} of the others, where "
        f"its left side is at least {least:.2f}: the theorem does not apply. The error stays "
        f"bounded all the same: squared error {cite(estimate(first))} in steps "
        f"{_WINDOW + 1} to {2 * _WINDOW} and {cite(estimate(last))} in the last {_WINDOW} of "
        f"{_LONG}. If nothing is ever sent, the bound grows by a factor of "
        f"{data['growth'].mean():.2f} a step.",
    )  # fmt: skip


def _resilient(data: dict[str, Any]) -> Claim:
    parts = [below(data["failed"][m], data["silent"]) for m in _NODES]
    stored = [not below(data["healthy"] * 1.1, data["failed"][m]) for m in _NODES]
    return Claim(
        "If a sensor fails, the others' data keep the filters good.",
        "Section 4, last paragraph",
        verdict([*parts, *stored]),
        f"Fused squared error {cite(estimate(data['healthy']))} with all sensors; with sensor 1, "
        "2 or 3 silent "
        + ", ".join(cite(estimate(data["failed"][m])) for m in _NODES)
        + f"; with all three silent {cite(estimate(data['silent']))}. That an error falls when a "
        "sensor fails shows what the held updates cost, and that its tokens serve the others.",
    )


THEOREMS = Piece(
    "theorems",
    "Theorems and failures of sensors",
    compute_token_bucket_theorems,
    show_token_bucket_theorems,
    25.0,
    2000,
)
