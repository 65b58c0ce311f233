"""Figures 7 to 9 of round_robin_tobit: local filters and the fused one."""

from functools import partial
from typing import Any

import fusion_gym
from fusion_gym.evaluation.episodes import record_episode
from fusion_gym.evaluation.intervals import Interval

from ..judging import cite, verdict
from ..piece_result import Claim, NumbersTable, Picture, PieceResult
from . import figures, runs
from .judging import always_below

_EIGHT = {
    "alone": "A local filter by itself falls behind the bias where its sensor is clipped.",
    "node": "A node is pulled back to the fused estimate at every step, and so hardly differs.",
}
_ENDS = ("mean", "low", "high")
_READINGS = {"alone": "by itself", "node": "node of Table I"}


def compute_nodes(episodes: int, seed: int) -> dict[str, Any]:
    """Local filters by themselves and as nodes to which the fused estimate is fed back."""
    task = fusion_gym.make_task(runs.OSCILLATOR)
    fused, local = runs.node_squares(task, runs.round_robin(task), episodes, seed)
    run = record_episode(task, runs.round_robin(task), seed)
    data = {
        "truth": run.truth, "fused_mean": run.mean, "fused_rmse": runs.error_curve(fused),
        "fused_armse": runs.armse(fused),
    }  # fmt: skip
    for sensor in range(2):
        single = runs.squares(task, runs.Turn(sensor), episodes, seed)
        data[f"alone_{sensor}_mean"] = record_episode(task, runs.Turn(sensor), seed).mean
        data[f"node_{sensor}_mean"] = run.local_mean[:, sensor]
        for name, other in (("alone", single), ("node", local[:, :, sensor])):
            data[f"{name}_{sensor}_rmse"] = runs.error_curve(other)
            data[f"{name}_{sensor}_armse"] = runs.armse(other)
            data[f"{name}_{sensor}_difference"] = runs.paired_increase(fused, other)
            data[f"{name}_{sensor}_increase"] = runs.increase(fused, other)
    return data


def show_nodes(data: dict[str, Any]) -> PieceResult:
    """Figures 7 to 9 with local filters by themselves, then once more with the nodes."""
    pictures = [picture for name in _READINGS for picture in _pictures(data, name)]
    claims = [_outperforms(data, "states", range(2), "Fig. 7", name) for name in _READINGS] + [
        _outperforms(data, "bias", range(2, 3), "Figs. 8 and 9", name) for name in _READINGS
    ]
    rows = [
        runs.armse_number(f"{label}: ARMSE{state + 1}", data[f"{key}_armse"], state, None)
        for key, label in (
            ("fused", "FTKF-DB"),
            *((f"alone_{i}", f"LTKF-DB-S{i + 1} by itself") for i in range(2)),
            *((f"node_{i}", f"LTKF-DB-S{i + 1} as a node") for i in range(2)),
        )
        for state in range(3)
    ]
    heads = tuple(f"ARMSE{state + 1}" for state in range(3))
    note = "The paper prints none of them."
    table = NumbersTable("nodes", "Mean over time of the curves", rows, note, heads)
    return PieceResult(pictures, [table], claims, [_NOTE])


def _outperforms(data: dict[str, Any], what: str, states: range, where: str, name: str) -> Claim:
    parts, words = [], []
    for sensor in range(2):
        result = data[f"{name}_{sensor}_increase"]
        parts += [result["low"][state] > 0.0 for state in states]
        _, often = always_below(data[f"{name}_{sensor}_difference"][..., states])
        ends = ", ".join(cite(Interval(*(result[key][i] for key in _ENDS))) for i in states)
        words.append(f"S{sensor + 1}'s ARMSE is larger by {ends}; the fused is {often}")
    return Claim(
        f"The fused filter outperforms both local ones in the {what} (each {_READINGS[name]})",
        f"Section IV.A, {where}", verdict(parts), ". ".join(words),
    )  # fmt: skip


_NOTE = """The text does not say what a local filter is here. Two readings were tried: a filter
*by itself* that gets its own sensor's packets alone, at the turns of the round robin, and never
hears of the other; and the *node* of Table I, before the fusion, which starts every step from the
fused estimate with twice its covariance."""


def _pictures(data: dict[str, Any], name: str) -> list[Picture]:
    label = _READINGS[name]
    suffix = "" if name == "alone" else "_nodes"
    which = f"local filter {label}" if name == "alone" else "local filter as node of Table I"

    def lines(kind: str, state: int) -> list[figures.CurveLine]:
        nodes = [figures.node(i, data[f"{name}_{i}_{kind}"][..., state]) for i in range(2)]
        if name == "node" and kind == "rmse":  # their bands are those of the fused
            nodes = [node._replace(values=node.values[0]) for node in nodes]
        return [*nodes, figures.aware(data[f"fused_{kind}"][..., state])]

    means = [data[f"{name}_{i}_armse"]["mean"] for i in range(2)]
    fused = data["fused_armse"]["mean"]
    states = [(f"RMSE{i + 1} (of x{i + 1})", lines("rmse", i)) for i in range(2)]
    text = ", ".join(
        f"{means[0][i]:.3g} and {means[1][i]:.3g} beside {fused[i]:.3g} in {state}"
        for i, state in enumerate(("x1", "x2", "b"))
    )
    return [
        Picture(
            f"figure_7{suffix}",
            f"Figure 7: RMSE1 and RMSE2, local and fused ({which})",
            f"Means over time, sensors 1 and 2 beside the fused: {text}.",
            partial(figures.curves, panels=states, from_zero=True),
            (7.2, 4.8),
        ),
        Picture(
            f"figure_8{suffix}",
            f"Figure 8: the bias, local and fused ({which})",
            f"One run, that of Figures 2 to 4. {_EIGHT[name]}",
            partial(
                figures.curves,
                panels=[("bias b", [*lines("mean", 2), figures.true(data["truth"][:, 2])])],
            ),
            (7.2, 3.4),
        ),
        Picture(
            f"figure_9{suffix}",
            f"Figure 9: RMSE3, local and fused ({which})",
            "Root mean squared error of the bias over all runs"
            f"{', with 95 % bands' if name == 'alone' else '; the band is the 95 % of the fused'}.",
            partial(figures.curves, panels=[("RMSE3 (of b)", lines("rmse", 2))], from_zero=True),
            (7.2, 3.4),
        ),
    ]
