"""Returns of policies in every environment with its defaults, which ``agents.returns`` measures."""

import csv
import functools
import math
from pathlib import Path
from typing import NamedTuple

FILE = Path(__file__).with_name("returns.csv")
TUNED = "best threshold", "searched rule"


class ReturnRow(NamedTuple):
    """The return of an episode, its 95 % half-width, MSE, transmissions and tokens per step."""

    environment: str
    kind: str
    policy: str
    mean: float
    half_width: float = 0.0
    mse: float = math.nan
    rate: float = math.nan
    tokens: float = math.nan


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
