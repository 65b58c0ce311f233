"""What perturbed cases leave of the rules and of the agents' gain, judged."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fusion_gym.evaluation.envelope import best_mse
from fusion_gym.evaluation.episodes import EpisodeResults
from fusion_gym.evaluation.intervals import mean_interval

from .robust_pieces import RULES, RobustFolders, RobustPiece
from .robust_summary import KINDS, is_gain
from .robustness import NOMINAL
from .verdict import MIDDLE, Searches, judge

Rules = Mapping[str, EpisodeResults]


def judge_case(
    pieces: Mapping[str, RobustPiece],
    nominal: RobustPiece,
    prices: Sequence[float],
    searches: Searches,
    folders: RobustFolders,
) -> dict[str, Any]:
    """A case: what it does to the rules, and every kind of agent beside them.

    ``pieces`` are its finished pieces by label, ``nominal`` that of the rules as assumed, and
    ``searches`` what each tuning seed alone would have made of the envelope.
    """
    before = folders.read(nominal)
    middle = math.sqrt(MIDDLE[0] * MIDDLE[1]) * float(before["always"].rate.mean())
    every = folders.read(pieces[RULES])
    always = float(every["always"].rate.mean())
    envelope = _without_added(every, pieces[RULES])
    row: dict[str, Any] = {
        "always": always,
        "rules": error_change(_without_added(before, nominal), envelope, middle),
    }
    for kind, prefix in KINDS.items():
        tested = [
            list(folders.read(piece).values())
            for label, piece in pieces.items()
            if label.startswith(prefix)
        ]
        if tested:
            row[kind] = judge(tested, prices, envelope, {}, always, searches=searches)
    return row


def with_shares(cases: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """The cases, with what each leaves of the nominal gain of every kind of agent."""
    for kind in KINDS:
        for row in cases.values():
            left = _left(row.get(kind), cases[NOMINAL].get(kind))
            if left is not None:
                row[kind]["left"] = left
    return cases


def _without_added(rules: Rules, piece: RobustPiece) -> Rules:
    added = {entry.name for entry in piece.entries if entry.added}
    return {name: rule for name, rule in rules.items() if name not in added}


def error_change(nominal: Rules, case: Rules, rate: float) -> dict[str, float] | None:
    """The relative change of the rules' error at a rate, with its interval over paired episodes.

    That of a ratio of means, by its linear part; ``None`` left of either's first rule.
    """
    before, after = best_mse(nominal, rate), best_mse(case, rate)
    if before is None or after is None:
        return None
    ratio = float(after.mean() / before.mean())
    linear = ratio - 1.0 + (after - ratio * before) / before.mean()
    return mean_interval(np.asarray(linear))._asdict()


def _left(row: Mapping[str, Any] | None, nominal: Mapping[str, Any] | None) -> float | None:
    """The gain of a case as a share of the nominal one, where that is no accident."""
    if row is None or nominal is None or "middle" not in row or "middle" not in nominal:
        return None
    before = nominal["middle"]
    return float(row["middle"]["mean"] / before["mean"]) if is_gain(before) else None
