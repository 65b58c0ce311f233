"""Measure the cross term between the mismatch and the floor of the error.

With x̂ the centre's estimate and x* the estimate of a filter that processes every measurement,

    E‖x - x̂‖² = E‖x - x*‖² + E‖x* - x̂‖² + 2 E⟨x - x*, x* - x̂⟩,

in the weights of the reward: error, floor, mismatch, cross term. The cross term is zero for every
policy if x* is the conditional mean given all that x̂ and the policy use. If x* is an
approximation, the cross term need not be zero, and training on the mismatch is biased.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.estimator import Estimator
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import BATCH
from fusion_gym.evaluation.intervals import LEVEL, Interval, mean_interval
from fusion_gym.evaluation.policy_batch import seeded
from fusion_gym.policies.base import Policy, decide, owner_of


class CrossTerm(NamedTuple):
    """The parts of a policy's error, each a mean over steps and episodes.

    Args:
        rate: transmissions per sensor and step.
        error: squared error in the weights of the reward, scaled to a mean of 1.
        floor: the part E‖x - x*‖², in the same weights.
        mismatch: the part E‖x* - x̂‖², in the same weights.
        share: share of the cross term in the error, with its interval.
    """

    rate: float
    error: float
    floor: float
    mismatch: float
    share: Interval

    @property
    def compatible(self) -> bool:
        """Whether the interval of the share contains zero."""
        return self.share.low <= 0.0 <= self.share.high

    @property
    def text(self) -> str:
        """The share with its interval, as text."""
        return f"{self.share.mean:+.2%} [{self.share.low:+.2%}, {self.share.high:+.2%}]"


def cross_terms(
    task: Task,
    reference: Estimator[Any],
    policies: Mapping[str, Policy],
    episodes: int,
    seed: int,
    level: float = LEVEL,
) -> dict[str, CrossTerm]:
    """Estimate the cross term under each policy, on consecutive seeds from ``seed``.

    All intervals hold together with the probability ``level`` (Bonferroni).

    Args:
        task: the task.
        reference: the estimator that processes every measurement
            (:func:`~fusion_gym.envs.privileged.reference_estimator`).
        policies: policies by name.
        episodes: episodes of each policy, >= 2.
        seed: seed of the first episode, >= 0.
        level: joint confidence level of all intervals.

    Raises:
        ConfigurationError: fewer than two episodes, which have no interval, or a negative seed.
        LookupError: a policy uses a signal that the task withholds.
    """
    validation.integer("episodes", episodes, at_least=2)
    validation.integer("seed", seed, at_least=0)
    each = 1.0 - (1.0 - level) / max(len(policies), 1)
    result = {}
    for name, policy in policies.items():
        sizes = [(first, min(BATCH, episodes - first)) for first in range(0, episodes, BATCH)]
        parts = [_run(task, reference, policy, many, seed + first) for first, many in sizes]
        result[name] = _summary(np.concatenate(parts, axis=-1), each)
    return result


def worst(terms: Mapping[str, CrossTerm]) -> tuple[str, CrossTerm]:
    """Return the policy of the largest cross term, with significant cross terms first."""
    return max(terms.items(), key=lambda item: (not item[1].compatible, abs(item[1].share.mean)))


def usual_policies(task: Task, rate: float) -> list[str]:
    """Return the texts of two policies that exist in every environment."""
    random = f"random:rate={rate:.4g}"
    if task.information != "sensors":
        return [random, "always"]
    return [random, f"value_of_information:price={task.reward.price.middle:.4g}"]


def _run(
    task: Task, system: Estimator[Any], policy: Policy, episodes: int, seed: int,
) -> Array:  # fmt: skip
    """Return rate, error, floor and mismatch (4, E) of episodes, each a mean over steps."""
    batch = seeded(task, owner_of(policy), seed + np.arange(episodes), system)
    weights, sums = task.relative_weights[:, 0], np.zeros((4, episodes))
    for requests in decide(policy, batch, seed):
        outcome = batch.step(requests)
        least = batch.reference_error
        squared = [error * error for error in (outcome.error, least, outcome.error - least)]
        sums += np.stack((outcome.granted.mean(0), *(weights @ part for part in squared)))
    return sums / task.horizon


def _summary(parts: Array, level: float) -> CrossTerm:
    """Return the means and the share, a ratio of means with the interval of its linearisation."""
    rate, error, floor, mismatch = parts
    cross, total = error - floor - mismatch, float(error.mean())
    if total == 0.0:
        return CrossTerm(float(rate.mean()), 0.0, 0.0, 0.0, Interval(0.0, 0.0, 0.0))
    share = float(cross.mean()) / total
    interval = mean_interval(share + (cross - share * error) / total, level=level)
    return CrossTerm(
        float(rate.mean()), total, float(floor.mean()), float(mismatch.mean()), interval
    )
