"""Run several policies on the same episodes in one batch, for searches over many parameters."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.arrays import Array, take_runs
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.beliefs import Beliefs, Owner
from fusion_gym.core.knowledge import KNOWLEDGE, Knowledge, Signals
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Policy, Requests, decide, guard, owner_of
from fusion_gym.validation import ConfigurationError

Runs = NDArray[np.int64]


class EpisodeMeans(NamedTuple):
    """The results of E episodes of a policy, each averaged over an episode's steps.

    Args:
        rate: transmissions (E,), the mean over the sensors.
        mse: squared error (E,), as in :class:`~fusion_gym.evaluation.episodes.EpisodeResults`.
        error_cost: error in the units of the reward (E,).
        tokens: tokens spent (E,).
    """

    rate: Array
    mse: Array
    error_cost: Array
    tokens: Array

    def cost(self, price: float | Array) -> Array:
        """Return error + price · tokens (E,), for one price of a token or one per episode (E,)."""
        return self.error_cost + price * self.tokens


def run_policies(
    task: Task, policies: Sequence[Policy], episodes: int, seed: int
) -> list[EpisodeMeans]:
    """Run every policy on the seeds ``seed``, ``seed + 1``, … in one batch.

    The results equal the results of ``run_episodes`` up to rounding. The time of a step hardly
    depends on the number of runs, up to some hundred runs.

    Args:
        task: the task.
        policies: policies that use the beliefs of the same owner.
        episodes: episodes of each policy, >= 1.
        seed: seed of the first episode, >= 0.

    Raises:
        ConfigurationError: no policies, policies that use the beliefs of different owners, or a
            value that is not allowed.
        LookupError: a policy uses a signal that the task withholds.
    """
    validation.integer("episodes", episodes, at_least=1)
    validation.integer("seed", seed, at_least=0)
    owners = {owner_of(policy) for policy in policies}
    if len(owners) != 1:
        raise ConfigurationError(
            f"policies with the belief owners {sorted(map(str, owners))} are not allowed "
            "together: there must be policies, and all must have the same owner"
        )
    runs = len(policies) * episodes
    batch = seeded(task, owners.pop(), seed + np.arange(runs) % episodes)
    together = Together(task, policies)
    brief = _run(batch, together, seed)
    return [EpisodeMeans(*(values[part] for values in brief)) for part in together.parts]


def run_priced(task: Task, policy: Policy, seeds: Runs, prices: Array) -> EpisodeMeans:
    """Run one policy on N seeds, each at its own price of a token.

    The signals and the reward use these prices instead of the price of the task.

    Args:
        task: the task.
        policy: the policy.
        seeds: seeds of the episodes (N,).
        prices: price of a token in each episode (N,).

    Raises:
        LookupError: the policy uses a signal that the task withholds.
    """
    batch = seeded(task, owner_of(policy), seeds)
    batch.price = np.array(prices, dtype=np.float64)
    return _run(batch, policy, int(seeds[0]))


def seeded(task: Task, owner: Owner | None, seeds: Runs) -> EpisodeBatch:
    """Return runs with these seeds (N,), at the start of an episode."""
    batch = EpisodeBatch(task, len(seeds), owner)
    batch.seed(np.arange(len(seeds)), seeds.tolist())
    batch.reset()
    return batch


def _run(batch: EpisodeBatch, policy: Policy, seed: int) -> EpisodeMeans:
    """Run the first episode of all runs of a batch."""
    sums = np.zeros((4, batch.num_envs))
    for requests in decide(policy, batch, seed):
        outcome = batch.step(requests)
        squared_error = outcome.squared_error.sum(0)
        step = (outcome.granted.mean(0), squared_error, -outcome.reward_error, outcome.cost)
        for total, values in zip(sums, step, strict=True):
            total += values
    return EpisodeMeans(*(sums / batch.task.horizon))


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
        whole = _Whole(signals)
        each = zip(self._decisions, self.parts, strict=True)
        return np.concatenate([decision(whole.part(part)) for decision, part in each], axis=-1)


class _Whole:
    """The signals of all runs, divided among the policies."""

    def __init__(self, signals: Signals) -> None:
        self._signals = signals
        self._beliefs: dict[str, Beliefs] = {}

    def part(self, runs: Runs) -> Signals:
        """Return the signals of some runs; each is computed at its first use."""
        values: dict[str, Callable[[], Any]] = {
            name: partial(self._take, name, runs) for name in self._signals
        }
        return Signals(values, missing=self._signals.withheld)

    def _take(self, name: str, runs: Runs) -> Any:
        if name in self._beliefs:
            return _Part(self._beliefs[name], runs)
        value: Any = self._signals[name]
        if isinstance(value, Beliefs):
            self._beliefs[name] = value
            return _Part(self._beliefs[name], runs)
        if name == "token_cost":  # the same for all runs
            return value
        if name == "observation":  # the one with the batch first
            return value[runs]
        return take_runs(value, runs)


def _of_runs(name: str) -> Any:
    return property(lambda part: take_runs(getattr(part._whole, name), part._choices))


class _Part(Beliefs):
    """The beliefs of some runs."""

    silent, sent, best = _of_runs("silent"), _of_runs("sent"), _of_runs("best")
    memory_posterior = _of_runs("memory_posterior")
    loss, value = _of_runs("loss"), _of_runs("value")

    def __init__(self, whole: Beliefs, runs: Runs) -> None:
        self.task, self.memory_states = whole.task, whole.memory_states
        self.arrival = take_runs(whole.arrival, runs)
        self._whole, self._choices = whole, runs
