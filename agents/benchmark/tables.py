"""The benchmark's tables: one named tuple for each kind of row, as CSV."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from fusion_gym.output.files import replacing


class TestRow(NamedTuple):
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


class PointRow(NamedTuple):
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


class ClassRow(NamedTuple):
    """The mean of these differences over a class's prices and seeds; the median over seeds."""

    setting: str
    name: str
    kind: str
    difference: float
    low: float
    high: float
    median: float


class SavingRow(NamedTuple):
    """The share of the own trigger's cost that a kind saves: a mean over prices and classes."""

    setting: str
    kind: str
    classes: int
    saving: float
    low: float
    high: float


class TrainingRow(NamedTuple):
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


class CaseRow(NamedTuple):
    """A perturbed case: the rule's cost over its nominal cost, the learned policy's over that."""

    setting: str
    case: str
    rule: float
    difference: float
    low: float
    high: float


def write_rows(path: Path, rows: Sequence[object]) -> None:
    """Write rows of one kind as a CSV file."""
    with replacing(path) as partial:
        table = pd.DataFrame(rows)
        table.to_csv(partial, index=False, float_format="%.6g", na_rep="nan", lineterminator="\n")
