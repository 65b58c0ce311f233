"""What the text's own recursion does, and what was tried to make its example track."""

from typing import Any

import numpy as np

from fusion_gym.arrays import Array

from ..judging import below, estimate, percent, verdict
from ..piece_result import Claim, Number, NumbersTable, PieceResult
from .claims import KINDS, by_example
from .printed import DEVIATIONS, EXACT, INVERTED, PARTLY
from .runs import EXAMPLES


def show_unknown_input_readings(data: dict[str, Any]) -> PieceResult:
    """Errors under every reading, and the claims about the equations themselves."""
    node, readings = data["node"], data["readings"]
    columns = [f"node {i + 1}, {kind}" for kind in KINDS for i in range(node.shape[1])]
    numbers = [
        Number.of(f"{reading}: node {i + 1}, {kind}", node[place, i, block])
        for place, reading in enumerate(readings)
        for block, kind in enumerate(KINDS)
        for i in range(node.shape[1])
    ]
    power = data["power"].mean(-1)
    return PieceResult(
        tables=[
            NumbersTable(
                "readings",
                "Mean squared errors of the printed recursion under several readings",
                numbers,
                f"Mean squares of the quantities themselves: states {power[0]:.3g}, inputs "
                f"{power[1]:.3g}.",
                columns,
            )
        ],
        claims=_printed_claims(data),
        notes=[_degenerate(data), _tried(data)],
    )


def _printed_claims(data: dict[str, Any]) -> list[Claim]:
    exact = data["readings"].index(EXACT)
    residual = max(data["hidden"][exact])
    state, trace = data["node"][exact, :, 0], data["trace"][exact]
    bounded = [below(own, claim) for own, claim in zip(state, trace, strict=True)]
    excess = [estimate(sample) for sample in data["excess"]]
    tighter = [
        estimate(silent).mean / estimate(sent).mean - 1.0
        for silent, sent in zip(data["silent"], data["sent"], strict=True)
    ]
    return [
        Claim(
            "The lifted system of (3) and (4) can meet the decoupling condition (13).",
            "(3), (4), (13)",
            "holds" if data["rank"] == data["columns"] else "does not hold",
            f"With ℬ as printed, C ℬ has {data['columns']} columns and rank {data['rank']}: no L "
            "makes L C ℬ the identity. With the input held over a sampling interval it can.",
        ),
        Claim(
            "Under (13) the input does not enter the estimation error.",
            "(14), (16)",
            verdict([residual < 1e-6]),
            f"With the input held: the largest entry of ℬ - N C ℬ is {residual:.1g}, the rounding "
            "in (20) set to zero.",
        ),
        Claim(
            "(18) as printed, with its factor 1 - 2δ, bounds the error covariance.",
            "Theorem 1, (18)",
            verdict([*bounded, data["negative"] == 0.0]),
            "On the printed example the squared errors lie below its trace ("
            + _pairs(state, trace)
            + " by node). But the bound is smaller when nothing is sent ("
            + ", ".join(f"{100.0 * each:.1f} %" for each in tighter)
            + f"), and with ρ̄ = {data['small']:g} it is indefinite in "
            f"{percent(data['negative'])} of the silent instants.",
        ),
        Claim(
            "The gains (19) and (20) minimise the bounds.",
            "Theorem 2",
            verdict(abs(each.mean) < 1e-6 for each in excess),
            "The trace of (18) exceeds that of the best gain that meets (14) by "
            + by_example(
                {e: f"{100.0 * x.mean:.3g} %" for e, x in zip(EXAMPLES, excess, strict=True)}
            )
            + "; on the printed example (14) leaves one gain alone.",
        ),
    ]


def _pairs(first: Array, second: Array) -> str:
    return ", ".join(
        f"{estimate(a).mean:.3g} under {estimate(b).mean:.3g}"
        for a, b in zip(first, second, strict=True)
    )


def _degenerate(data: dict[str, Any]) -> str:
    floor, power = np.sqrt(np.array(data["floor"])), np.sqrt(data["power"].mean(-1))
    conditions = ", ".join(f"{each:.0f}" for each in data["conditions"])
    return (
        "**Why Figures 1 and 2 cannot come out of the printed numbers.** B and both C_i are square "
        "and invertible, so (14) leaves one gain, N = C⁻¹: the estimate is C⁻¹ y, without memory. "
        f"C_1, C_2 and B have the condition numbers {conditions}. With every measurement sent, its "
        f"root mean square error is {floor[0, 0]:.2g} (node 1) and {floor[1, 0]:.2g} (node 2) in "
        f"the state and {floor[0, 1]:.3g} and {floor[1, 1]:.3g} in the input, whatever the input "
        f"does; the states themselves have {power[0]:.2g}, and the inputs that we chose "
        f"{power[1]:.2g}. Estimates on the true values would break this floor. It falls with the "
        "noise alone, and the paper gives its covariance, 0.001; the input's size, ε, ξ and Ξ(0) "
        "are not given and do not enter it."
    )


def _tried(data: dict[str, Any]) -> str:
    readings, power = data["readings"], data["power"].mean(-1)
    share = data["node"].mean(-1) / power[:, None].T
    partly, inverted, small = (readings.index(n) for n in (PARTLY, INVERTED, DEVIATIONS))
    best, where = min((float(each), name) for each, name in zip(
        share[:, :, 1].min(1), readings, strict=True
    ))  # fmt: skip
    hidden = np.array(data["hidden"])
    return (
        "**What was tried.** I - C ℬ L in (20) is exactly zero on this example, and a "
        "pseudo-inverse of what rounding leaves of it makes a gain that does not hide the input. "
        "Where all of the rounding is inverted the state's squared error is "
        f"{share[inverted, 0, 0]:.2g} and {share[inverted, 1, 0]:.2g} of its mean square (nodes 1 "
        f"and 2), where only what exceeds 1e-8 is inverted {share[partly, 0, 0]:.2g} and "
        f"{share[partly, 1, 0]:.2g}: node 1 then seems to track, while ℬ - N C ℬ has entries of "
        f"{hidden[partly, 0]:.2g} and (14) is broken. With 0.001 as standard deviations the shares "
        f"are {share[small, 0, 0]:.2g} and {share[small, 1, 0]:.2g}. The inputs track in no "
        f"reading: the least squared error of a node is {best:.3g} times their mean square "
        f"(“{where}”)."
    )
