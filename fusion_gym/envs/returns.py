"""Returns of policies in every environment with its defaults, which ``agents.returns`` measures."""

import csv
import functools
import math
import statistics
from pathlib import Path
from typing import NamedTuple

FILE = Path(__file__).with_name("returns.csv")
TUNED = "best threshold", "searched rule"
NAIVE = "random", "always", "never", "round_robin"


class ReturnRow(NamedTuple):
    """The return of an episode, its 95 % half-width, MSE, transmissions and tokens per step.

    ``seconds`` is the processor time of a training.
    """

    environment: str
    kind: str
    policy: str
    mean: float
    half_width: float = 0.0
    mse: float = math.nan
    rate: float = math.nan
    tokens: float = math.nan
    seconds: float = math.nan


@functools.cache
def read_returns() -> tuple[ReturnRow, ...]:
    """Return the rows of the file."""
    with FILE.open(newline="") as file:
        _, *rows = csv.reader(file)
    return tuple(
        ReturnRow(env_id, kind, policy, *(float(entry or "nan") for entry in numbers))
        for env_id, kind, policy, *numbers in rows
    )


def reward_threshold(env_id: str) -> float | None:
    """Return the return of the better tuned rule, or ``None`` for an environment of a user."""
    own = [r.mean for r in read_returns() if r.environment == env_id and r.kind in TUNED]
    return max(own, default=None)


def returns_of(env_id: str) -> dict[str, list[float]]:
    """Return the mean returns of each kind of policy, one for each seed of a learner."""
    result: dict[str, list[float]] = {}
    for row in read_returns():
        if row.environment == env_id:
            result.setdefault(row.kind, []).append(row.mean)
    return result


def share_text(env_id: str, kind: str) -> str:
    """Return which share of the gap from naive policies to the best threshold learners close.

    It is the median of the seeds, with their range.
    """
    returns = returns_of(env_id)
    if not returns.keys() >= {kind, *NAIVE}:
        return "–"
    low = max(returns[name][0] for name in NAIVE)
    shares = [(own - low) / (returns["best threshold"][0] - low) for own in returns[kind]]
    return f"{statistics.median(shares):.0%} ({min(shares):.0%} to {max(shares):.0%})"
