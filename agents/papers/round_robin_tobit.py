"""Federated Tobit Kalman filtering under the round-robin protocol: error curves, both tables.

Source: round_robin_tobit, Section IV.
"""

from collections.abc import Mapping, Sequence
from functools import cache, partial
from itertools import pairwise
from typing import Any

import numpy as np

import fusion_gym
from agents.papers import round_robin_tobit_runs as runs
from agents.papers import round_robin_tobit_theorems as theorems
from agents.papers.drawing import legend, stack
from agents.papers.numbers import Number, number_text
from agents.papers.paper import Data, Paper, PaperFigure, Piece, PieceData, Settings
from agents.papers.round_robin_tobit_claims import claims
from agents.papers.walk import SomeSensors
from fusion_gym.arrays import Array
from fusion_gym.core.task import Task
from fusion_gym.docstrings import table
from fusion_gym.entries import Options, Plain
from fusion_gym.evaluation.metrics import mean_interval
from fusion_gym.output import palette
from fusion_gym.policies.registry import make_policy

# Tables II and III of the paper: ARMSE1, ARMSE2, ARMSE3 by interval and by variance.
TABLE_II = {
    5.0: (0.2329, 0.4768, 0.2515),
    1.0: (4.4252, 4.1257, 3.6580),
    0.5: (7.1406, 6.7888, 5.7826),
}
TABLE_III = {
    0.6: (0.2329, 0.4768, 0.2515),
    0.1: (0.0948, 0.3707, 0.2082),
    0.06: (0.0742, 0.2924, 0.1601),
}
_BOTH: dict[str, Options] = {"aware": {}, "unaware": {"bias_aware": False}}
_FILTERS = {"paper": "the paper's filter", "adf": "assumed-density filter"}
_ARMSE = tuple(f"ARMSE{state + 1}" for state in range(runs.STATES))


def _options(interval: float, variance: float) -> Options:
    return {
        "censoring_threshold": -interval, "censoring_upper": interval,
        "measurement_variance": variance,
    }  # fmt: skip


def _oscillator(settings: Settings, **options: Any) -> Task:
    """The oscillator with the first interval and the first variance."""
    own = _options(settings["interval"][0], settings["variance"][0])
    return fusion_gym.make_task(runs.OSCILLATOR, **(own | settings["options"] | options))


# --- the bias in the filter, or ignored by it -----------------------------------------------------


def simulate_oscillator(episodes: int, seed: int, settings: Settings) -> Data:
    """Return the RMSE of both filters."""
    tasks = {name: _oscillator(settings, **options) for name, options in _BOTH.items()}
    own = {"measurement_variance": settings["variance"][0]} | settings["options"]
    return _curves(tasks, episodes, seed, settings) | {"floor": runs.floor(runs.OSCILLATOR, **own)}


def simulate_target(episodes: int, seed: int, settings: Settings) -> Data:
    """Return the RMSE of both filters."""
    env, options = runs.TRACKING, settings["options"]
    tasks = {name: fusion_gym.make_task(env, **own, **options) for name, own in _BOTH.items()}
    return _curves(tasks, episodes, seed, settings) | {"floor": runs.floor(env, **options)}


def _curves(tasks: dict[str, Task], episodes: int, seed: int, settings: Settings) -> Data:
    errors = {
        name: runs.squares(task, settings["policy"], episodes, seed) for name, task in tasks.items()
    }
    aware = tasks["aware"]
    never = runs.squares(aware, "never", episodes, seed)
    return {
        **{f"{name}_rmse": runs.error_curve(error) for name, error in errors.items()},
        **{f"{name}_armse": runs.armse(error) for name, error in errors.items()},
        "difference": runs.paired_increase(errors["aware"], errors["unaware"]),
        "silent": runs.armse(never)["mean"],
        "bias_deviation": float(np.sqrt(aware.settings["bias_noise_covariance"])[0, 0]),
    }  # fmt: skip


def _summarise_curves(
    data: Data, name: str, states: Sequence[str], units: Sequence[str] = ("", "", "")
) -> Data:
    filters = {"aware": "FTKF-DB", "unaware": "FTKF (bias ignored)"}
    numbers = [
        runs.armse_number(f"ARMSE of {state}, {label}", data[f"{key}_armse"], i, unit=units[i])
        for key, label in filters.items()
        for i, state in enumerate(states)
        if key == "aware" or i < 2
    ]
    return {"tables": {name: numbers}}


# --- local filters and the fused one --------------------------------------------------------------


def simulate_nodes(episodes: int, seed: int, settings: Settings) -> Data:
    """Return errors of local filters: of a single sensor, and as nodes of the fused estimate."""
    task = _oscillator(settings)
    policy = make_policy(settings["policy"], task)
    fused, local = runs.node_squares(task, policy, episodes, seed)
    data: Data = {"fused_rmse": runs.error_curve(fused), "fused_armse": runs.armse(fused)}
    for sensor in range(2):
        errors = runs.squares(task, SomeSensors(policy, {sensor}), episodes, seed)
        data[f"single_{sensor}_rmse"] = runs.error_curve(errors)
        for name, other in (("single", errors), ("node", local[:, :, sensor])):
            data[f"{name}_{sensor}_armse"] = runs.armse(other)
            data[f"{name}_{sensor}_difference"] = runs.paired_increase(fused, other)
            data[f"{name}_{sensor}_increase"] = runs.increase(fused, other)
    return data


def _summarise_nodes(data: Data) -> Data:
    names = {
        "fused": "FTKF-DB", **{f"single_{i}": f"LTKF-DB-S{i + 1}, single" for i in range(2)},
        **{f"node_{i}": f"LTKF-DB-S{i + 1} as a node" for i in range(2)},
    }  # fmt: skip
    numbers = [
        runs.armse_number(f"{label}: {column}", data[f"{key}_armse"], state)
        for key, label in names.items()
        for state, column in enumerate(_ARMSE)
    ]
    return {"tables": {"nodes": numbers}}


# --- censoring intervals and noise variances ------------------------------------------------------


def simulate_tables(episodes: int, seed: int, settings: Settings) -> Data:
    """Return the rows of both tables, by the paper's filter and by the assumed-density filter.

    Both begin with the first interval and the first variance.
    """
    intervals, variances = settings["interval"], settings["variance"]
    pairs = {
        "table_2": [(interval, variances[0]) for interval in intervals],
        "table_3": [(intervals[0], variance) for variance in variances],
    }

    @cache
    def errors(pair: tuple[float, float]) -> dict[str, Array]:
        tasks = {name: _oscillator(settings, filter=name, **_options(*pair)) for name in _FILTERS}
        policy = settings["policy"]
        return {name: runs.squares(task, policy, episodes, seed) for name, task in tasks.items()}

    @cache
    def row(before: tuple[float, float], pair: tuple[float, float]) -> Data:
        own = {"measurement_variance": pair[1]} | settings["options"]
        floors = {
            "floor": runs.floor(runs.OSCILLATOR, **own),
            "floor_all": runs.floor(runs.OSCILLATOR, access="any", **own),
        }
        return {"interval": pair[0], "variance": pair[1]} | floors | {
            name: runs.armse(result) | _median(result)
            | {"rise": _rise(errors(before)[name], result)}
            for name, result in errors(pair).items()
        }  # fmt: skip

    data: Data = {
        name: [row(*each) for each in pairwise([own[0], *own])] for name, own in pairs.items()
    }
    never = runs.squares(_oscillator(settings), "never", episodes, seed)
    return data | {"silent": runs.armse(never)}


def _median(values: Array) -> dict[str, list[float]]:
    """Median over runs of a run's RMSE of x1, with its interval."""
    middle, drawn = runs.medians(values)
    return {"median": [middle, *np.quantile(drawn, [0.025, 0.975]).tolist()]}


def _rise(before: Array, after: Array) -> Plain:
    """Return the paired intervals of ARMSE1, 2, 3 and the median from one row to the next."""
    result = runs.increase(before, after)
    middle = np.quantile(runs.medians(after)[1] - runs.medians(before)[1], [0.025, 0.975])
    return {end: [*result[end], float(middle[i])] for i, end in enumerate(("low", "high"))}


def _summarise_tables(data: Data) -> Data:
    """The page's tables, and how many printed values lie below every filter's bound, or beyond."""
    second, third = data["table_2"], data["table_3"]
    intervals = [f"[{-row['interval']:g}, {row['interval']:g}]" for row in second]
    variances = [f"R = {row['variance']:g}" for row in third]
    numbers = {
        name: [
            runs.armse_number(f"{label}, {column}", row["paper"], i, values[i])
            for label, row, values in zip(labels, data[name], printed.values(), strict=True)
            for i, column in enumerate(_ARMSE)
        ]
        for name, labels, printed in (
            ("table_2", intervals, TABLE_II), ("table_3", variances, TABLE_III),
        )
    }  # fmt: skip
    labels = [f"{intervals[0]}, {variances[0]}", *intervals[1:], *variances[1:]]
    rows, others = [*second, *third[1:]], []
    for label, row in zip(labels, rows, strict=True):
        others += [runs.armse_number(f"{label}: {c}", row["adf"], i) for i, c in enumerate(_ARMSE)]
        others += [
            Number(f"{label}: median run, {_FILTERS[name]}", *row[name]["median"])
            for name in ("adf", "paper")
        ]
    printed = np.array([*TABLE_II.values(), *TABLE_III.values()])[[0, 1, 2, 4, 5]]
    # An RMSE of so many runs of a Gaussian error has this relative deviation at each time, and its
    # mean over time no larger one.
    chance = 1.0 - 4.0 / np.sqrt(2.0 * runs.PAPER_RUNS)
    return {
        "tables": numbers | {"others": others},
        **{
            f"below_{name}": (printed < chance * np.array([row[name] for row in rows])).sum()
            for name in ("floor", "floor_all")
        },
        "beyond": (printed[1:3] > data["silent"]["high"]).sum(),
    }


# --- what was tried to reach the printed values ---------------------------------------------------


def simulate_tobit_readings(episodes: int, seed: int, settings: Settings) -> Data:
    """Return ARMSE of every reading at the widest and the narrowest interval."""
    data: Data = {}
    for reading in runs.ROUND_ROBIN_READINGS:
        for limit in (5.0, 0.5):
            task = runs.reading_task(reading, censoring_threshold=-limit, censoring_upper=limit)
            name = "always" if task.options.access == "any" else "round_robin"
            errors = runs.squares(task, name, episodes, seed)
            roots = np.sqrt(errors.mean((1, 2)))
            far = mean_interval((roots > 10.0).astype(float))
            data[f"{reading} {limit:g}"] = runs.armse(errors) | {"far": list(far)}
    return data


def _tables_by_reading(every: Mapping[str, Mapping[str, PieceData]]) -> dict[str, str]:
    """Return the least errors, the readings at both intervals, and which is the closest."""
    own, texts, off = next(iter(every.values())), dict[str, str](), dict[str, float]()
    for limit, name in ((5.0, "wide"), (0.5, "narrow")):
        printed = f"**printed, [{-limit:g}, {limit:g}]**"
        rows = [(printed, *(f"{value:.4f}" for value in TABLE_II[limit]), "")]
        for reading in runs.ROUND_ROBIN_READINGS:
            item = own["readings"][f"{reading} {limit:g}"]
            factors = np.divide(item["mean"], TABLE_II[limit])
            off[reading] = max(off.get(reading, 1.0), *factors, *(1.0 / factors))
            ends = zip(item["mean"], item["low"], item["high"], strict=True)
            cells = (f"{mean:.3g} [{low:.3g}, {high:.3g}]" for mean, low, high in ends)
            rows.append((reading, *cells, f"{100 * item['far'][0]:.1f} %"))
        texts[name] = table(("reading", *_ARMSE, "runs far off"), rows)
    least = []
    for values, row in zip(TABLE_III.values(), own["tables"].table_3, strict=True):
        errors = (number_text(row[name], ".4f") for name in ("floor", "floor_all"))
        least.append((f"R = {row['variance']:g}", number_text(values, "g"), *errors))
    heads = "[-5, 5]", "printed ARMSE1, 2, 3", "least, round robin", "least, both sensors"
    best = min(off, key=off.__getitem__)
    return texts | {"least": table(heads, least), "best": best, "factor": f"{off[best]:.2g}"}


# --- figures --------------------------------------------------------------------------------------

_THIN, _WIDE = 1.3, 2.0
# Name, colour, dashes and width of each filter's curves.
_STYLES: dict[str, tuple[str, str, str, float]] = {
    "unaware": ("FTKF (bias ignored)", palette.PURPLE, "--", _WIDE),
    "aware": ("FTKF-DB (fused)", palette.FUSED, "-", _WIDE),
    "fused": ("FTKF-DB (fused)", palette.FUSED, "-", _WIDE),
    **{f"single_{i}": (f"LTKF-DB-S{i + 1}", palette.SENSORS[i], "-", _THIN) for i in range(2)},
}


def _draw_curves(
    figure: Any, data: Data, panels: Sequence[tuple[str, int]], names: Sequence[str], step: str
) -> None:
    """Draw panels in a column over a common time, each with its axis label and a state."""
    axes = stack(figure, len(panels), step)
    for axis, (label, state) in zip(axes, panels, strict=True):
        for name in names:
            line, colour, style, width = _STYLES[name]
            mean, *ends = data[f"{name}_rmse"][..., state]
            time = np.arange(1, len(mean) + 1)
            axis.plot(time, mean, color=colour, linestyle=style, linewidth=width, label=line)
            axis.fill_between(time, *ends, color=colour, alpha=0.18, linewidth=0)
        if names == ("aware",):
            least: Plain = {"color": palette.CENTRAL, "linestyle": ":", "linewidth": _WIDE}
            axis.axhline(data["bias_deviation"], label="√Ξ: no filter lies below", **least)
        axis.set_ylabel(label)
        axis.margins(x=0.01)
        axis.set_ylim(bottom=0.0)
    legend(figure, axes, 4, "lower")


def _curves_of(piece: str, panels: Sequence[tuple[str, int]], *names: str) -> PaperFigure:
    step = f"time step k{' (0.1 s each)' * (piece == 'target')}"
    draw = partial(_draw_curves, panels=panels, names=names, step=step)
    return PaperFigure(piece, draw, (7.2, 2.0 + 1.4 * len(panels)))


_summarise_oscillator = partial(_summarise_curves, name="oscillator", states=("x1", "x2", "b"))
_summarise_target = partial(
    _summarise_curves, name="target", states=("position", "velocity", "acceleration"),
    units=("m", "m/s", "m/s²"),
)  # fmt: skip
_RMSES = (("RMSE1 (of x1)", 0), ("RMSE2 (of x2)", 1), ("RMSE3 (of b)", 2))
PAPER = Paper(
    "round_robin_tobit",
    (
        Piece("oscillator", simulate_oscillator, _summarise_oscillator, 12.0, 2000),
        Piece("nodes", simulate_nodes, _summarise_nodes, 12.0, 2000),
        Piece("tables", simulate_tables, _summarise_tables, 30.0, 2000),
        Piece("readings", simulate_tobit_readings, dict, 30.0),
        Piece("target", simulate_target, _summarise_target, 5.0),
        Piece("theory", theorems.simulate_theory, theorems.summarise_theory, 20.0),
        Piece("bounds", theorems.simulate_bounds, theorems.summarise_bounds, 30.0, 100),
    ),
    {
        "figure_5": _curves_of("oscillator", _RMSES[:2], "unaware", "aware"),
        "figure_6": _curves_of("oscillator", _RMSES[2:], "aware"),
        "figure_7": _curves_of("nodes", _RMSES[:2], "single_0", "single_1", "fused"),
        "figure_9": _curves_of("nodes", _RMSES[2:], "single_0", "single_1", "fused"),
        "figure_10": _curves_of(
            "target", (("position RMSE (m)", 0), ("velocity RMSE (m/s)", 1)), "unaware", "aware"
        ),
        "figure_11": _curves_of("target", (("acceleration RMSE (m/s²)", 2),), "aware"),
    },
    {"interval": tuple(TABLE_II), "variance": tuple(TABLE_III), "policy": "periodic:period=2"},
    claims=claims,
    texts=_tables_by_reading,
)  # fmt: skip
