"""Several policies on the same episodes in one batch: for searches over many parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from fusion_gym import validation
from fusion_gym.arrays import Array, take_runs
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.system import Signals
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Policy
from fusion_gym.validation import ConfigurationError


class Brief(NamedTuple):
    """What a policy's E episodes brought, each averaged over its steps.

    ``rate`` (E,) of transmissions, the mean over sensors · ``mse`` (E,), as in
    :class:`~fusion_gym.evaluation.episodes.EpisodeResults`.
    """

    rate: Array
    mse: Array


def run_beside(task: Task, policies: Sequence[Policy], episodes: int, seed: int) -> list[Brief]:
    """What ``run_episodes`` finds of each policy, up to rounding, in the time of one large batch.

    Every policy meets the noise of the seeds ``seed``, ``seed + 1``, …; a step's cost hardly
    depends on the number of runs as long as that is some hundred.

    Raises:
        ConfigurationError: no policies, fewer than one episode, or a negative seed.
        LookupError: a policy looks at a signal that the task withholds.
    """
    validation.integer("episodes", episodes, at_least=1)
    validation.integer("seed", seed, at_least=0)
    if not policies:
        raise ConfigurationError("policies = [] is not allowed: there is nothing to run")
    runs = len(policies) * episodes
    batch = EpisodeBatch(task, runs)
    batch.seed(np.arange(runs), [seed + run % episodes for run in range(runs)])
    batch.reset()
    for policy in policies:
        policy.reset(episodes, seed)
    parts = np.arange(runs).reshape(len(policies), episodes)
    mse, rate = np.zeros(runs), np.zeros(runs)
    for _ in range(task.horizon):
        signals = batch.signals()
        asked = [
            policy(_part(signals, part)) for policy, part in zip(policies, parts, strict=True)
        ]
        outcome = batch.step(np.concatenate(asked, axis=-1))
        mse += outcome.squared_error.sum(0)
        rate += outcome.granted.mean(0)
    return [Brief(rate[part] / task.horizon, mse[part] / task.horizon) for part in parts]


def _part(signals: Signals, runs: Any) -> Signals:
    """The signals of some runs alone; nothing is computed before it is looked at."""

    def take(name: str) -> Any:
        value = signals[name]
        if name == "token_cost":  # the same for all runs
            return value
        if name == "observation":  # the one with the batch first
            return value[runs]
        return take_runs(value, runs)

    values: dict[str, Callable[[], Any]] = {name: partial(take, name) for name in signals}
    return Signals(values, signals.hidden)
