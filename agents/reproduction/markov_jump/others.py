"""What else could be done with as many packets as the Markov jump paper's trigger sends."""

from typing import Any

import numpy as np

from ..judging import below, cite, estimate, percent, verdict
from ..paper import Piece
from ..piece_result import Claim, Number, NumbersTable, PieceResult
from .runs import THRESHOLDS, example, run_markov_jump, trigger

_PERIOD = 6  # steps, after which all sensors' sampling repeats
_SEARCHED = 4  # packets in a period, up to which all schedules are compared


def compute_others(episodes: int, seed: int) -> dict[str, Any]:
    """Mean squared errors of random requests and the best schedules at the trigger's packets."""
    task = example()
    paper, chance, rates, packets, best = [], [], [], [], []
    for m in THRESHOLDS[1:]:
        requests = run_markov_jump(task, trigger(m), episodes, seed)
        share = requests.sent.mean(0)
        paper.append(requests.squared.sum(1).mean(0))
        rates.append(share.tolist())
        spelled = "/".join(f"{item:.6g}" for item in share)
        random = run_markov_jump(task, f"random:rate={spelled}", episodes, seed)
        chance.append(random.squared.sum(1).mean(0))
        count = int(requests.sent[-_PERIOD:].sum())
        packets.append(count)
        if count <= _SEARCHED:
            rule = f"periodic_optimum:packets={count},period={_PERIOD}"
            best.append(run_markov_jump(task, rule, episodes, seed).squared.sum(1).mean(0))
    beside = {
        "all sent": run_markov_jump(task, "always", episodes, seed),
        "centralised": run_markov_jump(example(filter="centralised"), "always", episodes, seed),
        "modes": run_markov_jump(example(filter="imm"), "always", episodes, seed),
    }
    return {
        "paper": np.array(paper),
        "chance": np.array(chance),
        "rates": rates,
        "packets": packets,
        "best": np.array(best),
        **{name: item.squared.sum(1).mean(0) for name, item in beside.items()},
    }


def show_others(data: dict[str, Any]) -> PieceResult:
    """A table of errors at equal rates, and the claims about what the trigger is worth."""
    columns = ("the paper's trigger", "random, same rates")
    numbers = [
        Number.of(f"m = {m:g}: {column}", data[kind][k])
        for k, m in enumerate(THRESHOLDS[1:])
        for column, kind in zip(columns, ("paper", "chance"), strict=True)
    ]
    names = {
        "all sent": "the paper's scheme, all sent (m = 0)",
        "centralised": "one linear filter for all measurements",
        "modes": "interacting multiple models, all measurements",
    }
    rest = [Number.of(f"{names[kind]}: squared error", data[kind]) for kind in names]
    rest += [
        Number.of(f"best schedule of {count} packets in {_PERIOD} steps: squared error", sample)
        for (_, count), sample in zip(_searched(data), data["best"], strict=True)
    ]
    tables = [
        NumbersTable(
            "rates",
            "Squared errors at equal rates of every node",
            numbers,
            "Position and velocity together, means over time and runs.",
            columns,
        ),
        NumbersTable("beside", "Squared errors of others", rest, "", ("squared error",)),
    ]
    return PieceResult((), tables, _claims(data))


def _searched(data: dict[str, Any]) -> list[tuple[float, int]]:
    """The thresholds, with their packets in a period, whose best schedule was looked for."""
    pairs = zip(THRESHOLDS[1:], data["packets"], strict=True)
    return [(m, count) for m, count in pairs if count <= _SEARCHED]


def _claims(data: dict[str, Any]) -> list[Claim]:
    beats = [below(a, b) for a, b in zip(data["paper"], data["chance"], strict=True)]
    evidence = "; ".join(
        f"m = {m:g}: {cite(estimate(a))}, random requests {cite(estimate(b))}"
        for m, a, b in zip(THRESHOLDS[1:], data["paper"], data["chance"], strict=True)
    )
    schedules = "; ".join(
        f"m = {m:g}, {count} packets in {_PERIOD} steps: "
        f"{cite(estimate(data['paper'][THRESHOLDS.index(m) - 1]))}, the best schedule of as many "
        f"{cite(estimate(sample))}"
        for (m, count), sample in zip(_searched(data), data["best"], strict=True)
    )
    near = [
        not below(sample * 1.1, data["paper"][THRESHOLDS.index(m) - 1])
        for (m, _), sample in zip(_searched(data), data["best"], strict=True)
    ]
    price = data["paper"][0].mean() / data["all sent"].mean() - 1.0
    shares = [sum(rates) / len(rates) for rates in data["rates"]]
    return [
        Claim(
            "The trigger reduces the transmission of redundant data and so saves the network.",
            "Abstract, Section 6",
            verdict((all(share < 1.0 for share in shares), all(beats))),
            "Transmissions fall to "
            + ", ".join(f"{100.0 * share:.0f} %" for share in shares)
            + f". That they are the redundant ones would mean less error than chance: {evidence}. "
            "A node sends when its own estimate is bad, so the best node never sends.",
        ),
        Claim(
            "An appropriate threshold saves communication and keeps the accuracy that is required.",
            "Section 6",
            verdict((all(share < 1.0 for share in shares), all(near))),
            "It saves, at the price of "
            f"{percent(price)} more squared error already at m = {THRESHOLDS[1]:g}. As many "
            f"packets bring more when they are sent at other times: {schedules}.",
        ),
        Claim(
            "Centralised fusion is globally optimal, distributed fusion suboptimal.",
            "Section 1",
            verdict([below(data["centralised"], data["all sent"])]),
            f"All sent, mean squared error {cite(estimate(data['all sent']))}; one linear filter "
            f"for all measurements {cite(estimate(data['centralised']))}. It is optimal among "
            "linear filters: interacting multiple models reach "
            f"{cite(estimate(data['modes']))}.",
        ),
    ]


OTHERS = Piece(
    "others", "What as many packets could bring", compute_others, show_others, 30.0, 1000
)
