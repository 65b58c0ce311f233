"""What the Markov jump paper's trigger sends and what the covariances become: Figures 2 and 5."""

from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from fusion_gym.arrays import Array

from ..judging import percent, verdict
from ..paper import Piece
from ..piece_result import Claim, Number, NumbersTable, Picture, PieceResult
from . import figures
from .runs import THRESHOLDS, example, run_markov_jump, trigger

_LONG, _SHOWN, _INSTANTS = 200, 100, 60  # steps
_LAST = 60  # steps that stand for the settled ones
_SETTLED = 1e-9  # relative change over a period below which a trace repeats itself
_MARGIN = 1e-5  # of a threshold beyond the range of those that make a difference
_PRINTED = {  # of Section 6, with half of their last digit
    "mean of β": ((0.65, 0.39, 0.45), 0.005),
    "variance of β": ((0.09, 0.0499, 0.0585), 0.00005),
}


def compute_schedule(episodes: int, seed: int) -> dict[str, Any]:
    """Schedules and traces of one run, for none depends on the data."""
    task = example(horizon=_LONG)
    system: Any = task.system
    runs = [run_markov_jump(task, trigger(m), episodes, seed) for m in THRESHOLDS]
    short = example(horizon=_SHOWN)
    literal = run_markov_jump(short, trigger(0.0, literal=True), episodes, seed)
    every, time = system.recursion.local_trace, np.arange(1, _LONG + 1)
    local = every[:, system.filters.at(time)]
    cycle = system.filters.period
    settled = local[:, -cycle:]
    reference = system.full_rate_traces()
    gaps = settled - reference.mean()
    inner, outer = float(gaps.min()), float(gaps.max())
    at_ends = [
        run_markov_jump(short, f"local_variance:m={m!r}", episodes, seed).sent[-2 * cycle :].mean()
        for m in (inner - _MARGIN, outer + _MARGIN)
    ]
    sensors = system.sensors
    mean = (sensors.fading_values * sensors.fading_probabilities).sum(1)
    square = (sensors.fading_values**2 * sensors.fading_probabilities).sum(1)
    return {
        "sent": np.array([run.sent for run in runs]),
        "trace": np.array([run.trace for run in runs]),
        "literal": literal.sent,
        "local": local,
        "periods": sensors.period[:, 0],
        "reference": reference,
        "range": [inner, outer],
        "at_ends": [float(share) for share in at_ends],
        "radii": [
            float(np.abs(np.linalg.eigvals(system.plant.transition[..., mode])).max())
            for mode in range(system.plant.modes)
        ],
        "square_radius": float(system.plant.second_moment_radius()),
        "mean of β": mean,
        "variance of β": square - mean**2,
    }


def period_of(values: Array) -> int | None:
    """After how many steps values (H,) repeat themselves at their end; None if they do not."""
    last = values[-_LAST:]
    for period in range(1, _LAST // 3):
        if np.abs(last[period:] - last[:-period]).max() <= _SETTLED * np.abs(last).max():
            return period
    return None


def show_schedule(data: dict[str, Any]) -> PieceResult:
    """Figures 2 and 5."""
    sent, trace = data["sent"].astype(bool), data["trace"]
    first = sent[:, :_SHOWN]
    columns = ("node 1", "node 2", "node 3", "packets a step", "mean trace", "settled trace")
    numbers = []
    for m, share, whole in zip(THRESHOLDS, first.mean(1), trace, strict=True):
        values = (*share, share.sum(), whole[:_SHOWN].mean(), whole[-_LAST:].mean())
        numbers += [
            _exact(f"m = {m:g}: {what}", float(value))
            for what, value in zip(columns, values, strict=True)
        ]
    printed = [
        Number(f"{what} of node {node + 1}", ours, ours, ours, value, half / 1.96)
        for what, (values, half) in _PRINTED.items()
        for node, (value, ours) in enumerate(zip(values, data[what].tolist(), strict=True))
    ]
    tables = [
        NumbersTable(
            "schedule",
            "Share of steps in which a node sends, and the fused covariance",
            numbers,
            f"Over the first {_SHOWN} steps; settled: from step {_LONG - _LAST + 1} on. Traces in "
            "m² and m²/s² together. Nothing here depends on data, so there are no intervals.",
            columns,
        ),
        NumbersTable("fading", "Fading, from its printed distribution", printed),
    ]
    pictures = [
        Picture(
            "figure_2",
            "Figure 2: triggering instants of the local filters at m = 0.9, 1.3 and 1.5",
            f"The first {_INSTANTS} steps. A filled circle at 1: the centre receives the node's "
            "estimate; a hollow one at 0: it does not. Larger m, fewer packets; node 1, whose "
            "estimate is the best, never sends. After a start the pattern repeats itself.",
            partial(figures.instants, sent=sent[1:, :_INSTANTS]),
            (7.2, 6.4),
        ),
        Picture(
            "figure_5",
            "Figure 5: traces of the fused covariance at four thresholds",
            "Larger m, larger trace. After a start the traces are periodic: the saw's teeth are "
            "the packets, and between them the centre predicts.",
            partial(figures.traces, values=trace[:, :_SHOWN]),
            (7.2, 3.9),
        ),
    ]
    return PieceResult(pictures, tables, [*_of_the_trigger(data), *_of_the_traces(data)])


def _exact(what: str, value: float) -> Number:
    return Number(what, value, value, value)


def _of_the_trigger(data: dict[str, Any]) -> list[Claim]:
    sent = data["sent"].astype(bool)[:, :_SHOWN]
    shares = sent.mean(1)
    packets = shares.sum(-1)
    falling = [bool(now > later) for now, later in pairwise(packets)]
    literal = data["literal"].astype(bool)
    quiet = int((~literal.all(-1)).nonzero()[0].max(initial=-1)) + 1
    inner, outer = data["range"]
    ends = [data["at_ends"][0] == 1.0, data["at_ends"][1] == 0.0]
    rates = "; ".join(
        f"m = {m:g}: " + ", ".join(f"{share:.2f}" for share in item)
        for m, item in zip(THRESHOLDS, shares, strict=True)
    )
    return [
        Claim(
            "The larger the threshold, the less is sent.",
            "Section 6, of Figure 2",
            verdict(falling),
            f"Shares of nodes 1, 2, 3 at {rates}; together "
            + ", ".join(f"{packet:.2f}" for packet in packets)
            + " packets a step.",
        ),
        Claim(
            "At m = 0 all local estimates are sent.",
            "Section 6, of Figure 4",
            verdict([bool(literal.all()), bool(literal[_SHOWN // 2 :].all())]),
            f"By (33) taken at its word all of them from step {quiet + 1} on; before, the nodes' "
            "traces are still below tr P_d, for x(0) is known well. Our figures have all sent at "
            "m = 0, as the text says.",
        ),
        Claim(
            "Thresholds that make a difference lie between the least and the largest "
            "tr P_i - tr P_d; below the least everything is sent.",
            "Remark 4",
            verdict(ends),
            f"Settled, from {inner:.3f} to {outer:.3f}. Just below, "
            f"{percent(data['at_ends'][0])} of the estimates are sent, just above "
            f"{percent(data['at_ends'][1])}.",
        ),
    ]


def _of_the_traces(data: dict[str, Any]) -> list[Claim]:
    trace, local = data["trace"], data["local"]
    larger = [
        float((trace[k + 1] >= trace[k] * (1.0 - 1e-12)).mean()) for k in range(len(trace) - 1)
    ]
    fused = [period_of(item) for item in trace]
    own = [period_of(item) for item in local]
    steady = [period is not None for period in fused]
    stable = [radius < 1.0 for radius in data["radii"]]
    return [
        Claim(
            "The larger the threshold, the larger the trace of the fused covariance.",
            "Section 6, of Figure 5",
            verdict(share == 1.0 for share in larger),
            "From one threshold to the next it grows or stays in "
            + ", ".join(percent(share) for share in larger)
            + " of all steps; settled means "
            + ", ".join(f"{item[-_LAST:].mean():.3f}" for item in trace)
            + " at m = 0, 0.9, 1.3, 1.5.",
        ),
        Claim(
            "The fused covariances are periodically stable.",
            "Section 6, of Figure 5; Section 7",
            verdict(steady),
            "Periods at m = 0, 0.9, 1.3, 1.5: "
            + ", ".join("none" if period is None else str(period) for period in fused)
            + f" steps, to a relative {_SETTLED:.0e}.",
        ),
        Claim(
            "A local filter's covariance is periodic with its own sampling period.",
            "Remark 2",
            verdict(period == int(due) for period, due in zip(own, data["periods"], strict=True)),
            "Periods of nodes 1, 2, 3: "
            + ", ".join("none" if period is None else str(period) for period in own)
            + " steps.",
        ),
        Claim(
            "Every mode of the example is stable by itself, ρ(Φ) < 1, and so is the system.",
            "Section 2",
            verdict((all(stable), data["square_radius"] < 1.0)),
            "ρ(Φ) is "
            + " and ".join(f"{radius:.3g}" for radius in data["radii"])
            + f". What counts for the mean square is the jump system's own radius, "
            f"{data['square_radius']:.4f} < 1.",
        ),
    ]


_TITLE = "What is sent, and the covariances (Figures 2 and 5)"
SCHEDULE = Piece("schedule", _TITLE, compute_schedule, show_schedule, 5.0, 2)
