"""Several policies on the same episodes in one batch: for searches over many parameters."""

import functools
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.arrays import Array, take_runs
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.beliefs import Beliefs, Estimate, Owner
from fusion_gym.core.system import Signals
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Policy, Requests, owner_of, refused_signals
from fusion_gym.validation import ConfigurationError

Runs = NDArray[np.int64]


class Brief(NamedTuple):
    """What a policy's E episodes brought, each averaged over its steps.

    ``rate`` (E,) of transmissions, the mean over sensors · ``mse`` (E,), as in
    :class:`~fusion_gym.evaluation.episodes.EpisodeResults`, and so are ``error_cost`` (E,) and
    ``tokens`` (E,).
    """

    rate: Array
    mse: Array
    error_cost: Array
    tokens: Array

    def cost(self, price: float | Array) -> Array:
        """Return error + price · tokens (E,), at one price of a token or each episode's (E,)."""
        return self.error_cost + price * self.tokens


def run_beside(task: Task, policies: Sequence[Policy], episodes: int, seed: int) -> list[Brief]:
    """What ``run_episodes`` finds of each policy, up to rounding, in the time of one large batch.

    Every policy meets the noise of the seeds ``seed``, ``seed + 1``, …; a step's cost hardly
    depends on the number of runs as long as that is some hundred.

    Raises:
        ConfigurationError: no policies, policies that look at different owners' beliefs, fewer
            than one episode, or a negative seed.
        LookupError: a policy looks at a signal that the task withholds.
    """
    validation.integer("episodes", episodes, at_least=1)
    validation.integer("seed", seed, at_least=0)
    owners = {owner_of(policy) for policy in policies}
    if len(owners) != 1:
        raise ConfigurationError(
            f"policies that look at the beliefs of {sorted(map(str, owners))} are not allowed "
            "beside each other: there must be some, and all must look at the same owner's"
        )
    runs = len(policies) * episodes
    for policy in policies:
        policy.reset(episodes, seed)
    parts = np.arange(runs).reshape(len(policies), episodes)
    refused = [refused_signals(policy, task) for policy in policies]

    def requests(signals: Signals) -> Requests:
        whole = _Whole(signals)
        request = [
            policy(whole.part(part).limit(withheld))
            for policy, part, withheld in zip(policies, parts, refused, strict=True)
        ]
        return np.concatenate(request, axis=-1)

    batch = _batch(task, owners.pop(), seed + np.arange(runs) % episodes)
    brief = _run(batch, requests)
    return [Brief(*(values[part] for values in brief)) for part in parts]


def run_priced(task: Task, policy: Policy, seeds: Runs, prices: Array) -> Brief:
    """One policy in the episodes of N seeds side by side, each at its own price of a token (N,).

    Its signals and the reward hold that price, whatever the task's is.

    Raises:
        LookupError: the policy looks at a signal that the task withholds.
    """
    batch = _batch(task, owner_of(policy), seeds)
    batch.price = np.array(prices, dtype=np.float64)
    policy.reset(len(seeds), int(seeds[0]))
    refused = refused_signals(policy, task)
    return _run(batch, lambda signals: policy(signals.limit(refused)))


def _batch(task: Task, owner: Owner | None, seeds: Runs) -> EpisodeBatch:
    batch = EpisodeBatch(task, len(seeds), owner)
    batch.seed(np.arange(len(seeds)), seeds.tolist())
    batch.reset()
    return batch


def _run(batch: EpisodeBatch, requests: Callable[[Signals], Requests]) -> Brief:
    """The first episode of all runs of a batch."""
    sums, horizon = np.zeros((4, batch.num_envs)), batch.task.horizon
    for _ in range(horizon):
        outcome = batch.step(requests(batch.signals()))
        squared_error = outcome.squared_error.sum(0)
        step = (outcome.granted.mean(0), squared_error, -outcome.reward_error, outcome.cost)
        for total, values in zip(sums, step, strict=True):
            total += values
    return Brief(*(sums / horizon))


class _Whole:
    """The signals of all runs, from which each policy takes those of its own."""

    def __init__(self, signals: Signals) -> None:
        self._signals = signals
        self._beliefs: dict[str, _Once] = {}

    def part(self, runs: Runs) -> Signals:
        """The signals of some runs alone; nothing is computed before it is looked at."""
        values: dict[str, Callable[[], Any]] = {
            name: partial(self._take, name, runs) for name in self._signals
        }
        return Signals(values, missing=self._signals.withheld)

    def _take(self, name: str, runs: Runs) -> Any:
        if name in self._beliefs:
            return _Part(self._beliefs[name], runs)
        value: Any = self._signals[name]
        if isinstance(value, Beliefs):
            self._beliefs[name] = _Once(value)
            return _Part(self._beliefs[name], runs)
        if name == "token_cost":  # the same for all runs
            return value
        if name == "observation":  # the one with the batch first
            return value[runs]
        return take_runs(value, runs)


class _Once:
    """Beliefs of all runs, whose sums over several steps are computed once for all policies."""

    def __init__(self, beliefs: Beliefs) -> None:
        self.beliefs = beliefs
        self.loss = functools.cache(beliefs.loss)
        self.value = functools.cache(beliefs.value)


class _Part(Beliefs):
    """The beliefs of some runs alone."""

    def __init__(self, whole: _Once, runs: Runs) -> None:
        self.task, self.memory_states = whole.beliefs.task, whole.beliefs.memory_states
        self._whole, self._choices = whole, runs
        self.arrival = take_runs(whole.beliefs.arrival, runs)

    @property
    def silent(self) -> Estimate:
        return take_runs(self._whole.beliefs.silent, self._choices)

    @property
    def sent(self) -> Estimate:
        return take_runs(self._whole.beliefs.sent, self._choices)

    @property
    def best(self) -> Estimate:
        return take_runs(self._whole.beliefs.best, self._choices)

    @property
    def memory_posterior(self) -> Any:
        return take_runs(self._whole.beliefs.memory_posterior, self._choices)

    def loss(self, steps: int = 1) -> Array:
        return np.asarray(take_runs(self._whole.loss(steps), self._choices))

    def value(self, steps: int = 1) -> Array:
        return np.asarray(take_runs(self._whole.value(steps), self._choices))
