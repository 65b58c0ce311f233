"""Episodes of the Markov jump paper: what was sent, how far the estimates are off."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import fusion_gym
from fusion_gym.arrays import Array
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.systems.markov_jump.environment import MarkovJumpTrackingOptions

THRESHOLDS = (0.0, 0.9, 1.3, 1.5)
STATES = ("position", "velocity")
UNITS = ("m", "m/s")


def example(**options: Any) -> Task:
    """The paper's Section 6, with other ``options`` where they are named."""
    return fusion_gym.make_task(MarkovJumpTrackingOptions(**options))


def trigger(m: float, literal: bool = False) -> str:
    """The paper's trigger (33) at the threshold m; m = 0 stands for all that is sent.

    ``literal`` takes (33) by its word there too.
    """
    return f"local_variance:m={m:g}" if m or literal else "always"


def run_markov_jump(task: Task, policy: str, episodes: int, seed: int) -> Run:
    """Episodes with the seeds ``seed``, ``seed + 1``, …"""
    rule = fusion_gym.make_policy(policy, task)
    batch = EpisodeBatch.seeded(task, episodes, seed)
    rule.reset(episodes, seed)
    rows: list[tuple[Any, ...]] = []
    for _ in range(task.horizon):
        outcome = batch.step(rule(batch.signals()))
        state = batch.delivered
        mean, covariance = task.system.fused(state)
        truth = task.system.truth(state)
        local = task.system.local_means(state) if hasattr(state, "node_mean") else mean[None]
        trace = np.trace(covariance)[:1]
        rows.append((truth, mean, truth - local, outcome.granted[:, 0], trace))
    truth, mean, local, sent, trace = (np.array(row) for row in zip(*rows, strict=True))
    return Run(truth, mean, local, sent, trace[:, 0])


class Run(NamedTuple):
    """E episodes of H steps, k = 1..H first.

    ``truth`` and ``mean`` (H, n, E), the fused estimate · ``local_error`` (H, l, n, E) · of the
    first episode, which for a trigger that looks at covariances is every one: ``sent`` (H, l) bool
    and the ``trace`` (H,) of the fused covariance.
    """

    truth: Array
    mean: Array
    local_error: Array
    sent: NDArray[np.bool_]
    trace: Array

    @property
    def squared(self) -> Array:
        """Squared errors (H, n, E)."""
        return np.square(self.truth - self.mean)
