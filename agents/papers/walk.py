"""The loop over the steps of episodes, which every paper's recordings share."""

from collections.abc import Iterator

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import BATCH
from fusion_gym.policies.base import Policy, Requests


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
    batch = EpisodeBatch.seeded(task, episodes, seed)
    rule.reset(episodes, seed)
    for _ in range(task.horizon):
        yield batch, rule(batch.signals())


def walk_in_parts(
    task: Task, policy: Policy | str, episodes: int, seed: int
) -> Iterator[tuple[int, slice, EpisodeBatch, Requests]]:
    """Yield step from 0, runs, batch and requests as :func:`walk`, a part of the runs at a time."""
    for first in range(0, episodes, BATCH):
        count = min(BATCH, episodes - first)
        for step, (batch, requests) in enumerate(walk(task, policy, count, seed + first)):
            yield step, slice(first, first + count), batch, requests
