"""The benchmark's tables: one frozen dataclass for each kind of row, as CSV."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from fusion_gym.output.files import replacing


@dataclass(frozen=True)
class TestRow:
    """A policy at a price on the test episodes: means per step."""

    setting: str
    name: str  # of the class
    kind: str  # rule, threshold, trigger, agent, learned, other, …, optimum, the user's policy
    seed: int  # of the training
    share: float  # of the tokens of ``always`` that the best single threshold spends there
    price: float
    cost: float
    error: float
    tokens: float
    mse: float
    rate: float
    policy: str


@dataclass(frozen=True)
class PointRow:
    """The cost of a kind of policy at a price, relative to the searched rule's, minus 1."""

    setting: str
    name: str
    kind: str
    share: float
    price: float
    difference: float
    low: float
    high: float
    discovery: bool  # after Benjamini and Hochberg, over all points of the table


@dataclass(frozen=True)
class ClassRow:
    """The mean of these differences over a class's prices and seeds; the median over seeds."""

    setting: str
    name: str
    kind: str
    difference: float
    low: float
    high: float
    median: float


@dataclass(frozen=True)
class SavingRow:
    """The share of the own trigger's cost that a kind saves: a mean over prices and classes."""

    setting: str
    kind: str
    classes: int
    saving: float
    low: float
    high: float


@dataclass(frozen=True)
class TrainingRow:
    """A training and its calibration: processor seconds, and costs over the rule's, minus 1."""

    setting: str
    name: str
    kind: str
    algorithm: str
    seed: int
    timesteps: int
    seconds: float
    calibration_seconds: float
    rule_points: int  # prices at which the calibration takes the rule alone
    agent: float
    learned: float


@dataclass(frozen=True)
class CaseRow:
    """A perturbed case: the rule's cost over its nominal cost, the learned policy's over that."""

    setting: str
    case: str
    rule: float
    difference: float
    low: float
    high: float


KINDS: dict[type, str] = {
    TestRow: "policies",
    PointRow: "points",
    ClassRow: "classes",
    SavingRow: "savings",
    TrainingRow: "trainings",
    CaseRow: "cases",
}


def write_rows(folder: Path, rows: Sequence[object]) -> None:
    """Write rows of one kind as a CSV file into the folder."""
    kind = type(rows[0])
    with replacing(folder / f"{KINDS[kind]}.csv") as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, [item.name for item in fields(kind)], lineterminator="\n")  # type: ignore[arg-type]
        writer.writeheader()
        for row in rows:
            values = asdict(row).items()  # type: ignore[call-overload]
            writer.writerow({key: f"{v:.6g}" if isinstance(v, float) else v for key, v in values})
