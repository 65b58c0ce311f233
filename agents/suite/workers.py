"""Pieces of work, done by a team; processes that end with the process that they work for."""

import functools
import os
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures.process import BrokenProcessPool
from typing import Any, NamedTuple

from fusion_gym.validation import ConfigurationError

from ..output.ending import name_user_code
from ..output.progress import progress_bar
from .team import Team

_EVERY = 1.0  # seconds between two looks


class Work(NamedTuple):
    """A call and about how long it takes, in seconds on one core."""

    weight: float
    function: Callable[..., Any]
    arguments: tuple[Any, ...]


def side_by_side(work: Sequence[Work], team: Team, description: str) -> None:
    """Let the team do the work, and show how far it is.

    Raises:
        ConfigurationError: some of it does not fit, there is no such team, or the system ended a
            worker of this machine. A cluster gives the work of a worker that is gone to another.
    """
    if not work:
        return
    total, done = sum(item.weight for item in work), 0.0
    parent = os.getpid() if team.here else None
    with progress_bar(len(work), description, unit="pieces") as bar, team.gathered():
        weights = team.done(functools.partial(_do, parent), work)
        try:
            for place, weight in enumerate(weights, 1):
                done += weight
                bar.reach(place, done / total)
        except BrokenProcessPool:
            raise ConfigurationError(
                f"workers = {team.workers}: the system ended one of them, perhaps for want of "
                "memory; finished pieces of work are kept: go on as after an interrupt"
            ) from None


def _do(parent: int | None, work: Work) -> float:
    """Do a piece of work; returns its weight. A worker of this machine ends with its ``parent``."""
    if parent is not None and os.getpid() != parent:
        end_with(parent)
    with name_user_code():
        work.function(*work.arguments)
    return work.weight


@functools.cache
def end_with(parent: int) -> None:
    """End this process soon after its ``parent`` is gone, also where that was killed.

    The system then gives an orphan another parent. Where it does not (Windows), nothing happens.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_EVERY)
        os._exit(1)  # at once: nobody waits for the work, and its files are whole

    threading.Thread(target=watch, name="end-with-parent", daemon=True).start()
