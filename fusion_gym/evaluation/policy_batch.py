"""Run several policies on the same episodes in one batch, for searches over many parameters."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import take_runs
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.beliefs import Beliefs, Owner
from fusion_gym.core.knowledge import KNOWLEDGE, Knowledge, Signals
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Policy, Requests, guard

Runs = NDArray[np.int64]


def seeded(task: Task, owner: Owner | None, seeds: Runs, reference: Any = None) -> EpisodeBatch:
    """Return runs with these seeds (N,), at the start of an episode."""
    batch = EpisodeBatch(task, len(seeds), owner, reference)
    batch.seed(np.arange(len(seeds)), seeds.tolist())
    batch.reset()
    return batch


class Together:
    """Several policies as one, each with an equal part of the runs."""

    knowledge: Knowledge = KNOWLEDGE[-1]

    def __init__(self, task: Task, policies: Sequence[Policy]) -> None:
        self._policies = policies
        self._decisions = [guard(policy, task) for policy in policies]

    def reset(self, runs: int, seed: int = 0) -> None:
        """Divide the runs among the policies, and reset these."""
        self.parts = np.arange(runs).reshape(len(self._policies), -1)
        for policy, part in zip(self._policies, self.parts, strict=True):
            policy.reset(len(part), seed)

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        each = zip(self._decisions, self.parts, strict=True)
        return np.concatenate([decision(_part(signals, part)) for decision, part in each], axis=-1)


def _part(whole: Signals, runs: Runs) -> Signals:
    """Return the signals of some runs; each is computed at its first use."""
    values: dict[str, Callable[[], Any]] = {
        name: partial(_take, whole, name, runs) for name in whole
    }
    return Signals(values, missing=whole.withheld)


def _take(whole: Signals, name: str, runs: Runs) -> Any:
    value: Any = whole[name]
    if isinstance(value, Beliefs):
        return _Part(value, runs)
    if name == "token_cost":  # the same for all runs
        return value
    # The observation has the batch first.
    return value[runs] if name == "observation" else take_runs(value, runs)


def _of_runs(name: str) -> Any:
    return property(lambda part: take_runs(getattr(part._whole, name), part._choices))


class _Part(Beliefs):
    """The beliefs of some runs."""

    silent, sent, best = _of_runs("silent"), _of_runs("sent"), _of_runs("best")
    memory_posterior, memory_states = _of_runs("memory_posterior"), _of_runs("memory_states")
    loss, value = _of_runs("loss"), _of_runs("value")

    def __init__(self, whole: Beliefs, runs: Runs) -> None:
        self.task = whole.task
        self.arrival = take_runs(whole.arrival, runs)
        self._whole, self._choices = whole, runs
