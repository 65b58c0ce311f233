"""Episodes of a clairvoyant: the schedules that a search finds once all noise is known."""

import dataclasses
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fusion_gym.core.reward import Price
from fusion_gym.core.system import Knowledge, Signals
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.policies.base import Requests
from fusion_gym.policies.hindsight import find_schedules


def run_hindsight(task: Task, price: float, width: int, episodes: int, seed: int) -> EpisodeResults:
    """Episodes of a clairvoyant that knows all their noise, with the seeds of ``run_episodes``.

    Each plays the schedule of :func:`find_schedules`, which also says what it bounds and what not.
    ``returns`` holds minus its cost, at ``price`` and not at the task's own price of a token.

    Raises:
        ConfigurationError: as :func:`find_schedules`.
    """
    result = find_schedules(task, price, width, episodes, seed)
    priced = dataclasses.replace(task.reward, price=Price.create(price))
    played = dataclasses.replace(task, reward=priced)
    return run_episodes(played, _Replay(result.granted, seed), episodes, seed)


class _Replay:
    """Requests what schedules (H, sensors, E) say, for episodes from the seed ``first`` on."""

    # It knows all noise, so it is in no registry; the class is the largest that there is.
    knowledge: ClassVar[Knowledge] = "scheduler_memory"

    def __init__(self, schedules: NDArray[np.bool_], first: int) -> None:
        self._schedules, self._first = schedules, first

    def reset(self, runs: int, seed: int = 0) -> None:
        """Back to the start of the ``runs`` episodes from ``seed`` on."""
        place = seed - self._first
        self._coming = iter(self._schedules[..., place : place + runs])

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        return next(self._coming)
