"""Fusion of event-triggered estimates of a Markov jump system: Figures 2 to 5 and the theorems.

Source: markov_jump (event-triggered distributed fusion estimation for asynchronous Markov jump
systems with correlated noises and fading measurements), Section 6.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

import fusion_gym
from agents.papers.drawing import legend, stack
from agents.papers.markov_jump_claims import SETTLED, claims
from agents.papers.markov_jump_covariances import covariances, fused_traces, iterated_gap
from agents.papers.numbers import Number, below, grid
from agents.papers.paper import Data, Paper, PaperFigure, Piece, Settings
from agents.papers.walk import walk
from fusion_gym.arrays import Array
from fusion_gym.core.task import Task
from fusion_gym.output import palette
from fusion_gym.systems.markov_jump.environment import MarkovJumpTrackingOptions
from fusion_gym.systems.markov_jump.linear_minimum_variance import LagRecursion

STATES = ("position", "velocity")
UNITS = ("m", "m/s")
_PAPERS_RUNS = 100
_LONG, _SHOWN = 200, 100  # steps
_LAST = 60  # steps that stand for the settled ones
_MARGIN = 1e-5  # of a threshold beyond the range of those that make a difference
_PRINTED = {  # of Section 6, with half of their last digit
    "mean of β": ((0.65, 0.39, 0.45), 0.005), "variance of β": ((0.09, 0.0499, 0.0585), 0.00005),
}  # fmt: skip
_PERIOD = 6  # steps, after which all sensors' sampling repeats
_SEARCHED = 4  # packets in a period, up to which all schedules are compared


# What the text leaves open in (33).
READINGS: dict[str, Settings] = {
    "our reading": {},
    "traces of ζ in (33), also in tr P_d": {"augmented": True, "reference": 3.1346},
    "tr P_d the least over a period": {"reference": 1.1802},
}


def example(**options: Any) -> Task:
    """Return the paper's Section 6, with changed ``options``."""
    return fusion_gym.make_task(MarkovJumpTrackingOptions(**options))


class AugmentedTraces(LagRecursion):
    """The recursion of the errors with traces of ζ for the trigger (33), not of x."""

    @property
    def local_trace(self) -> Array:
        """Trace of each node's augmented error covariance after the update, (l, T)."""
        return np.einsum("iiaaT->iT", self.filters.covariance)


def read_example(settings: Settings, **options: Any) -> Task:
    """Return the example with the traces that (33) compares under the settings."""
    task = example(**(options | settings["options"]))
    defaults, estimator = task.policy_defaults, cast(Any, task.estimator)
    if settings["augmented"]:
        recursion = AugmentedTraces(**vars(estimator.recursion))
        estimator = replace(estimator, recursion=recursion)
    if settings["reference"] is not None:
        defaults = defaults | {"local_variance": {"reference": settings["reference"]}}
    return replace(task, estimator=estimator, policy_defaults=defaults)


def trigger(m: float, literal: bool = False) -> str:
    """Return the paper's trigger (33) at the threshold m; m = 0 sends always.

    ``literal`` applies (33) at m = 0, too.
    """
    return f"local_variance:m={m!r}" if m or literal else "always"


def _lanes(settings: Settings) -> dict[str, str]:
    """Return the trigger at every threshold and the other policies, by their labels."""
    return {f"m = {m:g}": trigger(m) for m in settings["m"]}


class Run(NamedTuple):
    """E episodes of H steps, k = 1..H first.

    ``truth`` and ``mean`` (H, n, E), the fused estimate · ``local_error`` (H, l, n, E) · of the
    first episode, which represents all episodes of a covariance trigger: ``sent`` (H, l) bool and
    the ``trace`` (H,) of the fused covariance.
    """

    truth: Array
    mean: Array
    local_error: Array
    sent: NDArray[np.bool_]
    trace: Array

    @property
    def squared(self) -> Array:
        """Squared errors (H, n, E)."""
        return np.square(self.truth - self.mean)


def run_markov_jump(task: Task, policy: str, episodes: int, seed: int) -> Run:
    """Run episodes with consecutive seeds from ``seed``."""
    rows: list[tuple[Any, ...]] = []
    plant, estimator = task.plant, task.estimator
    for batch, requests in walk(task, policy, episodes, seed):
        truth, outcome = plant.truth(batch.state.plant), batch.step(requests)
        estimate = batch.delivered.estimate
        mean, nodes = estimator.mean(estimate), hasattr(estimate, "node_mean")
        local = estimator.local_means(estimate) if nodes else mean[None]
        trace = np.trace(estimator.covariance(estimate))[:1]
        rows.append((truth, mean, truth - local, outcome.granted[:, 0], trace))
    truth, mean, local, sent, trace = (np.array(row) for row in zip(*rows, strict=True))
    return Run(truth, mean, local, sent, trace[:, 0])


# --- what is sent, and the covariances ------------------------------------------------------------


def simulate_schedule(episodes: int, seed: int, settings: Settings) -> Data:
    """Return schedules and traces of one run, which do not depend on the data."""
    lanes = _lanes(settings)
    task, short = (read_example(settings, horizon=horizon) for horizon in (_LONG, _SHOWN))
    plant: Any = task.plant
    estimator: Any = task.estimator
    runs = [run_markov_jump(task, policy, episodes, seed) for policy in lanes.values()]
    place = estimator.filters.at(np.arange(1, task.horizon + 1))
    local = estimator.recursion.local_trace[:, place]
    cycle = estimator.filters.period
    gaps = local[:, -cycle:] - task.policy_defaults["local_variance"]["reference"]
    limits = [float(gaps.min()), float(gaps.max())]
    at_ends = [
        run_markov_jump(short, trigger(m, literal=True), episodes, seed).sent[-2 * cycle :].mean()
        for m in (limits[0] - _MARGIN, limits[1] + _MARGIN)
    ]
    sensors, dynamics = plant.sensors, plant.dynamics
    transitions = np.moveaxis(dynamics.transition, -1, 0)
    mean = (sensors.fading_values * sensors.fading_probabilities).sum(1)
    square = (sensors.fading_values**2 * sensors.fading_probabilities).sum(1)
    return {
        "m": list(settings["m"]), "labels": list(lanes),
        "sent": np.array([run.sent for run in runs]),
        "trace": np.array([run.trace for run in runs]),
        "literal": run_markov_jump(short, trigger(0.0, literal=True), episodes, seed).sent,
        "local": local, "periods": sensors.period[:, 0], "range": limits,
        "at_ends": [float(share) for share in at_ends],
        "radii": np.abs(np.linalg.eigvals(transitions)).max(-1).tolist(),
        "square_radius": float(dynamics.second_moment_radius()), "mean of β": mean,
        "variance of β": square - mean**2,
    }  # fmt: skip


def period_of(values: Array) -> int:
    """Return the period of values (H,) at their end, or 0."""
    last = values[-_LAST:]
    for period in range(1, _LAST // 3):
        if np.abs(last[period:] - last[:-period]).max() <= SETTLED * np.abs(last).max():
            return period
    return 0


def _summarise_schedule(data: Data) -> Data:
    sent, trace = data["sent"].astype(bool)[:, :_SHOWN], data["trace"]
    shares = sent.mean(1)
    packets, settled = shares.sum(-1), trace[:, -_LAST:].mean(-1)
    columns = ("node 1", "node 2", "node 3", "packets per step", "mean trace", "settled trace")
    values = np.column_stack((shares, packets, trace[:, :_SHOWN].mean(-1), settled))
    fused, own = ([period_of(item) for item in curves] for curves in (trace, data["local"]))
    return {
        "tables": {
            "schedule": grid(columns, dict(zip(data["labels"], values[..., None], strict=True))),
            "fading": [
                Number(f"{what} of node {node + 1}", ours, ours, ours, value, half / 1.96)
                for what, (printed, half) in _PRINTED.items()
                for node, (value, ours) in enumerate(zip(printed, data[what].tolist(), strict=True))
            ],
        },
        "shares": shares, "packets": packets,
        "larger": (trace[1:] >= trace[:-1] * (1.0 - 1e-12)).mean(-1), "settled": settled,
        "fused_periods": np.array(fused), "own_periods": np.array(own),
    }  # fmt: skip


# --- tracking and its errors ----------------------------------------------------------------------


def simulate_tracking(episodes: int, seed: int, settings: Settings) -> Data:
    """Return root mean square errors at every threshold."""
    task, lanes = read_example(settings), _lanes(settings)
    runs = (run_markov_jump(task, policy, episodes, seed) for policy in lanes.values())
    rows = []
    for run in runs:
        squared = run.squared
        few, every = (np.sqrt(part.mean(-1)) for part in (squared[..., :_PAPERS_RUNS], squared))
        rows.append((few, every, squared.mean(0)))
    names = ("few", "every", "squares")
    silent = run_markov_jump(task, "never", episodes, seed)
    return {
        "m": list(settings["m"]), "labels": list(lanes), "silent": silent.squared.mean(0),
        **{name: np.array(row) for name, row in zip(names, zip(*rows, strict=True), strict=True)},
    }  # fmt: skip


def _summarise_tracking(data: Data) -> Data:
    columns = [f"mean squared error of the {state}" for state in STATES]
    every, few = data["every"], data["few"]
    rows = dict(zip(data["labels"], data["squares"], strict=True))
    rows["nothing sent"] = data["silent"]
    return {
        "tables": {"errors": grid(columns, rows)},
        "top": (every[-1] >= every.max(0)).mean(0), "few_top": (few[-1] >= few.max(0)).mean(0),
    }  # fmt: skip


# --- theorems -------------------------------------------------------------------------------------


def simulate_theorems(episodes: int, seed: int, settings: Settings) -> Data:
    """Return actual and claimed covariances of nodes and centre; the first threshold must be 0."""
    task = read_example(settings)
    estimator: Any = task.estimator
    places = estimator.filters.at(np.arange(1, task.horizon + 1))
    fused, traces, printed, least = [], [], [], []
    first: Data = {}
    for m in settings["m"]:
        run = run_markov_jump(task, trigger(m), episodes, seed)
        fused.append(run.squared.sum(1).mean(0))
        traces.append(float(run.trace.mean()))
        if not first:
            exact = _exact(estimator, task.horizon)
            gaps = [covariances(estimator, run.sent, swapped) - exact for swapped in (True, False)]
            first = {
                "local": np.square(run.local_error).sum(2).mean(0),
                "moment": np.square(run.truth).sum(1).mean(0),
                "difference": [float(np.abs(gap).max() / np.abs(exact).max()) for gap in gaps],
            }
        sigma = covariances(estimator, run.sent, swapped=True)
        printed.append(float(fused_traces(sigma, estimator.model.plant.size)[1:].mean()))
        least.append(float(np.linalg.eigvalsh((sigma + np.swapaxes(sigma, 1, 2)) / 2.0).min()))
    references = run_markov_jump(example(fusion="ci"), trigger(0.0), episodes, seed)
    silent = run_markov_jump(task, "never", 1, seed)
    _, squares = estimator.model.state_moments(task.horizon)
    iterated = [iterated_gap(estimator, i, task.horizon) for i in range(len(first["local"]))]
    return first | {
        "m": list(settings["m"]), "iterated": iterated,
        "claimed": np.einsum("iissT->iT", estimator.recursion.local)[:, places].mean(-1),
        "fused": np.array(fused), "traces": traces, "least": least,
        "printed": printed, "open_loop": float(silent.trace.mean()),
        "moment_claimed": float(squares[1:].sum(1).mean()), "ci": references.squared.sum(1).mean(0),
    }  # fmt: skip


def _exact(estimator: Any, horizon: int) -> Array:
    """Return joint covariances (H + 1, l n, l n) of the nodes' errors from the library."""
    joint = estimator.recursion.local[..., estimator.filters.at(np.arange(horizon + 1))]
    size = joint.shape[0] * joint.shape[2]
    return np.ascontiguousarray(joint.transpose(4, 0, 2, 1, 3)).reshape(horizon + 1, size, size)


def _summarise_theorems(data: Data) -> Data:
    local = data["local"] / data["claimed"][:, None]
    ratios = {f"node {i + 1}": own for i, own in enumerate(local)}
    fused = data["fused"] / np.array(data["traces"])[:, None]
    ratios |= {f"fused, m = {m:g}": own for m, own in zip(data["m"], fused, strict=True)}
    ratios |= {"the state": data["moment"] / data["moment_claimed"]}
    pairs = zip(data["m"], data["traces"], data["printed"], strict=True)
    algorithm = {f"m = {m:g}": ([exact], [printed]) for m, exact, printed in pairs}
    columns = "exact joint covariance", "Algorithm 1 as printed"
    return {
        "tables": {
            "covariances": grid(("ratio",), {name: [own] for name, own in ratios.items()}),
            "algorithm_1": grid(columns, algorithm),
        }
    }


# --- what as many packets could bring -------------------------------------------------------------


def simulate_others(episodes: int, seed: int, settings: Settings) -> Data:
    """Return errors of random requests and of the best schedules at the trigger's rate."""
    task = read_example(settings)
    paper, chance, rates, packets, best = [], [], [], [], []

    def squared(policy: str, task: Task = task) -> Array:
        return run_markov_jump(task, policy, episodes, seed).squared.sum(1).mean(0)

    for m in settings["m"][1:]:
        run = run_markov_jump(task, trigger(m), episodes, seed)
        share = run.sent.mean(0)
        paper.append(run.squared.sum(1).mean(0))
        rates.append(share.tolist())
        chance.append(squared("random:rate=" + "/".join(f"{item:.6g}" for item in share)))
        packets.append(int(run.sent[-_PERIOD:].sum()))
        if packets[-1] <= _SEARCHED:
            best.append(squared(f"periodic_optimum:packets={packets[-1]},period={_PERIOD}"))
    return {
        "m": list(settings["m"][1:]), "paper": np.array(paper), "chance": np.array(chance),
        "rates": rates, "packets": packets, "best": np.array(best), "sent": squared("always"),
        "centralised": squared("always", example(filter="centralised")),
        "modes": squared("always", example(filter="imm")),
    }  # fmt: skip


def _summarise_others(data: Data) -> Data:
    m, paper = data["m"], data["paper"]
    columns = ("the paper's trigger", "random, same rates")
    searched = [i for i, count in enumerate(data["packets"]) if count <= _SEARCHED]
    schedules = [
        {"m": m[i], "packets": data["packets"][i], "paper": paper[i], "best": best}
        for i, best in zip(searched, data["best"], strict=True)
    ]
    references = {
        "the paper's scheme, all sent (m = 0)": [data["sent"]],
        "one linear filter for all measurements": [data["centralised"]],
        "interacting multiple models, all measurements": [data["modes"]],
    } | {
        f"best schedule of {item['packets']} packets in {_PERIOD} steps": [item["best"]]
        for item in schedules
    }
    rows = zip(m, zip(paper, data["chance"], strict=True), strict=True)
    return {
        "tables": {
            "rates": grid(columns, {f"m = {level:g}": pair for level, pair in rows}),
            "beside": grid(("squared error",), references),
        },
        "shares": np.mean(data["rates"], axis=1), "schedules": schedules,
        "far": below(1.1 * data["best"], paper[searched]),
    }  # fmt: skip


# --- figures --------------------------------------------------------------------------------------

# A colour and a line for each threshold, the same in both figures.
_LINES: tuple[tuple[str, Any], ...] = (
    (palette.GREEN, "-"),
    (palette.BLUE, (0, (5, 1))),
    (palette.ORANGE, "-"),
    (palette.VERMILLION, (0, (1.5, 0.8))),
)
_TIME = "time k (steps of 0.5 s)"
_legend = partial(legend, columns=99, handlelength=1.8, columnspacing=1.2, handletextpad=0.5)


def _draw_errors(figure: Any, data: Data) -> None:
    """Draw the RMSE over as many runs as in the paper, and over all."""
    axes = stack(figure, len(STATES), _TIME)
    for state, axis in enumerate(axes):
        _curves(axis, data, data["few"][..., state], width=0.7, alpha=0.55)
        _curves(axis, data, data["every"][..., state], width=2.0)
        axis.set_ylim(bottom=0.0)
        _title(axis, state, f"RMSE of {STATES[state]}")
    _legend(figure, axes)


def _draw_traces(figure: Any, data: Data) -> None:
    (axis,) = axes = stack(figure, 1, _TIME)
    _curves(axis, data, data["trace"][:, :_SHOWN], width=1.8)
    axis.set_ylabel("trace of $P_0$ (m² and m²/s²)")
    axis.set_ylim(bottom=0.0)
    _legend(figure, axes)


def _title(axis: Any, state: int, what: str) -> None:
    axis.set_title(f"({'ab'[state]}) {what}", loc="left")
    axis.set_ylabel(f"{STATES[state]} ({UNITS[state]})")


def _curves(axis: Any, data: Data, values: Array, width: float = 1.4, alpha: float = 1.0) -> None:
    """Draw a curve (H,) of each threshold, labelled if it is opaque."""
    time = np.arange(1, values.shape[1] + 1)
    for label, curve, (colour, line) in zip(data["labels"], values, _LINES, strict=True):
        shown = {"ls": line, "label": label} if alpha == 1.0 else {}
        axis.plot(time, curve, color=colour, lw=width, alpha=alpha, **shown)


PAPER = Paper(
    "markov_jump",
    (
        Piece("schedule", simulate_schedule, _summarise_schedule, 5.0, 2),
        Piece("tracking", simulate_tracking, _summarise_tracking, 20.0),
        Piece("theorems", simulate_theorems, _summarise_theorems, 60.0, 3000),
        Piece("others", simulate_others, _summarise_others, 30.0),
    ),
    {
        "figure_4": PaperFigure("tracking", _draw_errors, (7.2, 5.0)),
        "figure_5": PaperFigure("schedule", _draw_traces, (7.2, 3.9)),
    },
    {"m": (0.0, 0.9, 1.3, 1.5), "augmented": False, "reference": None},
    READINGS,
    claims,
)  # fmt: skip
