"""Federated Tobit Kalman filtering under the round-robin protocol: Figures 2 to 11, both tables.

Source: round_robin_tobit, Section IV.
"""

import functools
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

import fusion_gym
from agents.papers import round_robin_tobit_runs as runs
from agents.papers import round_robin_tobit_theorems as theorems
from agents.papers.drawing import legend, stack
from agents.papers.numbers import Number, above_zero
from agents.papers.paper import Data, Paper, PaperFigure, Piece, Settings
from agents.papers.walk import SomeSensors
from fusion_gym.arrays import Array
from fusion_gym.core.task import Task
from fusion_gym.entries import Options, Plain
from fusion_gym.evaluation.episodes import record_episode
from fusion_gym.evaluation.metrics import Interval, mean_interval
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
_LOCAL = ("single", "node")
_ENDS = ("mean", "low", "high")


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
    """Return one run, the estimators' values by (4), and the RMSE of both filters."""
    tasks = {name: _oscillator(settings, **options) for name, options in _BOTH.items()}
    result = _curves(tasks, episodes, seed, settings)
    for name, task in tasks.items():
        run = record_episode(task, make_policy(settings["policy"], task), seed)
        result |= {"truth": run.truth, f"{name}_mean": run.mean}
    for name, options in (("whole", runs.FREE), ("clipped", {})):
        task = _oscillator(settings, **options)
        result[f"held_{name}"] = runs.held_values(task, settings["policy"], seed)
    variance = {"measurement_variance": settings["variance"][0]}
    least = runs.floor(runs.OSCILLATOR, **(variance | settings["options"]))
    return result | {"interval": settings["interval"][0], "floor": least}


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
        "silent": runs.armse(never)["mean"], "bias_deviation": _bias_deviation(aware),
    }  # fmt: skip


def _bias_deviation(task: Task) -> float:
    return float(np.sqrt(np.asarray(task.settings["bias_noise_covariance"])[0, 0]))


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
    return {
        "tables": {name: numbers}, "lower": runs.always_below(data["difference"][..., :2]),
        **{key: np.array(data[f"{key}_armse"]["mean"]) for key in filters},
    }  # fmt: skip


# --- local filters and the fused one --------------------------------------------------------------


def simulate_nodes(episodes: int, seed: int, settings: Settings) -> Data:
    """Return errors of local filters: of a single sensor, and as nodes of the fused estimate."""
    task = _oscillator(settings)
    policy = make_policy(settings["policy"], task)
    fused, local = runs.node_squares(task, policy, episodes, seed)
    run = record_episode(task, policy, seed)
    data: Data = {
        "truth": run.truth, "fused_mean": run.mean, "fused_rmse": runs.error_curve(fused),
        "fused_armse": runs.armse(fused),
    }  # fmt: skip
    for sensor in range(2):
        single = SomeSensors(policy, {sensor})
        errors = runs.squares(task, single, episodes, seed)
        data[f"single_{sensor}_mean"] = record_episode(task, single, seed).mean
        data[f"node_{sensor}_mean"] = run.local_mean[:, sensor]
        for name, other in (("single", errors), ("node", local[:, :, sensor])):
            data[f"{name}_{sensor}_rmse"] = runs.error_curve(other)
            data[f"{name}_{sensor}_armse"] = runs.armse(other)
            data[f"{name}_{sensor}_difference"] = runs.paired_increase(fused, other)
            data[f"{name}_{sensor}_increase"] = runs.increase(fused, other)
    return data


def _summarise_nodes(data: Data) -> Data:
    names = {
        "fused": "FTKF-DB", **{f"single_{i}": f"LTKF-DB-S{i + 1}, single" for i in range(2)},
        **{f"node_{i}": f"LTKF-DB-S{i + 1} as a node" for i in range(2)},
    }  # fmt: skip
    columns = [f"ARMSE{state + 1}" for state in range(3)]
    claims = {}
    for what, states in (("states", slice(2)), ("bias", slice(2, 3))):
        for name in _LOCAL:
            rises, often = [], []
            for sensor in range(2):
                ends = (data[f"{name}_{sensor}_increase"][end][states] for end in _ENDS)
                rises.append(list(map(Interval, *ends)))
                often.append(runs.always_below(data[f"{name}_{sensor}_difference"][..., states]))
            higher = [above_zero(item.low, item.high) for rise in rises for item in rise]
            claims[f"{what}_{name}"] = {"higher": higher, "rises": rises, "often": often}
    return {
        "columns": columns,
        "tables": {
            "nodes": [
                runs.armse_number(f"{label}: {column}", data[f"{key}_armse"], state)
                for key, label in names.items()
                for state, column in enumerate(columns)
            ]
        },
        "claims": claims,
        "means": {
            name: [data[f"{key}_armse"]["mean"] for key in (f"{name}_0", f"{name}_1", "fused")]
            for name in _LOCAL
        },
    }


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

    @functools.cache
    def errors(pair: tuple[float, float]) -> dict[str, Array]:
        tasks = {name: _oscillator(settings, filter=name, **_options(*pair)) for name in _FILTERS}
        policy = settings["policy"]
        return {name: runs.squares(task, policy, episodes, seed) for name, task in tasks.items()}

    @functools.cache
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
    task = _oscillator(settings)
    never = runs.squares(task, "never", episodes, seed)
    return data | {"silent": runs.armse(never), "bias_deviation": _bias_deviation(task)}


def _median(values: Array) -> dict[str, list[float]]:
    """Median over runs of a run's RMSE of x1, with its interval."""
    middle, drawn = runs.medians(values)
    return {"median": [middle, *np.quantile(drawn, [0.025, 0.975]).tolist()]}


def _rise(before: Array, after: Array) -> Plain:
    """Return the paired intervals of ARMSE1, 2, 3 and the median from one row to the next."""
    result = runs.increase(before, after)
    middle = np.quantile(runs.medians(after)[1] - runs.medians(before)[1], [0.025, 0.975])
    return {end: [*result[end], float(middle[i])] for i, end in enumerate(("low", "high"))}


def _interval_names(rows: list[Data]) -> list[str]:
    return [f"[{-row['interval']:g}, {row['interval']:g}]" for row in rows]


def _summarise_tables(data: Data) -> Data:
    second, third = data["table_2"], data["table_3"]
    interval_names = _interval_names(second)
    variance_names = [f"R = {row['variance']:g}" for row in third]
    printed = {"table_2": list(TABLE_II.values()), "table_3": list(TABLE_III.values())}
    numbers = {
        name: [
            runs.armse_number(f"{label}, ARMSE{i + 1}", row["paper"], i, value)
            for label, row, values in zip(labels, data[name], printed[name], strict=True)
            for i, value in enumerate(values)
        ]
        for name, labels in (("table_2", interval_names), ("table_3", variance_names))
    }
    others = {f"{interval_names[0]}, {variance_names[0]}": second[0]}
    others |= dict(zip(interval_names[1:], second[1:], strict=True))
    others |= dict(zip(variance_names[1:], third[1:], strict=True))
    heads = (
        *(f"ARMSE{i + 1}" for i in range(3)),
        *(f"median run, {_FILTERS[name]}" for name in ("adf", "paper")),
    )
    references = []
    for label, row in others.items():
        references += [runs.armse_number(f"{label}: {heads[i]}", row["adf"], i) for i in range(3)]
        for name, head in zip(("adf", "paper"), heads[3:], strict=True):
            references.append(Number(f"{label}: {head}", *row[name]["median"]))
    return {
        "tables": numbers | {"others": references}, "heads": heads,
        "printed_rows": list(zip(variance_names, TABLE_III.values(), third, strict=True)),
        **_broken(data, printed), "narrow": _moves(second, 1),
        "noise": _moves(third, -1),
    }  # fmt: skip


def _broken(data: Data, printed: Plain) -> Data:
    """Return how many printed values lie below every filter's bound."""
    entries = [
        (value, row["floor"][i], row["floor_all"][i])
        for name, start in (("table_2", 0), ("table_3", 1))
        for row, values in list(zip(data[name], printed[name], strict=True))[start:]
        for i, value in enumerate(values)
    ]
    # An RMSE of so many runs of a Gaussian error has this relative deviation at each time, and its
    # mean over time no larger one.
    chance = 1.0 - 4.0 / np.sqrt(2.0 * runs.PAPER_RUNS)
    return {
        "papers_runs": runs.PAPER_RUNS, "entries": len(entries),
        "below": sum(value < chance * least for value, least, _ in entries),
        "below_all": sum(value < chance * least for value, _, least in entries),
        "printed_bias": [values[2] for values in TABLE_III.values()],
        "beyond": sum(
            value > data["silent"]["high"][i]
            for values in printed["table_2"][1:]
            for i, value in enumerate(values)
        ),
    }  # fmt: skip


def _moves(rows: list[Data], sign: int) -> Data:
    """Return which errors change from row to row as claimed: ARMSE and the median."""
    moved = {}
    for name in _FILTERS:
        rises = ([row[name]["rise"][end] for row in rows[1:]] for end in ("low", "high")[::sign])
        moved[name] = above_zero(*((sign * np.array(rise)).min(0) for rise in rises))
    return {
        "moved": moved, "chain": [row["paper"]["mean"] for row in rows],
        "medians": [row["paper"]["median"][0] for row in rows],
    }  # fmt: skip


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


def _summarise_tobit_readings(data: Data) -> Data:
    limits = {
        limit: {reading: data[f"{reading} {limit:g}"] for reading in runs.ROUND_ROBIN_READINGS}
        for limit in (5.0, 0.5)
    }
    off = dict.fromkeys(runs.ROUND_ROBIN_READINGS, 1.0)
    for limit, readings in limits.items():
        for reading, result in readings.items():
            factors = np.array(result["mean"]) / np.array(TABLE_II[limit])
            off[reading] = max(off[reading], *factors, *(1.0 / factors))
    best = min(off, key=off.__getitem__)
    return {"limits": limits, "printed": TABLE_II, "best": best, "off": off[best]}


# --- figures --------------------------------------------------------------------------------------

_STEP, _TARGET_STEP = "time step k", "time step k (0.1 s each)"
_THIN, _WIDE = 1.3, 2.0


# Name, colour, dashes and width of each filter's curves, and of what they stand beside.
_STYLES: dict[str, tuple[str, str, str, float]] = {
    "unaware": ("FTKF (bias ignored)", palette.PURPLE, "--", _WIDE),
    "aware": ("FTKF-DB (fused)", palette.FUSED, "-", _WIDE),
    "fused": ("FTKF-DB (fused)", palette.FUSED, "-", _WIDE),
    "truth": ("true", palette.TRUTH, "-", _THIN),
    "least": ("√Ξ: no filter lies below", palette.CENTRAL, ":", _WIDE),
    **{
        f"{name}_{i}": (f"LTKF-DB-S{i + 1}", palette.SENSORS[i], "-", _THIN)
        for name in _LOCAL
        for i in range(2)
    },
}


def _curve(data: Data, kind: str, name: str, state: int) -> Array:
    """Return a curve (1, H), or (3, H) with the ends of its interval."""
    if name == "least":
        return np.full((1, data["aware_rmse"].shape[1]), data["bias_deviation"])
    values: Array = np.atleast_2d(data[name if name == "truth" else f"{name}_{kind}"][..., state])
    return values[:1] if name.startswith("node") else values  # their bands are those of the fused


def _draw_curves(
    figure: Any,
    data: Data,
    kind: str,
    panels: Sequence[tuple[str, int]],
    names: Sequence[str],
    step: str = _STEP,
) -> None:
    """Draw panels in a column over a common time, each with its axis label and a state."""
    axes = stack(figure, len(panels), step)
    for axis, (label, state) in zip(axes, panels, strict=True):
        for name in names:
            line, colour, style, width = _STYLES[name]
            curve = _curve(data, kind, name, state)
            time = np.arange(1, curve.shape[1] + 1)
            axis.plot(time, curve[0], color=colour, linestyle=style, linewidth=width, label=line)
            if len(curve) > 1:
                axis.fill_between(time, *curve[1:], color=colour, alpha=0.18, linewidth=0)
        axis.set_ylabel(label)
        axis.margins(x=0.01)
        if kind == "rmse":
            axis.set_ylim(bottom=0.0)
    legend(figure, axes, 4, "lower")


def _draw_measurements(figure: Any, data: Data) -> None:
    whole, clipped, limit = data["held_whole"], data["held_clipped"], data["interval"]
    axes = stack(figure, whole.shape[1], _STEP)
    steps = np.arange(1, len(whole) + 1)
    for number, axis in enumerate(axes):
        for values, colour, width, label in (
            (whole, palette.BLACK, _THIN, "uncensored"),
            (clipped, palette.SENSORS[number], _WIDE, f"censored, sensor {number + 1}"),
        ):
            axis.step(
                steps, values[:, number], where="post", color=colour, linewidth=width, label=label
            )
        for side in (-limit, limit):
            axis.axhline(side, color=palette.INK, linewidth=0.8, linestyle="--")
        axis.set_ylabel(f"measurement\nof x{number + 1} (sensor {number + 1})")
        axis.margins(x=0.01)
    legend(figure, axes, 4, "lower")


def _draw_table(figure: Any, data: Data, name: str) -> None:
    """Draw printed values, ours, and the lower bound of every filter."""
    rows, places = data[name], np.arange(len(data[name]))
    printed = {(5.0, v): values for v, values in TABLE_III.items()} | {
        (limit, 0.6): values for limit, values in TABLE_II.items()
    }
    printed_rows = [printed.get((r["interval"], r["variance"]), (np.nan,) * 3) for r in rows]
    ticks, label = [f"{row['variance']:g}" for row in rows], "variance R of the sensors' noise"
    if name == "table_2":
        ticks, label = _interval_names(rows), "uncensored interval"
    axes = figure.subplots(1, 3)
    axes[1].set_xlabel(label)
    marks: Plain = {"markersize": 8, "markeredgewidth": 2, "capsize": 3}
    for state, axis in enumerate(axes):
        values = [row[state] for row in printed_rows]
        axis.errorbar(places - 0.18, values, fmt="x", color=palette.INK, label="printed", **marks)
        for (key, label), shift, colour, marker in zip(
            _FILTERS.items(), (0.0, 0.18), (palette.FUSED, palette.BLUE), "os", strict=True
        ):
            mean, low, high = np.array([[row[key][e][state] for e in _ENDS] for row in rows]).T
            axis.errorbar(
                places + shift, mean, [mean - low, high - mean], fmt=marker, color=colour,
                label=label, **marks,
            )  # fmt: skip
        axis.bar(
            places, [row["floor"][state] for row in rows], width=0.8, color=palette.GREY,
            label="no filter lies in here", zorder=0,
        )  # fmt: skip
        axis.set_xticks(places, ticks)
        axis.set_title(f"ARMSE{state + 1} (of {('x1', 'x2', 'b')[state]})")
        axis.set_ylim(bottom=0.0)
        axis.set_xlim(-0.6, len(rows) - 0.4)
    legend(figure, axes, 4, "lower")


def _curves_of(
    piece: str, kind: str, height: float, panels: Sequence[tuple[str, int]], *names: str
) -> PaperFigure:
    step = _TARGET_STEP if piece == "target" else _STEP
    draw = partial(_draw_curves, kind=kind, panels=panels, names=names, step=step)
    return PaperFigure(piece, draw, (7.2, height))


def _table(name: str) -> PaperFigure:
    draw = partial(_draw_table, name=name)
    return PaperFigure("tables", draw, (7.2, 3.8))


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
        Piece("readings", simulate_tobit_readings, _summarise_tobit_readings, 30.0),
        Piece("target", simulate_target, _summarise_target, 5.0),
        Piece("theory", theorems.simulate_theory, theorems.summarise_theory, 20.0),
        Piece("bounds", theorems.simulate_bounds, theorems.summarise_bounds, 30.0, 100),
    ),
    {
        "figure_2": PaperFigure("oscillator", _draw_measurements, (7.2, 4.6)),
        "figure_3": _curves_of(
            "oscillator", "mean", 4.8, (("x1", 0), ("x2", 1)), "unaware", "aware", "truth"
        ),
        "figure_4": _curves_of("oscillator", "mean", 3.4, (("bias b", 2),), "aware", "truth"),
        "figure_5": _curves_of("oscillator", "rmse", 4.8, _RMSES[:2], "unaware", "aware"),
        "figure_6": _curves_of("oscillator", "rmse", 3.4, _RMSES[2:], "aware", "least"),
        **{
            f"figure_{number}{suffix}": _curves_of(
                "nodes", kind, height, panels, f"{name}_0", f"{name}_1", "fused", *others
            )
            for name, suffix in zip(_LOCAL, ("", "_nodes"), strict=True)
            for number, kind, height, panels, others in (
                (7, "rmse", 4.8, _RMSES[:2], ()), (8, "mean", 3.4, (("bias b", 2),), ("truth",)),
                (9, "rmse", 3.4, _RMSES[2:], ()),
            )
        },
        "table_2": _table("table_2"), "table_3": _table("table_3"),
        "figure_10": _curves_of(
            "target", "rmse", 4.8, (("position RMSE (m)", 0), ("velocity RMSE (m/s)", 1)),
            "unaware", "aware",
        ),
        "figure_11": _curves_of(
            "target", "rmse", 3.4, (("acceleration RMSE (m/s²)", 2),), "aware", "least"
        ),
    },
    {"interval": tuple(TABLE_II), "variance": tuple(TABLE_III), "policy": "periodic:period=2"},
)  # fmt: skip
