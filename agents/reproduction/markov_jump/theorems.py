"""The theorems of the Markov jump paper, held to the errors of simulated episodes."""

from typing import Any

import numpy as np

from fusion_gym.arrays import Array

from ..judging import below, cite, estimate, verdict
from ..paper import Piece
from ..piece_result import Claim, Number, NumbersTable, PieceResult
from .printed import covariances
from .runs import THRESHOLDS, example, run_markov_jump, trigger

_CLEAR = 4.0  # standard errors: not reached by chance in some dozens of comparisons
_SAME = 1e-9  # relative difference of two recursions that are the same
_NODES = (1, 2, 3)


def compute_markov_jump_theorems(episodes: int, seed: int) -> dict[str, Any]:
    """Actual and claimed covariances of nodes and centre; the printed recursion beside ours."""
    task = example()
    system: Any = task.system
    time = np.arange(1, task.horizon + 1)
    claimed = system.recursion.local_trace[:, system.filters.at(time)].mean(-1)
    local: Array | None = None
    fused, traces, least, difference, moment = [], [], [], [], None
    for m in THRESHOLDS:
        requests = run_markov_jump(task, trigger(m), episodes, seed)
        fused.append(requests.squared.sum(1).mean(0))
        traces.append(float(requests.trace.mean()))
        if local is None:
            local = np.square(requests.local_error).sum(2).mean(0)
            moment = np.square(requests.truth).sum(1).mean(0)
            exact = _exact(system, task.horizon)
            for swapped in (True, False):
                printed = covariances(system, requests.sent, swapped)
                difference.append(float(np.abs(printed - exact).max() / np.abs(exact).max()))
        sigma = covariances(system, requests.sent, swapped=True)
        least.append(float(np.linalg.eigvalsh((sigma + np.swapaxes(sigma, 1, 2)) / 2.0).min()))
    beside = run_markov_jump(example(fusion="ci"), trigger(0.0), episodes, seed)
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


def show_markov_jump_theorems(data: dict[str, Any]) -> PieceResult:
    """Errors beside the covariances that are claimed for them; verdicts."""
    numbers = [
        _beside(f"node {node}", sample, claim)
        for node, sample, claim in zip(_NODES, data["local"], data["claimed"], strict=True)
    ] + [
        _beside(f"fused, m = {m:g}", sample, claim)
        for m, sample, claim in zip(THRESHOLDS, data["fused"], data["traces"], strict=True)
    ]
    numbers.append(_beside("the state itself", data["moment"], data["moment_claimed"]))
    table = NumbersTable(
        "covariances",
        "Squared errors over the traces that are claimed for them",
        numbers,
        "Position and velocity together; 1 for a covariance that is right. The last row is the "
        "state's second moment over that of (10). All rows share their noise, and so its chance.",
        ("ratio",),
    )
    return PieceResult((), [table], _claims(data))


def _beside(what: str, sample: Array, claim: float) -> Number:
    return Number.of(f"{what}: ratio", sample / claim)


def _agrees(sample: Array, claim: float) -> bool:
    error = sample.std(ddof=1) / np.sqrt(len(sample))
    return bool(abs(sample.mean() - claim) <= _CLEAR * error)


def _compared(sample: Array, claim: float) -> str:
    return f"{cite(estimate(sample), 4)} where {claim:.4g} is claimed"


def _claims(data: dict[str, Any]) -> list[Claim]:
    local = list(zip(data["local"], data["claimed"], strict=True))
    fused = list(zip(data["fused"], data["traces"], strict=True))
    literal, mended = data["difference"]
    full = data["fused"][0]
    return [
        Claim(
            "The second moment of the state is that of (10).",
            "(10)",
            verdict([_agrees(data["moment"], data["moment_claimed"])]),
            f"Mean square of the state {_compared(data['moment'], data['moment_claimed'])}.",
        ),
        Claim(
            "The local filters know the covariance of their errors.",
            "Theorem 1, (12)-(22)",
            verdict(_agrees(*item) for item in local),
            "Squared errors of nodes 1, 2, 3: " + "; ".join(_compared(*item) for item in local)
            + ". So fading and jumps are dealt with, as Section 6 says.",
        ),
        Claim(
            "The fused covariance is that of the fused error, whatever is sent.",
            "Theorems 2 and 4, (57)",
            verdict(_agrees(*item) for item in fused),
            "At m = 0, 0.9, 1.3, 1.5: " + "; ".join(_compared(*item) for item in fused)
            + ". This is with the exact joint covariance in the place of Theorem 3.",
        ),
        Claim(
            "The cross-covariances of local estimates at the centre are those of (46)-(50).",
            "Theorem 3",
            verdict((literal < _SAME, *(least > -_SAME for least in data["least"]))),
            f"As printed, all sent, they differ from the exact ones by {literal:.1e} of the "
            f"largest entry; with the indices of the third term of (46) put right by {mended:.1e}. "
            "If something is not sent Σ is no covariance: least eigenvalues "
            + ", ".join(f"{least:.2g}" for least in data["least"])
            + " at m = 0, 0.9, 1.3, 1.5.",
        ),
        Claim(
            "Matrix weights give the optimal distributed estimate: better than every node, and "
            "than fusion without the cross-covariances.",
            "Theorem 4",
            verdict([*(below(full, item) for item in data["local"]), below(full, data["ci"])]),
            f"All sent: mean squared error {cite(estimate(full))}; nodes "
            + ", ".join(cite(estimate(item)) for item in data["local"])
            + f"; covariance intersection of the same estimates {cite(estimate(data['ci']))}.",
        ),
    ]  # fmt: skip


THEOREMS = Piece(
    "theorems", "Theorems", compute_markov_jump_theorems, show_markov_jump_theorems, 60.0, 3000
)
