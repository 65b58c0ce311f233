"""The tables of results: ``RESULTS/SETTING/TABLE.csv``, what their columns mean, read and written.

Numbers are written to their last digit and read back bit for bit; an empty cell says that there is
nothing. A column of the kind ``interval`` stands for three: the mean NAME, ``NAME_low`` and
``NAME_high``, the ends of its 95 % interval.
"""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd

from fusion_gym.errors import display
from fusion_gym.validation import ConfigurationError

from ..output.files import replacing

Row = dict[str, Any]
VERDICT = "verdict"  # the table of a setting that is written last


class Column(NamedTuple):
    """What a column holds; ``empty`` where a cell may hold nothing, ``allowed`` the words."""

    kind: Literal["text", "number", "count", "flag", "json", "interval"]
    meaning: str
    empty: bool = False
    allowed: tuple[str, ...] = ()


CLASS = Column("text", "class of knowledge, as sensors_memory")
PRICE = Column("number", "price of a token")
RATE = Column("number", "transmissions per sensor and step")
MSE = Column("number", "mean squared error")
SEED = Column("count", "training seed")
INPUTS = Column("json", "all that it was made from")
OPTIONS = Column("json", "options of the environment that the class changes")
KNOWS = Column("text", "knowledge that a rule needs")
SHA256 = Column("text", "hash of the class of committed rules")
MODE = Column("text", "who decides", allowed=("centre", "local", "sensors"))
MEMORY = Column("flag", "whether what was not sent is remembered")
BROADCAST = Column("text", "what a sensor by itself hears", empty=True)
DIFFERENCE = Column("interval", "difference to the rules as a share of their error", empty=True)
RULES = Column("interval", "the rules' error", empty=True)
AGENTS = Column("interval", "the agents' error", empty=True)
FRONT = {
    "seeds": Column("count", "number of training seeds"),
    "prices": Column("count", "prices whose rate lies in the middle", empty=True),
    "rates": Column("json", "rates of the grid over the middle that count", empty=True),
    "middle": DIFFERENCE._replace(meaning="mean difference over the middle of the front"),
}

TABLES: dict[str, dict[str, Column]] = {
    # The committed rules: a setting, its classes, and what was found by tuning.
    "setting": {
        "title": Column("text", "name for readers"),
        "env": Column("text", "id of the environment"),
        "options": OPTIONS._replace(meaning="options of the environment"),
        "horizon": Column("count", "steps of an episode"),
        "always": RATE._replace(meaning="rate of always transmitting, on tuning episodes"),
        "inputs": INPUTS,
    },
    "classes": {
        "class": CLASS, "mode": MODE, "memory": MEMORY, "broadcast": BROADCAST, "knows": KNOWS,
        "options": OPTIONS,
        "contains": Column("json", "classes that know less"),
        "families": Column("json", "families whose rules compete"),
        "trials": Column("count", "rules that were tried"),
        "sha256": SHA256,
    },
    "vertices": {
        "class": CLASS,
        "name": Column("text", "policy with its options"),
        "policy": Column("text", "policy by itself"),
        "options": OPTIONS,
        "family": Column("text", "family that it belongs to"),
        "knows": KNOWS,
        "tuning_rate": RATE._replace(meaning="rate on tuning episodes"),
        "tuning_mse": Column("interval", "mean squared error on tuning episodes"),
        "test_rate": RATE._replace(meaning="rate on test episodes"),
        "test_mse": Column("interval", "mean squared error on test episodes"),
        "convex": Column("flag", "whether it lies on the lower hull on test episodes"),
    },
    "searches": {
        "class": CLASS, "seed": SEED._replace(meaning="tuning seed"), "rate": RATE, "mse": MSE,
    },
    "curves": {
        "family": Column("text", "family of rules"),
        "options": OPTIONS,
        "trials": Column("count", "rules that were tried"),
        "name": Column("text", "policy on the family's own lower hull"),
        "rate": RATE, "mse": MSE,
    },
    # The benchmark: its pieces of work, the policies that they tested, and the verdict.
    "runs": {
        "run": Column("text", "piece of work: baselines, informed, agent_CLASS_SEED, …"),
        "class": CLASS._replace(empty=True),
        "training_seed": SEED._replace(empty=True),
        "horizon": Column("count", "steps of an episode"),
        "episodes": Column("count", "test episodes"),
        "made_from": Column("text", "hash of the inputs"),
        "inputs": INPUTS,
        "class_options": OPTIONS._replace(empty=True),
        "seconds": Column("json", "wall time of a training by its parts", empty=True),
        "best_validation": Column("json", "the validation that was kept", empty=True),
    },
    "policies": {
        "run": Column("text", "piece of work that tested it; genie: everything arrives"),
        "name": Column("text", "the policy; of a genie what it assumes"),
        "price": PRICE._replace(empty=True),
        "family": Column("text", "family of rules", empty=True),
        "knows": KNOWS._replace(empty=True, meaning="knowledge that the family needs"),
        "rate": Column("json", "transmissions per step of each sensor"),
        "mse": Column("interval", "mean squared error"),
        "return": Column("interval", "return of an episode"),
        "denied": Column("interval", "requests that were denied, a step"),
        "tokens": Column("interval", "tokens spent, a step"),
        "nees": Column("interval", "normalised error squared; 1 is consistent"),
        "median": MSE._replace(meaning="median over episodes of the squared error"),
    },
    "verdict": {
        "title": Column("text", "name for readers"),
        "env": Column("text", "id of the environment"),
        "episodes": Column("count", "test episodes"),
        "seed": Column("count", "seed of the first of them"),
        "always": RATE._replace(meaning="rate of always transmitting"),
    },
    "fronts": {
        "class": CLASS, "mode": MODE, "memory": MEMORY, "broadcast": BROADCAST,
        "packet": Column("text", "what a packet holds"),
        "knows": KNOWS, **FRONT,
        "room": Column("number", "gap to the reference, as a share of the rules", empty=True),
        "closed": Column("number", "share of that gap that agents close", empty=True),
        "hindsight_room": Column("number", "gap to a clairvoyant, as a share", empty=True),
        "sha256": SHA256,
    },
    "points": {
        "class": CLASS, "price": PRICE, "rate": RATE, "mse": MSE,
        "envelope": MSE._replace(empty=True, meaning="error of the rules at that rate"),
        "reference": MSE._replace(empty=True, meaning="error of the reference there"),
        "hindsight": MSE._replace(empty=True, meaning="error of a clairvoyant there"),
        "difference": DIFFERENCE,
    },
    "tested": {
        "class": CLASS, "name": Column("text", "rule of its envelope"), "rate": RATE, "mse": MSE,
    },
    "equal_rates": {
        "class": CLASS, "rate": RATE, "rules": RULES, "agents": AGENTS, "difference": DIFFERENCE,
    },
    "worth": {
        "kind": Column("text", "what is known more"),
        "knows": CLASS, "less": CLASS._replace(meaning="class that knows less"),
        "rules": RULES._replace(meaning="relative difference of the rules' errors"),
        "agents": AGENTS._replace(meaning="relative difference of the agents' errors"),
    },
    # Perturbed cases.
    "robustness": {
        "class": CLASS,
        "case": Column("text", "name of the case"),
        "title": Column("text", "the case for readers"),
        "episodes": Column("count", "test episodes"),
        "sha256": SHA256,
        "always": RATE._replace(meaning="rate of always transmitting"),
        "rules": RULES._replace(meaning="relative change of the rules' error"),
        "kind": Column("text", "agents as they are, or trained over draws", True,
                       ("agents", "trained")),
        **{name: column._replace(empty=True) for name, column in FRONT.items()},
        "left": Column("number", "what is left of the gain as assumed, as a share", empty=True),
    },
    "robustness_points": {
        "class": CLASS, "case": Column("text", "name of the case"),
        "kind": Column("text", "agents as they are, or trained over draws"),
        "price": PRICE, "rate": RATE, "mse": MSE,
        "envelope": MSE._replace(empty=True, meaning="error of the rules at that rate"),
        "difference": DIFFERENCE,
    },
    # How fast agents learn.
    "learning": {
        "title": Column("text", "name for readers"),
        "env": Column("text", "id of the environment"),
        "course": Column("json", "what is trained, and what it is compared with"),
        "prices": Column("json", "prices at which fronts are measured"),
        "inner": Column("json", "which of them lie in the inner part of the range"),
        "seeds": Column("count", "training seeds that were asked for"),
        "throughput": Column("json", "steps per second of this machine", empty=True),
    },
    "learning_trainings": {
        "kind": Column("text", "front, or plain PPO", allowed=("front", "plain")),
        "seed": SEED, "algorithm": Column("text", "name of the algorithm"), "inputs": INPUTS,
    },
    "learning_curves": {
        "kind": Column("text", "front, or plain PPO", allowed=("front", "plain")),
        "seed": SEED,
        "timesteps": Column("count", "steps so far"),
        "cpu_seconds": Column("number", "the processor's seconds so far"),
        "return": Column("number", "return of a validation"),
        "excess": Column("number", "most by which the front lies above the rules", empty=True),
        "below": Column("flag", "whether it lies below them", empty=True),
        "rate": RATE._replace(meaning="rate at the next of the prices"), "mse": MSE,
    },
    "learning_points": {
        "seed": SEED, "price": PRICE, "rate": RATE, "mse": MSE,
        "envelope": MSE._replace(empty=True, meaning="error of the rules at that rate"),
        "rollout": MSE._replace(empty=True, meaning="error of one improvement by simulation"),
        "bound": MSE._replace(empty=True, meaning="proven lower bound of the error"),
        "cost": Column("number", "cost of an episode", empty=True),
        "optimum": Column("number", "least cost of what it is compared with", empty=True),
        "difference": DIFFERENCE,
    },
    # What was computed elsewhere: ``fusion-gym bound --tables`` and ``benchmarks.rollout``.
    "bounds": {
        "price": PRICE._replace(meaning="price of a packet"),
        "lower": Column("number", "no policy costs less, error and packets a step"),
        "upper": Column("number", "some policy of the relaxed problem costs no more"),
        "rate": RATE._replace(meaning="rate of that policy"),
        "step": Column("number", "spacing of the lattice"),
        "points": Column("count", "points of the lattice"),
        "gap": Column("number", "upper over lower, less one"),
        "sensors": Column("count", "number of sensors"),
        "floor": MSE._replace(meaning="error that no policy undercuts"),
        "env": Column("text", "id of the environment"),
        "settings": OPTIONS._replace(meaning="all options of the environment"),
        "horizon": Column("count", "steps of an episode"),
        "weights": Column("text", "what weighs the states"),
        "everything_delivered": Column("json", "error of each filter, with interval"),
    },
    "bounds_at": {
        "rate": RATE, "bound": MSE._replace(meaning="no policy has less at this rate"),
        "price": PRICE._replace(meaning="price of a packet that shows it"),
        "gap": Column("number", "upper over lower at that price, less one"),
    },
    "rollout": {
        "policy": Column("text", "the rollout"), "price": PRICE, "rate": RATE,
        "mse": Column("interval", "mean squared error"),
        "return": Column("number", "mean return"),
        "return_gain": Column("interval", "paired gain of the return over the base"),
        "base_policy": Column("text", "the rule that it improves"),
        "base_rate": RATE._replace(meaning="its rate"),
        "base_mse": Column("interval", "its mean squared error"),
        "episodes": Column("count", "number of episodes, the first of the test's"),
        "seed": Column("count", "seed of the first of them"),
        "env": Column("text", "id of the environment"),
        "options": OPTIONS._replace(meaning="options of the environment"),
        "command": Column("text", "command that made it"),
    },
}  # fmt: skip


def columns_of(table: str) -> dict[str, Column]:
    """Return the columns of a table's file: an interval has three."""
    result: dict[str, Column] = {}
    for name, column in TABLES[table].items():
        ends = ("", "_low", "_high") if column.kind == "interval" else ("",)
        result |= {f"{name}{end}": column for end in ends}
    return result


def write_rows(folder: Path, table: str, rows: Iterable[Mapping[str, Any]]) -> None:
    """Replace a table in one move; what is no column of it is left out."""
    flat = []
    for row in rows:
        cells = dict(row)
        for name, column in TABLES[table].items():
            if column.kind == "interval" and name in cells:
                ends = cells[name]
                cells |= {name: ends["mean"], f"{name}_low": ends["low"]}
                cells[f"{name}_high"] = ends["high"]
            elif column.kind == "json" and name in cells:
                cells[name] = json.dumps(cells[name], default=list)
        flat.append(cells)
    columns = columns_of(table)
    frame = pd.DataFrame(flat, columns=list(columns), dtype=object)
    with replacing(folder / f"{table}.csv") as partial:
        frame.to_csv(partial, index=False, lineterminator="\n")


def read_frame(folder: Path, table: str, option: str = "results") -> pd.DataFrame:
    """Return a table, its cells checked.

    Raises:
        ConfigurationError: it cannot be read, or a column or cell is not what the table has; names
            ``option``, the file, the column and the cell.
    """
    path, columns = folder / f"{table}.csv", columns_of(table)
    words: dict[Any, Any] = {
        name: str for name, item in columns.items() if item.kind in ("text", "flag", "json")
    }
    try:
        frame = pd.read_csv(
            path, dtype=words, keep_default_na=False, na_values=[""], float_precision="round_trip"
        )
    except (OSError, ValueError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise ConfigurationError(f"{option} = {str(path)!r} cannot be read: {reason}") from None
    if list(frame.columns) != list(columns):
        differing = sorted(set(columns) ^ set(frame.columns)) or ["another order"]
        raise ConfigurationError(
            f"{option} = {str(path)!r} has other columns than the table {table!r}: "
            f"{display(differing[0])}"
        )
    for name, column in columns.items():
        frame[name], wrong = _checked(frame[name], column)
        if wrong.any():
            value = frame[name][wrong].tolist()[0]
            cell = "an empty cell" if pd.isna(value) else display(value)
            raise ConfigurationError(
                f"{option} = {str(path)!r}: {name} = {cell} is not allowed: it must be "
                f"{' or '.join(map(repr, column.allowed)) or _KINDS[column.kind]}"
            )
    return frame


_KINDS = {
    "text": "text", "number": "a finite number", "count": "a whole number",
    "flag": "True or False", "json": "JSON", "interval": "a finite number",
}  # fmt: skip


def _checked(values: "pd.Series[Any]", column: Column) -> "tuple[pd.Series[Any], pd.Series[bool]]":
    """Return the column as its kind has it, and which of its cells are not allowed."""
    absent = values.isna()
    wrong = absent & (not column.empty)
    if column.kind in ("number", "interval", "count"):
        numbers = pd.to_numeric(values, errors="coerce").astype(float)
        wrong |= ~absent & ~np.isfinite(numbers)
        if column.kind == "count":
            wrong |= ~absent & (numbers % 1.0 != 0.0)
        if wrong.any():
            return values, wrong
        return (numbers.astype("Int64") if column.kind == "count" else numbers), wrong
    if column.kind == "flag":
        wrong |= ~absent & ~values.isin(["True", "False"])
        flags = values.map({"True": True, "False": False}).astype(object)
        return (values if wrong.any() else flags), wrong
    if column.allowed:
        wrong |= ~absent & ~values.isin(column.allowed)
    if column.kind == "json":
        wrong |= ~absent & ~values.map(_is_json)
    return values, wrong


def _is_json(text: Any) -> bool:
    try:
        json.loads(text)
    except (TypeError, ValueError, RecursionError):
        return False
    return True


def read_rows(folder: Path, table: str, option: str = "results") -> list[Row]:
    """Return a table's rows, intervals and JSON as values, without what is empty.

    Raises:
        ConfigurationError: as :func:`read_frame`.
    """
    kinds = {name: column.kind for name, column in TABLES[table].items()}
    result = []
    for cells in read_frame(folder, table, option).to_dict("records"):
        row: Row = {}
        for name, kind in kinds.items():
            if pd.isna(cells[name]):
                continue
            value = cells[name]
            if kind == "interval":
                value = {"mean": value, "low": cells[f"{name}_low"], "high": cells[f"{name}_high"]}
            row[name] = json.loads(value) if kind == "json" else value
        result.append(row)
    return result


def grouped(rows: Iterable[Row], name: str) -> dict[str, list[Row]]:
    """Return the rows by one of their columns, without it."""
    result: dict[str, list[Row]] = {}
    for row in rows:
        result.setdefault(row.pop(name), []).append(row)
    return result
