"""What the errors and covariances of both fusions say about the paper's claims."""

from typing import Any

import numpy as np

from fusion_gym.arrays import Array
from fusion_gym.evaluation.intervals import Interval

from ..judging import below, cite, estimate, percent, verdict
from ..piece_result import Claim, Number, NumbersTable, PieceResult
from .errors import ALWAYS, AT_BOUND, FUSIONS, OTHERS, top
from .figures import tracking_pictures
from .runs import SCALES, SENSORS, STATES

_NAMES = {"sci": "SCI", "sici": "SICI"}
_CLOSE = 0.1  # relative difference of two traces that still counts as close
_SCALED = [f"scale {scale}" for scale in SCALES]


class _Data:
    """What was computed, by fusion rule, name and setting."""

    def __init__(self, data: dict[str, Any]) -> None:
        self.data = data

    def __call__(self, fusion: str, name: str, lane: str) -> Array:
        return self.data[f"{fusion}_{name}"][self.data["lanes"].index(lane)]

    def relative(self, fusion: str, lane: str) -> Array:
        """MSE over actual trace, minus 1, for each episode's MSE."""
        return self(fusion, "mse", lane) / self(fusion, "actual", lane).mean() - 1.0


def show_fusion(results: dict[str, Any]) -> PieceResult:
    """Figures 4 to 9, tables of errors and traces, and the claims about them."""
    data = _Data(results)
    return PieceResult(
        pictures=tracking_pictures(results),
        tables=[_traces(data, _AT_BOUND, "traces"), _traces(data, _BELOW, "scales"), _shares(data)],
        claims=[*_figure_claims(data), *_bounds(data), *_comparisons(data)],
        notes=[_correlation(data)],
    )


_AT_BOUND = {AT_BOUND: "trigger", OTHERS: "trigger's requests of another episode", ALWAYS: "always"}
_BELOW = {lane: f"trigger, variances {lane.split()[1]} of the bounds" for lane in _SCALED}
_QUANTITIES = {"mse": "MSE", "actual": "actual trace", "conservative": "conservative trace"}


def _traces(data: _Data, lanes: dict[str, str], name: str) -> NumbersTable:
    titles = {
        "traces": "Errors and traces, actual variances at their bounds",
        "scales": "Errors and traces, actual variances below their bounds",
    }
    return NumbersTable(
        name,
        titles[name],
        [
            Number.of(f"{_NAMES[fusion]}, {label}: {text}", data(fusion, quantity, lane))
            for fusion in FUSIONS
            for lane, label in lanes.items()
            for quantity, text in _QUANTITIES.items()
        ],
        "Sums over position, velocity and acceleration in SI units, means over 600 steps.",
        tuple(_QUANTITIES.values()),
    )


def _shares(data: _Data) -> NumbersTable:
    return NumbersTable(
        "inside",
        "Share of errors within three actual standard deviations, in per cent",
        [
            Number.of(
                f"{_NAMES[fusion]}, variances {scale:g} of the bounds: {state}",
                100.0 * data(fusion, "inside", f"scale {scale}")[place],
            )
            for fusion in FUSIONS
            for scale in SCALES
            for place, state in enumerate(STATES)
        ],
        "The paper: “more than 99 %”. A Gaussian error would be inside in 99.73 % of the steps.",
        STATES,
    )


def _correlation(data: _Data) -> str:
    parts = [
        f"{_NAMES[fusion]}: {_share(estimate(data.relative(fusion, AT_BOUND)))} under the "
        f"trigger, {_share(estimate(data.relative(fusion, OTHERS)))} with the requests of "
        "another episode"
        for fusion in FUSIONS
    ]
    return (
        "**Actual variances and actual errors.** The recursions (23) and (28), (43) and (55) are "
        "exact for requests that do not depend on the noise. Under the trigger they do: a sensor "
        "speaks when its error is large. So we ran every episode also with the requests that the "
        "trigger makes in another episode, the same rates and patterns on independent noise. MSE "
        f"relative to the actual trace: {'; '.join(parts)}."
    )


def _figure_claims(data: _Data) -> list[Claim]:
    follows, closeness, under = [], [], []
    for fusion in FUSIONS:
        square, level = data(fusion, "square", AT_BOUND), data(fusion, "level", AT_BOUND)
        follows += list(1.0 - square.mean(-1) / level.mean(-1))
        off = estimate(data.relative(fusion, AT_BOUND))
        closeness.append((off, _close(off)))
        mse, traces = (data(fusion, name, AT_BOUND) for name in ("mse", "conservative"))
        curves = [data(fusion, f"{n}_steps", AT_BOUND) for n in ("mse", "conservative")]
        under.append((below(mse, traces), float((curves[0] <= curves[1]).mean())))
    inside = [
        (data(fusion, "inside", lane)[i], f"{_NAMES[fusion]}, {lane}, {state}")
        for fusion in FUSIONS
        for lane in _SCALED
        for i, state in enumerate(STATES)
    ]
    more = [estimate(sample).mean > 0.99 for sample, _ in inside]
    least, where = min((float(sample.mean()), name) for sample, name in inside)
    whole = [
        _fine(float(np.mean([data(fusion, "inside", lane).mean() for lane in _SCALED])))
        for fusion in FUSIONS
    ]
    return [
        Claim(
            "Both fused estimates track well.",
            "Section 6, Figure 4",
            verdict(share > 0.99 for share in follows),
            f"They explain at least {_fine(min(follows))} of every state's mean square about its "
            "start.",
        ),
        Claim(
            "The MSE is close to the trace of the actual error variance.",
            "Section 6, Figure 5",
            verdict(close for _, close in closeness),
            f"It differs by {_share(closeness[0][0])} (SCI) and {_share(closeness[1][0])} (SICI) "
            f"of the trace; we call {100 * _CLOSE:g} % close. The trigger depends on the noise, "
            "which the actual variance does not know.",
        ),
        Claim(
            "The MSE lies below the trace of the conservative error variance.",
            "Section 6, Figure 5",
            verdict(value for value, _ in under),
            f"On average over the episode, and at {_fine(under[0][1])} (SCI) and "
            f"{_fine(under[1][1])} (SICI) of the steps.",
        ),
        Claim(
            "More than 99 % of the fused errors lie within three actual standard deviations.",
            "Section 6, Figures 7 and 8",
            verdict(more),
            f"{sum(more)} of {len(more)} shares (rule, set of variances, state) exceed 99 %; the "
            f"least is {_fine(least)} ({where}). Over states and sets: SCI {whole[0]}, SICI "
            f"{whole[1]}.",
        ),
    ]


def _bounds(data: _Data) -> list[Claim]:
    lanes = [AT_BOUND, *_SCALED]
    ordered = {f: [data(f, "ordered", lane).mean(-1) for lane in _SCALED] for f in FUSIONS}
    bounded = {f: [float(data(f, "bounded", lane).mean()) for lane in lanes] for f in FUSIONS}
    worst = {f: max(float(data(f, "worst", lane).max()) for lane in lanes) for f in FUSIONS}
    nodes = [float(data("sci", "node_bounded", lane).min()) for lane in lanes]
    gap = float(data("sci", "node_gap", AT_BOUND).max())
    real = {lane: estimate(top(data("sici", "whitened", lane))) for lane in (AT_BOUND, ALWAYS)}
    shares = ", ".join(
        f"{percent(share)} ({lane.removeprefix('scale ')})"
        for share, lane in zip(bounded["sici"], lanes, strict=True)
    )
    return [
        Claim(
            "The actual deviations never exceed the robust ones, in all three groups.",
            "Section 6, Figures 7 and 8",
            verdict(float(each.min()) == 1.0 for f in FUSIONS for each in ordered[f]),
            "Least share of the steps over states, by group: "
            + "; ".join(
                f"{_NAMES[f]} " + ", ".join(percent(float(each.min())) for each in ordered[f])
                for f in FUSIONS
            )
            + ".",
        ),
        Claim(
            "Every node's conservative variance bounds its actual one.",
            "Theorem 1, (31); Figure 9",
            verdict(share == 1.0 for share in nodes),
            f"P - P̄ is positive semidefinite in {percent(min(nodes))} of the steps, nodes and "
            "sets of variances.",
        ),
        Claim(
            "It is the least such bound: at the bounds of the variances both are equal.",
            "Theorem 1",
            verdict([gap < 1e-9]),
            f"They differ by at most {gap:.1g} of the largest entry.",
        ),
        Claim(
            "SCI's conservative variance bounds its actual one.",
            "Corollary 2, (46)",
            verdict(share == 1.0 for share in bounded["sci"]),
            f"In {percent(min(bounded['sci']))} of the steps; the largest ratio of actual to "
            f"conservative variance in any direction is {worst['sci']:.3f}.",
        ),
        Claim(
            "SICI's conservative variance bounds its actual one.",
            "Theorem 5, (63)",
            "holds" if min(bounded["sici"]) == 1.0 else "does not hold",
            f"P - P̄ is positive semidefinite in {shares} of the steps, by actual variances; the "
            f"largest ratio in any direction is {worst['sici']:.2f}. Real errors, mean square in "
            "their largest direction after whitening with P (1 is the bound): "
            f"{cite(real[ALWAYS])} when every sensor always transmits, {cite(real[AT_BOUND])} "
            "under the trigger.",
        ),
        Claim(
            "P̄ is the covariance of the actual fused errors.",
            "Corollary 1, (43); Theorem 4, (55)",
            verdict(
                _close(value)
                for f in FUSIONS
                for value in (estimate(data.relative(f, lane)) for lane in (AT_BOUND, OTHERS))
            ),
            "Traces: relative differences of "
            + "; ".join(
                f"{_NAMES[f]} {_share(estimate(data.relative(f, AT_BOUND)))} under the trigger, "
                f"{_share(estimate(data.relative(f, OTHERS)))} with the requests of another episode"
                for f in FUSIONS
            )
            + ".",
        ),
    ]


def _comparisons(data: _Data) -> list[Claim]:
    mse = {f: data(f, "mse", AT_BOUND) for f in FUSIONS}
    trace = {f: data(f, "conservative", AT_BOUND) for f in FUSIONS}
    late = [data(f, "mse_steps", AT_BOUND)[399:600] for f in FUSIONS]
    wins = float((mse["sici"] < mse["sci"]).mean())
    bounded = {f: float(data(f, "bounded", AT_BOUND).mean()) for f in FUSIONS}
    beats = {f: data(f, "beats", AT_BOUND).mean(-1) for f in FUSIONS}
    node = data("sci", "node_mse", AT_BOUND)
    better = [below(mse[f], node[i]) for f in FUSIONS for i in range(len(SENSORS))]
    whole = [data(f, "encloses", lane).mean(-1) for f in FUSIONS for lane in _SCALED[:1]]
    plane = [data(f, "encloses_plane", lane).mean(-1) for f in FUSIONS for lane in _SCALED[:1]]
    price = {f: _share(estimate(mse[f] / data(f, "mse", ALWAYS).mean() - 1.0)) for f in FUSIONS}
    accurate, tight = below(mse["sici"], mse["sci"]), below(trace["sici"], trace["sci"])
    return [
        Claim(
            "SICI is more accurate than SCI.",
            "Section 6, Figure 6",
            verdict([accurate, late[1].mean() < late[0].mean()]),
            f"MSE {cite(estimate(mse['sici']))} against {cite(estimate(mse['sci']))}; SICI is the "
            f"better in {percent(wins)} of the runs, and its mean over runs at "
            f"{percent(float((late[1] < late[0]).mean()))} of the steps 400 to 600.",
        ),
        Claim(
            "SICI has higher accuracy, better tightness and better consistency than SCI.",
            "Remark 3",
            verdict([accurate, tight, bounded["sici"] >= bounded["sci"]]),
            f"Accuracy: as above. Tightness: conservative trace {cite(estimate(trace['sici']))} "
            f"against {cite(estimate(trace['sci']))}. Consistency: its variance is a bound in "
            f"{percent(bounded['sici'])} of the steps, SCI's in {percent(bounded['sci'])}.",
        ),
        Claim(
            "The robust accuracy of both fusions is higher than each sensor's.",
            "Section 6, Figure 9",
            verdict([*(bool(b.min() > 0.99) for b in beats.values()), *better]),
            "The fused conservative trace is at most a node's in at least "
            + " (SCI) and ".join(percent(float(beats[f].min())) for f in FUSIONS)
            + " (SICI) of the steps; MSE of the nodes: "
            + ", ".join(cite(estimate(each)) for each in node)
            + ".",
        ),
        Claim(
            "The nodes' conservative ellipses contain those of both fusions.",
            "Section 6, Figure 9",
            verdict(bool(share > 0.99) for shares in (*whole, *plane) for share in shares),
            "Share of the steps for sensors 1 to 3, of position and velocity alone: "
            + "; ".join(_by_node(f, each) for f, each in zip(FUSIONS, plane, strict=True))
            + ". Of all three states: "
            + "; ".join(_by_node(f, each) for f, each in zip(FUSIONS, whole, strict=True))
            + ". Smaller traces do not make smaller matrices.",
        ),
        Claim(
            "The trigger saves communication while the estimation stays effective.",
            "Abstract, Section 6",
            verdict(below(mse[f], data(f, "mse", OTHERS)) for f in FUSIONS),
            f"Against always transmitting the MSE is larger by {price['sci']} (SCI) and "
            f"{price['sici']} (SICI); with as many requests that do not look at the "
            f"noise it is {cite(estimate(data('sci', 'mse', OTHERS)))} and "
            f"{cite(estimate(data('sici', 'mse', OTHERS)))} against {cite(estimate(mse['sci']))} "
            f"and {cite(estimate(mse['sici']))}.",
        ),
    ]


def _share(interval: Interval) -> str:
    """A relative difference in per cent."""
    return cite(Interval(*(100.0 * value for value in interval))) + " %"


def _close(interval: Interval) -> bool:
    return max(abs(interval.low), abs(interval.high)) <= _CLOSE


def _fine(share: float) -> str:
    """A share near 1 in per cent."""
    return f"{100.0 * share:.2f} %"


def _by_node(fusion: str, shares: Array) -> str:
    return f"{_NAMES[fusion]} " + ", ".join(percent(float(share)) for share in shares)
