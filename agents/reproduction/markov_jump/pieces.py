"""Fusion of event-triggered estimates of a Markov jump system: Section 6 anew, Figures 2 to 5.

Source: markov_jump (event-triggered distributed fusion estimation for asynchronous Markov jump
systems with correlated noises and fading measurements).
"""

from functools import partial
from typing import Any

import numpy as np

from ..judging import below, cite, estimate, percent, verdict
from ..paper import Paper, Piece
from ..piece_result import Claim, Number, NumbersTable, Picture, PieceResult
from . import figures
from .others import OTHERS
from .runs import STATES, THRESHOLDS, example, run_markov_jump, trigger
from .schedule import SCHEDULE
from .theorems import THEOREMS

_PAPERS_RUNS = 100
_TRACKED = 0.9  # of the squared error of an estimate that receives nothing


def tracking(episodes: int, seed: int) -> dict[str, Any]:
    """Estimates of one episode and root mean square errors at every threshold."""
    task = example()
    means, few, every, squares = [], [], [], []
    for m in THRESHOLDS:
        requests = run_markov_jump(task, trigger(m), episodes, seed)
        squared = requests.squared
        means.append(requests.mean[..., 0])
        few.append(np.sqrt(squared[..., :_PAPERS_RUNS].mean(-1)))
        every.append(np.sqrt(squared.mean(-1)))
        squares.append(squared.mean(0))
    silent = run_markov_jump(task, "never", episodes, seed)
    return {
        "truth": silent.truth[..., 0],
        "means": np.array(means),
        "few": np.array(few),
        "every": np.array(every),
        "squares": np.array(squares),
        "silent": silent.squared.mean(0),
    }


def show_tracking(data: dict[str, Any]) -> PieceResult:
    """Figures 3 and 4."""
    names = [f"mean squared error of the {state}" for state in STATES]
    rows = [(f"m = {m:g}", square) for m, square in zip(THRESHOLDS, data["squares"], strict=True)]
    rows.append(("nothing sent", data["silent"]))
    numbers = [
        Number.of(f"{row}: {name}", square[state])
        for row, square in rows
        for state, name in enumerate(names)
    ]
    pictures = [
        Picture(
            "figure_3",
            "Figure 3: tracking of position and velocity at four thresholds",
            "One episode. With larger m the estimates come later and flatter: they follow the "
            "slow course of the position and ever less of the velocity. The paper draws m = 0, "
            "0.9, 1.3, 1.5 in black, blue, green, red.",
            partial(figures.draw_tracking, truth=data["truth"], means=data["means"]),
            (7.2, 5.0),
        ),
        Picture(
            "figure_4",
            "Figure 4: RMSE of position and velocity at four thresholds",
            f"Thick: all runs. Thin: the first {_PAPERS_RUNS}, as many as the paper has. The order "
            "of the curves is that of the thresholds, m = 1.5 on top; for the velocity they lie "
            "close together.",
            partial(figures.draw_node_errors, few=data["few"], all_runs=data["every"]),
            (7.2, 5.0),
        ),
    ]
    table = NumbersTable(
        "errors",
        "Errors at the thresholds",
        numbers,
        "Means over time and runs, m² and m²/s². The paper prints curves only.",
        tuple(names),
    )
    return PieceResult(pictures, [table], _claims(data))


def _claims(data: dict[str, Any]) -> list[Claim]:
    squares, silent = data["squares"], data["silent"]
    pairs = [(k, state) for k in range(len(THRESHOLDS) - 1) for state in range(len(STATES))]
    ordered = [below(squares[k, s], squares[k + 1, s]) for k, s in pairs]
    roots = [
        f"{state} " + ", ".join(f"{np.sqrt(square.mean()):.3f}" for square in squares[:, s])
        for s, state in enumerate(STATES)
    ]
    top = (data["every"][-1] >= data["every"].max(0)).mean(0)
    few_top = (data["few"][-1] >= data["few"].max(0)).mean(0)
    parts, words = [], []
    for s, state in enumerate(STATES):
        share = [1.0 - square[s].mean() / silent[s].mean() for square in squares]
        parts += [below(square[s], _TRACKED * silent[s]) for square in squares]
        words.append(f"of the {state} " + ", ".join(percent(item) for item in share))
    first = all(below(squares[0, s], squares[k, s]) for k in (1, 2, 3) for s in range(2))
    return [
        Claim(
            "The algorithm tracks position and velocity at every threshold.",
            "Section 6, of Figure 3",
            verdict(parts),
            "What it takes off the mean squared error of an estimate that receives nothing, a "
            f"tenth at least if it tracks, at m = 0, 0.9, 1.3, 1.5: {'; '.join(words)}.",
        ),
        Claim(
            "The tracking becomes worse as the threshold grows.",
            "Section 6, of Figures 3 and 4",
            verdict(ordered),
            f"RMSE at m = 0, 0.9, 1.3, 1.5: {'; '.join(roots)}. Of {len(ordered)} steps from one "
            f"threshold to the next, {sum(ordered)} raise the error for sure.",
        ),
        Claim(
            "The RMSE curve of m = 1.5 is at the top.",
            "Section 6, of Figure 4",
            verdict(share > 0.5 for share in top),
            f"At the top or level with it in {percent(float(top[0]))} of the steps for the "
            f"position and {percent(float(top[1]))} for the velocity; with the first "
            f"{_PAPERS_RUNS} runs alone in {percent(float(few_top[0]))} and "
            f"{percent(float(few_top[1]))}.",
        ),
        Claim(
            "At m = 0 the accuracy is best.",
            "Section 6, of Figure 4",
            verdict([first]),
            f"Mean squared error of the position {cite(estimate(squares[0, 0]))} at m = 0, "
            f"{cite(estimate(squares[1, 0]))} at m = 0.9; of the velocity "
            f"{cite(estimate(squares[0, 1]))} and {cite(estimate(squares[1, 1]))}.",
        ),
    ]  # fmt: skip


PAPER = Paper(
    name="markov_jump",
    title="Event-triggered fusion for Markov jump systems",
    citation=(
        "“Event-triggered distributed fusion estimation for asynchronous Markov jump systems with "
        "correlated noises and fading measurements”."
    ),
    pieces=(
        SCHEDULE,
        Piece(
            "tracking", "Tracking and its errors (Figures 3 and 4)",
            tracking, show_tracking, 20.0, 1000,
        ),
        THEOREMS,
        OTHERS,
    ),
)  # fmt: skip
