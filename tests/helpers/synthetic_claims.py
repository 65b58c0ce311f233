"""Claims on synthetic runs: all hold on one set of runs, and each fails after its change."""

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np

from agents.papers.claims import FAILS, HOLDS, Claims
from agents.papers.paper import PieceData

Runs = Mapping[str, Any]  # data by piece
Change = Mapping[str, Any]  # values by path, such as rates.percent.ours
Pair = tuple[Change, Change]
ENOUGH = 200  # episodes


def about(*means: float) -> np.ndarray[Any, Any]:
    """Return samples (means, runs) that vary by a hundredth, each its own way."""
    noise = np.random.default_rng(0).uniform(-0.01, 0.01, (len(means), ENOUGH))
    return np.array(means)[:, None] * (1.0 + noise)


def verdicts(claims: Claims, runs: Runs) -> dict[str, str]:
    """Return the verdict on each claim by its sentence."""
    data = {name: PieceData(piece, episodes=ENOUGH) for name, piece in runs.items()}
    return {claim.text: claim.judge({"": data}).verdict for claim in claims}


def check(claims: Claims, runs: Runs, changes: Mapping[str, Change | Pair]) -> None:
    """Assert that each claim holds on the runs, and fails where its change is made.

    Of a pair the first change makes the claim hold, where claims exclude each other.
    """
    assert [*changes] == [claim.text for claim in claims]
    for text, change in changes.items():
        true, false = change if isinstance(change, tuple) else ({}, change)
        assert verdicts(claims, changed(runs, true))[text] == HOLDS, text
        assert verdicts(claims, changed(runs, false))[text] == FAILS, text


def changed(runs: Runs, change: Change) -> Runs:
    """Return the runs with other values at these paths."""
    result = copy.deepcopy(dict(runs))
    for path, value in change.items():
        *parents, name = path.split(".")
        place = result
        for parent in parents:
            place = place[parent]
        assert name in place, path
        place[name] = value
    return result
