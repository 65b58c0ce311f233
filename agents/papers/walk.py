"""The loop over the steps of episodes of all papers, and policies of some sensors."""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.knowledge import Signals
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import BATCH
from fusion_gym.policies.base import Policy, Requests, decide, owner_of


def walk(
    task: Task, policy: Policy | str, episodes: int, seed: int
) -> Iterator[tuple[EpisodeBatch, Requests]]:
    """Yield the batch and the policy's requests before every step; the caller makes the step.

    Args:
        task: The task.
        policy: The policy, or its name with parameters.
        episodes: Number of episodes, all in one batch.
        seed: Seed of the first one.
    """
    rule = fusion_gym.make_policy(policy, task) if isinstance(policy, str) else policy
    batch = EpisodeBatch.seeded(task, episodes, seed, owner_of(rule))
    for requests in decide(rule, batch, seed):
        yield batch, requests


def walk_in_parts(
    task: Task, policy: Policy | str, episodes: int, seed: int
) -> Iterator[tuple[int, slice, EpisodeBatch, Requests]]:
    """Yield step, runs, batch and requests as :func:`walk`, one part of the runs at a time."""
    for first in range(0, episodes, BATCH):
        count = min(BATCH, episodes - first)
        for step, (batch, requests) in enumerate(walk(task, policy, count, seed + first)):
            yield step, slice(first, first + count), batch, requests


def record(
    task: Task, policy: Policy | str, episodes: int, seed: int, values: Callable[[Any], Any]
) -> NDArray[Any]:
    """Return ``values`` of the state after each delivery, times first."""
    rows = []
    for batch, requests in walk(task, policy, episodes, seed):
        batch.step(requests)
        rows.append(np.array(values(batch.delivered)))
    return np.array(rows)


@dataclass
class SomeSensors:
    """Another policy's requests of some sensors; the others never transmit.

    ``round_robin`` would wait for the others; the turns of ``periodic`` follow the clock.
    """

    policy: Policy
    sensors: Collection[int]
    knowledge: Any = "own_memory"

    def reset(self, runs: int, seed: int = 0) -> None:
        """Reset the other policy."""
        self.policy.reset(runs, seed)

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        requests = self.policy(signals)
        return requests & np.isin(np.arange(len(requests)), list(self.sensors))[:, None]
