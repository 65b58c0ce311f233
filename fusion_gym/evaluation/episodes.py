"""Running a policy over episodes whose noise is fixed by their seeds."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.fusion.intersection import orthonormalise
from fusion_gym.policies.base import Policy, owner_of, refused_signals

BATCH = 1024  # episodes side by side; fixed, so that results do not depend on the machine


@dataclass(frozen=True)
class EpisodeResults:
    """What E episodes of horizon H brought, each entry averaged over an episode's steps.

    ``mse`` (E,) squared error of the fused estimate, summed over states · ``error_cost`` (E,) the
    error as the reward counts it, >= 0 · ``bound_trace`` (E,) trace of the claimed covariance ·
    ``nees`` (E,) normalised squared error divided by the number of directions with a variance, 1
    for a consistent filter · ``rate`` and ``requests`` (E, sensors) · ``tokens`` (E,) spent and
    ``denied`` (E,) requests refused, per step ·
    ``returns`` (E,) sum of the rewards · ``diverged`` (E,) share of diverged steps ·
    ``squared_error`` (H, n), the mean over episodes at each time and state.
    """

    mse: Array
    error_cost: Array
    bound_trace: Array
    nees: Array
    rate: Array
    requests: Array
    tokens: Array
    denied: Array
    returns: Array
    diverged: Array
    squared_error: Array

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(self.mse)


def run_episodes(
    task: Task,
    policy: Policy,
    episodes: int,
    seed: int,
    progress: Callable[[int], Any] | None = None,
) -> EpisodeResults:
    """Run episodes with the seeds ``seed``, ``seed + 1``, …; the same seed is the same noise.

    ``progress`` is called with the number of environment steps made since its last call.

    Raises:
        ConfigurationError: fewer than one episode, or a negative seed.
        LookupError: the policy looks at a signal that the task withholds.
    """
    validation.integer("episodes", episodes, at_least=1)
    validation.integer("seed", seed, at_least=0)
    parts = [
        _run_batch(task, policy, min(BATCH, episodes - first), seed + first, progress)
        for first in range(0, episodes, BATCH)
    ]
    weights = np.array([part.episodes for part in parts]) / episodes
    joined = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in fields(EpisodeResults)
        if field.name != "squared_error"
    }
    error = sum(w * part.squared_error for w, part in zip(weights, parts, strict=True))
    return EpisodeResults(**joined, squared_error=np.asarray(error))


def _normalised_error(error: Array, covariance: Array) -> Array:
    """Return eᵀ P⁺ e over the rank of P (N,): directions without a variance do not count."""
    result = linalg.dot(error, linalg.solve_vector(covariance, error)) / len(error)
    lanes = np.flatnonzero(np.isnan(result) & np.isfinite(covariance).all((0, 1)))
    if lanes.size:
        root = linalg.root(covariance.take(lanes, axis=-1))
        inverse = orthonormalise(root[None])[:, len(error) : 2 * len(error)]
        unit = linalg.matvec(inverse, error.take(lanes, axis=-1))
        result[lanes] = linalg.dot(unit, unit) / np.maximum(inverse.any(1).sum(0), 1)
    return result


def _run_batch(
    task: Task, policy: Policy, episodes: int, seed: int, progress: Callable[[int], Any] | None
) -> EpisodeResults:
    batch = EpisodeBatch.seeded(task, episodes, seed, owner_of(policy))
    policy.reset(episodes, seed)
    refused = refused_signals(policy, task)
    states, sensors, horizon = len(task.system.state_names), task.sensors, task.horizon
    mse, trace, nees = np.zeros(episodes), np.zeros(episodes), np.zeros(episodes)
    tokens, denied, returns = np.zeros(episodes), np.zeros(episodes), np.zeros(episodes)
    rate, requests = np.zeros((sensors, episodes)), np.zeros((sensors, episodes))
    diverged, error_cost = np.zeros(episodes), np.zeros(episodes)
    squared_error = np.empty((horizon, states))
    for step in range(horizon):
        outcome = batch.step(policy(batch.signals().limit(refused)))
        mean, covariance = task.system.fused(batch.delivered)
        error = task.system.truth(batch.delivered) - mean
        squared_error[step] = outcome.squared_error.mean(-1)
        mse += outcome.squared_error.sum(0)
        trace += linalg.trace(covariance)
        nees += _normalised_error(error, covariance)
        rate += outcome.granted
        requests += outcome.requested
        tokens += outcome.cost
        denied += (outcome.requested & ~outcome.granted).sum(0)
        returns += outcome.reward
        error_cost -= outcome.reward_error
        diverged += outcome.diverged
        if progress is not None:
            progress(episodes)
    return EpisodeResults(
        mse=mse / horizon,
        error_cost=error_cost / horizon,
        bound_trace=trace / horizon,
        nees=nees / horizon,
        rate=(rate / horizon).T,
        requests=(requests / horizon).T,
        tokens=tokens / horizon,
        denied=denied / horizon,
        returns=returns,
        diverged=diverged / horizon,
        squared_error=squared_error,
    )


@dataclass(frozen=True)
class Trajectory:
    """One episode, times 1..H first.

    ``truth`` and ``mean`` (H, n) · ``variance`` (H, n), the diagonal of the claimed covariance ·
    ``local_mean`` (H, sensors, n), before the feedback · ``tokens`` (H,) after each step ·
    ``requested`` and ``granted`` (H, sensors) bool.
    """

    truth: Array
    mean: Array
    variance: Array
    local_mean: Array
    tokens: Array
    requested: NDArray[np.bool_]
    granted: NDArray[np.bool_]


def record_episode(task: Task, policy: Policy, seed: int) -> Trajectory:
    """Everything about the episode with this seed, for figures.

    Raises:
        ConfigurationError: a negative seed.
        LookupError: the policy looks at a signal that the task withholds.
    """
    validation.integer("seed", seed, at_least=0)
    batch = EpisodeBatch.seeded(task, 1, seed, owner_of(policy))
    policy.reset(1, seed)
    refused = refused_signals(policy, task)
    rows: dict[str, list[NDArray[Any]]] = {field.name: [] for field in fields(Trajectory)}
    for _ in range(task.horizon):
        outcome = batch.step(policy(batch.signals().limit(refused)))
        state = batch.delivered
        mean, covariance = task.system.fused(state)
        rows["truth"].append(task.system.truth(state)[:, 0])
        rows["mean"].append(mean[:, 0])
        rows["variance"].append(linalg.diagonal(covariance)[:, 0])
        rows["local_mean"].append(task.system.local_means(state)[..., 0])
        rows["tokens"].append(batch.tokens[0])
        rows["requested"].append(outcome.requested[:, 0])
        rows["granted"].append(outcome.granted[:, 0])
    return Trajectory(**{name: np.array(row) for name, row in rows.items()})
