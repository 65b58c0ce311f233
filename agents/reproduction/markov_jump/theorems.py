"""The theorems of the Markov jump paper, held to the errors of simulated episodes."""

from typing import Any

import numpy as np

from fusion_gym.arrays import Array

from ..judging import below, estimate, told, verdict
from ..paper import Piece
from ..shown import Claim, Number, Shown, Table
from .printed import covariances
from .runs import THRESHOLDS, example, run, trigger

_CLEAR = 4.0  # standard errors: not reached by chance in some dozens of comparisons
_SAME = 1e-9  # relative difference of two recursions that are the same
_NODES = (1, 2, 3)


def compute(episodes: int, seed: int) -> dict[str, Any]:
    """Actual and claimed covariances of nodes and centre; the printed recursion beside ours."""
    task = example()
    system: Any = task.system
    time = np.arange(1, task.horizon + 1)
    claimed = system.recursion.local_trace[:, system.filters.at(time)].mean(-1)
    local: Array | None = None
    fused, traces, least, difference, moment = [], [], [], [], None
    for m in THRESHOLDS:
        found = run(task, trigger(m), episodes, seed)
        fused.append(found.squared.sum(1).mean(0))
        traces.append(float(found.trace.mean()))
        if local is None:
            local = np.square(found.local_error).sum(2).mean(0)
            moment = np.square(found.truth).sum(1).mean(0)
            exact = _exact(system, task.horizon)
            for swapped in (True, False):
                printed = covariances(system, found.sent, swapped)
                difference.append(float(np.abs(printed - exact).max() / np.abs(exact).max()))
        sigma = covariances(system, found.sent, swapped=True)
        least.append(float(np.linalg.eigvalsh((sigma + np.swapaxes(sigma, 1, 2)) / 2.0).min()))
    beside = run(example(fusion="ci"), trigger(0.0), episodes, seed)
    _, squares = system.model.state_moments(task.horizon)
    return {
        "claimed": claimed,
        "local": local,
        "fused": np.array(fused),
        "traces": traces,
        "least": least,
        "difference": difference,
        "moment": moment,
        "moment_claimed": float(squares[1:].sum(1).mean()),
        "ci": beside.squared.sum(1).mean(0),
    }


def _exact(system: Any, horizon: int) -> Array:
    """Joint covariances (H + 1, l n, l n) of the nodes' own errors, the library's."""
    joint = system.recursion.local[..., system.filters.at(np.arange(horizon + 1))]
    size = joint.shape[0] * joint.shape[2]
    return np.ascontiguousarray(joint.transpose(4, 0, 2, 1, 3)).reshape(horizon + 1, size, size)


def show(found: dict[str, Any]) -> Shown:
    """Errors beside the covariances that are claimed for them; verdicts."""
    numbers = [
        _beside(f"node {node}", sample, claim)
        for node, sample, claim in zip(_NODES, found["local"], found["claimed"], strict=True)
    ] + [
        _beside(f"fused, m = {m:g}", sample, claim)
        for m, sample, claim in zip(THRESHOLDS, found["fused"], found["traces"], strict=True)
    ]
    numbers.append(_beside("the state itself", found["moment"], found["moment_claimed"]))
    table = Table(
        "covariances",
        "Squared errors over the traces that are claimed for them",
        numbers,
        "Position and velocity together; 1 for a covariance that is right. The last row is the "
        "state's second moment over that of (10). All rows share their noise, and so its chance.",
        ("ratio",),
    )
    return Shown((), [table], _claims(found))


def _beside(what: str, sample: Array, claim: float) -> Number:
    return Number.of(f"{what}: ratio", sample / claim)


def _agrees(sample: Array, claim: float) -> bool:
    error = sample.std(ddof=1) / np.sqrt(len(sample))
    return bool(abs(sample.mean() - claim) <= _CLEAR * error)


def _compared(sample: Array, claim: float) -> str:
    return f"{told(estimate(sample), 4)} where {claim:.4g} is claimed"


def _claims(found: dict[str, Any]) -> list[Claim]:
    local = list(zip(found["local"], found["claimed"], strict=True))
    fused = list(zip(found["fused"], found["traces"], strict=True))
    literal, mended = found["difference"]
    full = found["fused"][0]
    return [
        Claim(
            "The second moment of the state is that of (10).",
            "(10)",
            verdict([_agrees(found["moment"], found["moment_claimed"])]),
            f"Mean square of the state {_compared(found['moment'], found['moment_claimed'])}.",
        ),
        Claim(
            "The local filters know the covariance of their errors.",
            "Theorem 1, (12)-(22)",
            verdict(_agrees(*one) for one in local),
            "Squared errors of nodes 1, 2, 3: " + "; ".join(_compared(*one) for one in local)
            + ". So fading and jumps are dealt with, as Section 6 says.",
        ),
        Claim(
            "The fused covariance is that of the fused error, whatever is sent.",
            "Theorems 2 and 4, (57)",
            verdict(_agrees(*one) for one in fused),
            "At m = 0, 0.9, 1.3, 1.5: " + "; ".join(_compared(*one) for one in fused)
            + ". This is with the exact joint covariance in the place of Theorem 3.",
        ),
        Claim(
            "The cross-covariances of local estimates at the centre are those of (46)-(50).",
            "Theorem 3",
            verdict((literal < _SAME, *(least > -_SAME for least in found["least"]))),
            f"As printed, all sent, they differ from the exact ones by {literal:.1e} of the "
            f"largest entry; with the indices of the third term of (46) put right by {mended:.1e}. "
            "If something is not sent Σ is no covariance: least eigenvalues "
            + ", ".join(f"{least:.2g}" for least in found["least"])
            + " at m = 0, 0.9, 1.3, 1.5.",
        ),
        Claim(
            "Matrix weights give the optimal distributed estimate: better than every node, and "
            "than fusion without the cross-covariances.",
            "Theorem 4",
            verdict([*(below(full, one) for one in found["local"]), below(full, found["ci"])]),
            f"All sent: mean squared error {told(estimate(full))}; nodes "
            + ", ".join(told(estimate(one)) for one in found["local"])
            + f"; covariance intersection of the same estimates {told(estimate(found['ci']))}.",
        ),
    ]  # fmt: skip


THEOREMS = Piece("theorems", "Theorems", compute, show, 60.0, 3000)
