"""Joint input and state filters under an adaptive threshold: Figures 3, 4, 6 and the theorems.

Source: unknown_input, Section 4.
"""

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import fusion_gym
from agents.papers import unknown_input_recursion as recursion
from agents.papers.drawing import legend
from agents.papers.numbers import estimate, grid
from agents.papers.paper import Data, Paper, PaperFigure, Piece, Settings
from agents.papers.unknown_input_claims import claims
from agents.papers.walk import walk
from agents.papers.whitening import leading_sample, whitened_square
from fusion_gym.arrays import Array
from fusion_gym.core.task import Task
from fusion_gym.entries import Options
from fusion_gym.output import palette
from fusion_gym.policies.rules import AdaptiveThreshold
from fusion_gym.systems.unknown_input.environment import UnknownInputOptions
from fusion_gym.systems.unknown_input.nodes import TableNodes
from fusion_gym.systems.unknown_input.system import DrivenPlant, UnknownInputEstimator

PRINTED, CARTS = "paper", "two_carts"
NAMES = {PRINTED: "the printed example", CARTS: "two carts"}
TRIGGER = "adaptive_threshold"
OURS, FIXED = "paper's filter and trigger", "paper's filter, fixed threshold ρ̄"
WALK = "Kalman filter with a random-walk input, paper's trigger"
LANES: dict[str, tuple[str, Options]] = {
    OURS: (TRIGGER, {"filter": "paper"}),
    FIXED: (TRIGGER, {"filter": "paper"}),
    "paper's filter, always": ("always", {"filter": "paper"}),
    "exact filter, always": ("always", {"filter": "predict", "fusion": "exact_ci"}),
    WALK: (TRIGGER, {"filter": "random_walk"}),
    "Kalman filter with a random-walk input, always": ("always", {"filter": "random_walk"}),
}
_SMALL = 0.0002  # ρ̄ for which (1 + 1/ε) ρ̄ - V is negative
_STEPS: Options = {"input_signal": "steps", "input_amplitude": 150.0}
# The input that the text leaves open, of the printed example.
READINGS: dict[str, Options] = {
    "sinusoids of 0.1": {},
    "sinusoids of 150": {"input_amplitude": 150.0},
    "steps of 150 in 30 instants": _STEPS | {"input_period": 30.0},
    "steps of 150 in 100 instants": _STEPS | {"input_period": 100.0},
}
_FACTOR = {PRINTED: 1.0, CARTS: 0.2}  # ε = ξ, as in the library's examples


class Record(NamedTuple):
    """E episodes of H sampling instants, times first, episodes last.

    ``truth`` (H, s, E) of [x(k); d(k - 1)] · ``local`` (H, l, s, E) the nodes' estimates, ``fused``
    (H, s, E) · ``held`` (H, l, m, E) the last delivered measurements after the step · ``square``
    (H, l, E) |σ|² before it · ``granted`` (H, l, E).
    """

    truth: Array
    local: Array
    fused: Array
    held: Array
    square: Array
    granted: NDArray[np.bool_]

    @property
    def errors(self) -> Array:
        """Errors (H, l + 1, s, E), the fused estimate first."""
        every = np.concatenate((self.fused[:, None], self.local), axis=1)
        return self.truth[:, None] - every


def make_example(**options: Any) -> tuple[Task, DrivenPlant]:
    """Return the task of these options with its plant."""
    task = fusion_gym.make_task(UnknownInputOptions(**({"horizon": 100} | options)))
    plant = task.plant
    assert isinstance(plant, DrivenPlant)
    return task, plant


def record_run(task: Task, policy: str, episodes: int, seed: int) -> Record:
    """Run a policy and record the data of the figures."""
    rows = []
    for batch, requests in walk(task, policy, episodes, seed):
        apart = batch.state.estimate.measurement - batch.state.estimate.held
        outcome, estimate = batch.step(requests), batch.delivered.estimate
        truth, means = batch.delivered.plant.truth, estimate.estimates
        values = (truth, means.mean, means.fused_mean, estimate.held, (apart**2).sum(1))
        rows.append([np.array(value) for value in (*values, outcome.granted)])
    return Record(*map(np.array, zip(*rows, strict=True)))


def halves(value: Array, states: int, axis: int) -> Array:
    """Return sums over the states and over the inputs, stacked along ``axis``."""
    first, last = np.split(value, [states], axis=axis)
    return np.stack((first.sum(axis), last.sum(axis)), axis=axis)


def leading(errors: Array, bounds: Array) -> Array:
    """Return the ratio of errors (H, n, E) to bounds (n, n, H), (E,), in the worst direction.

    The bounds whiten the errors, so a bound allows 1; the direction has the largest errors over all
    times and episodes.
    """
    return leading_sample(whitened_square(errors, np.moveaxis(bounds, -1, 0)[..., None]).mean(0))


# --- the printed example beside two carts ---------------------------------------------------------


def simulate_filters(episodes: int, seed: int, settings: Settings) -> Data:
    """Return all data by example, ``mse`` (lanes, 2, E) and ``rates`` (lanes, l, E) by lane too."""
    return {
        f"{example}_{name}": value
        for example in NAMES
        for name, value in _example(example, episodes, seed, settings).items()
    }


def _example(example: str, episodes: int, seed: int, settings: Settings) -> Data:
    data: Data = {}
    mse, rates = [], []
    for name, (policy, options) in LANES.items():
        options = options | _options_of(example, settings) | {"example": example}
        if name == WALK and example == PRINTED:
            options["hold_variance"] = 0.05  # as the example's page does
            if size := options.get("input_amplitude"):
                options["input_change"], options["input_deviation"] = 0.2 * size, size
        task, plant = make_example(**options)
        rule = fusion_gym.make_policy(TRIGGER, task)
        assert isinstance(rule, AdaptiveThreshold)
        if name == FIXED:
            task, plant = make_example(**(options | {"rho_initial": rule.rho_bar}))
        record = record_run(task, policy, episodes, seed)
        mse.append(halves((record.errors[:, 0] ** 2).mean(0), plant.dynamics.size, 0))
        rates.append(record.granted.mean(0))
        if name == OURS:
            data |= _under_the_trigger(task, rule, record)
    return data | {"mse": np.array(mse), "rates": np.array(rates)}


def _options_of(example: str, settings: Settings) -> Options:
    """Return the options of an example; the carts keep their input."""
    return dict(settings["options"]) if example == PRINTED else {}


def _under_the_trigger(task: Task, rule: AdaptiveThreshold, record: Record) -> Data:
    """Return errors, bounds and thresholds.

    Estimates are the fused one, then the nodes'. ``square`` and ``bound`` (H, l + 1, s) are mean
    squared errors and bounds; ``each`` (l + 1, 2, E) squared errors and ``filled``
    (l + 1, 2, E) their ratio to the bounds, of states and inputs; ``power`` (2, E) the mean square
    of both, ``steady`` (2, E) the fused squared errors in the two halves of the episodes;
    ``within`` the share of silent steps with |σ|² at most ρ̄; ``rho_range`` the least step of the
    thresholds and their extremes over ρ₀ and ρ̄; ``settled`` (E,) the number of updates until every
    threshold is at 99 % of ρ̄.
    """
    estimator = task.estimator
    assert isinstance(estimator, UnknownInputEstimator)
    nodes = estimator.nodes
    assert isinstance(nodes, TableNodes)
    n, errors = nodes.model.size, record.errors
    bounds = np.concatenate((nodes.fused[None], nodes.tables.covariance))[..., 1:]
    blocks = (slice(None, n), slice(n, None))
    filled = [
        [leading(errors[:, place, block], bounds[place, block, block]) for block in blocks]
        for place in range(len(bounds))
    ]
    low, high = (rule.column(name, record.square.shape[1]) for name in ("rho_initial", "rho_bar"))
    levels = [np.broadcast_to(low, record.square.shape[1:])]  # ρ, at first of the first judgement
    for row in record.square:
        levels.append(rule.threshold_after(levels[-1], row))
    rho, silent = np.array(levels), ~record.granted
    steady = [(part[:, 0] ** 2).sum(1).mean(0) for part in np.array_split(errors, 2)]
    return {
        "square": (errors**2).mean(-1),
        "bound": np.moveaxis(np.diagonal(bounds, axis1=1, axis2=2), 1, 0),
        "each": halves((errors**2).mean(0), n, 1), "filled": np.array(filled),
        "power": halves((record.truth**2).mean(0), n, 0), "steady": np.array(steady),
        "within": 1.0 - float((record.square > high)[silent].sum()) / max(silent.sum(), 1),
        "rho_range": [np.diff(rho, axis=0).min(), (rho / low).min(), (rho / high).max()],
        "settled": (rho < 0.99 * high).sum(0).max(0).astype(float), "radius": nodes.tables.radius,
    }  # fmt: skip


def _summarise_filters(data: Data) -> Data:
    """The page's table, and the data of both examples by name, in :data:`NAMES`."""
    columns = ("rate in %", "MSE of the states", "MSE of the inputs")
    rows = {
        f"{name}, {lane}": (100.0 * data[f"{e}_rates"][i].mean(0), *data[f"{e}_mse"][i])
        for e, name in NAMES.items()
        for i, lane in enumerate(LANES)
    }
    names = [name.removeprefix(f"{PRINTED}_") for name in data if name.startswith(PRINTED)]
    both = {name: [data[f"{example}_{name}"] for example in NAMES] for name in names}
    return both | {
        "tables": {"settings": grid(columns, rows)}, "names": list(NAMES.values()),
        "filled": [np.max(estimate(own).high, -1) for own in both["filled"]],
        "slack": [(data[f"{e}_bound"] / data[f"{e}_square"])[:, 0].mean(0) for e in NAMES],
    }  # fmt: skip


# --- the printed recursion ------------------------------------------------------------------------


def simulate_printed(episodes: int, seed: int, settings: Settings) -> Data:
    """Return readings of the printed example, the gain (20) on the carts, Theorem 1 for a small ρ̄.

    ``node`` (readings, l, 2, E): mean squared errors of state and input; ``trace``
    (readings, l, E): the mean trace of (18); ``hidden`` (readings, l): the largest residual of
    (14); ``power`` (2, E): the mean squares of state and input. ``excess`` (examples, E) of (18)
    over its least, ``sent`` and ``silent`` (l, E) traces of Ξ_x on the printed example,
    ``negative``: the share of silent instants with an indefinite Ξ_x.
    """
    own, rows = _options_of(PRINTED, settings), []
    for reading in recursion.UNKNOWN_INPUT_READINGS.values():
        record, result = _recursion(PRINTED, episodes, seed, own, reading)
        square = (record.truth[:, None] - result["estimate"]) ** 2
        residual = result["hidden"].max((0, 2))
        rows.append((halves(square.mean(0), 2, 1), result["trace"].mean(0), residual))
    node, trace, hidden = map(np.array, zip(*rows, strict=True))
    data: Data = {"node": node, "trace": trace, "hidden": hidden}
    record, result = _recursion(PRINTED, episodes, seed, own, {})
    for name, where in (("silent", ~record.granted), ("sent", record.granted)):
        data[name] = (where * result["trace"]).sum(0) / np.maximum(where.sum(0), 1)
    carts = _recursion(CARTS, episodes, seed, {}, {})[1]
    low = own | {"rho_bar": _SMALL, "rho_initial": _SMALL}
    low_record, low_result = _recursion(PRINTED, episodes, seed, low, {})
    silent = ~low_record.granted
    negative = float((low_result["least"][silent] < 0.0).sum()) / max(int(silent.sum()), 1)
    plants = (make_example(example=PRINTED, sampling_period=a)[1] for a in (2, 1))
    return data | recursion.decoupling(*plants) | {
        "readings": list(recursion.UNKNOWN_INPUT_READINGS), "negative": negative, "small": _SMALL,
        "power": halves((record.truth**2).mean(0), 2, 0),
        "excess": np.array([each["excess"].mean(0).mean(0) for each in (result, carts)]),
    }  # fmt: skip


def _recursion(
    example: str, episodes: int, seed: int, options: Options, reading: Options
) -> tuple[Record, dict[str, Array]]:
    """Return a run, and the printed filter of each node on the trigger's deliveries."""
    options = {"example": example, "filter": "paper"} | options | reading.get("options", {})
    task, plant = make_example(**options)
    rho_bar = float(np.max(task.policy_defaults[TRIGGER]["rho_bar"]))
    record = record_run(task, reading.get("policy", TRIGGER), episodes, seed)
    cutoff = reading.get("cutoff", recursion.EXACT_CUTOFF)
    results = [
        recursion.run(model, record.held[:, i], record.granted[:, i], cutoff)
        for i, model in enumerate(recursion.models(plant, _FACTOR[example], rho_bar))
    ]
    return record, {name: np.stack([own[name] for own in results], 1) for name in results[0]}


def _summarise_printed(data: Data) -> Data:
    node, power = data["node"], data["power"].mean(-1)
    columns = [f"node {i + 1}, {kind}" for kind in ("states", "inputs") for i in range(2)]
    samples = node.swapaxes(1, 2).reshape(len(node), len(columns), -1)
    return {
        "tables": {"readings": grid(columns, dict(zip(data["readings"], samples, strict=True)))},
        "power": power, "floor": np.sqrt(data["floor"]), "share": node.mean(-1) / power,
    }  # fmt: skip


# --- figures --------------------------------------------------------------------------------------

# Entries of [x; d] that stand for the paper's, and their label.
_FIGURES = {
    "figure_3": {PRINTED: ([0], "$x^1$"), CARTS: ([0], "cart 1 (m²)")},
    "figure_4": {PRINTED: ([1], "$x^2$"), CARTS: ([2], "cart 2 (m²)")},
    "figure_6": {PRINTED: ([2, 3], "inputs"), CARTS: ([4], "force (N²)")},
}


def _draw_bounds(figure: Any, data: Data, entries: dict[str, tuple[list[int], str]]) -> None:
    """Draw bounds solid, mean squared errors dotted, summed over the entries."""
    axes = figure.subplots(1, 2)
    for axis, (example, (places, label)) in zip(axes, entries.items(), strict=True):
        bound, square = (data[f"{example}_{n}"][..., places].sum(-1) for n in ("bound", "square"))
        time = np.arange(1, len(bound) + 1)
        for place in range(bound.shape[1]):
            colour, width = (palette.SENSORS[place - 1], 1.3) if place else (palette.FUSED, 2.2)
            name = f"node {place}" if place else "fused"
            axis.plot(time, bound[:, place], color=colour, lw=width, label=name)
            axis.plot(time, square[:, place], ":", color=colour, lw=width)
        axis.set(yscale="log", xlabel="sampling instant k", xlim=(0, len(time)))
        axis.set_ylabel(f"squared error, {label}")
        axis.set_title(NAMES[example].removeprefix("the "), loc="left")
    axes[-1].plot([], [], "-", color=palette.INK, label="upper bound")
    axes[-1].plot([], [], ":", color=palette.INK, label="MSE")
    legend(figure, axes, 7, fontsize=9, columnspacing=1.0)


PAPER = Paper(
    "unknown_input",
    (
        Piece("filters", simulate_filters, _summarise_filters, 20.0),
        Piece("printed", simulate_printed, _summarise_printed, 60.0, 500),
    ),
    {
        name: PaperFigure("filters", partial(_draw_bounds, entries=entries), (7.6, 3.6))
        for name, entries in _FIGURES.items()
    },
    readings=READINGS,
    claims=claims,
)
