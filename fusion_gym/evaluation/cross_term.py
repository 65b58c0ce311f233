"""Whether the distance to the best estimate can stand for the error: the term that tells.

With x̂ the centre's estimate, and x* that of a filter which takes in every measurement,

    E‖x - x̂‖² = E‖x - x*‖² + E‖x* - x̂‖² + 2 E⟨x - x*, x* - x̂⟩,

in the reward's weights: error, floor, mismatch, cross term. The cross term is zero for every policy
if x* is the conditional mean given all that x̂ and the policy use. Where x* is an approximation it
is not, and a policy that is trained on the mismatch is drawn aside by it.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.system import System
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import BATCH
from fusion_gym.evaluation.intervals import LEVEL, Interval, mean_interval
from fusion_gym.policies.base import Policy, owner_of, refused_signals


class CrossTerm(NamedTuple):
    """What a policy's episodes show of the error's parts, each a mean over steps and episodes.

    ``rate`` of transmissions a sensor and step; ``error``, ``floor`` and ``mismatch`` in the
    reward's weights, scaled to a mean of 1; ``share`` of the cross term in the error.
    """

    rate: float
    error: float
    floor: float
    mismatch: float
    share: Interval

    @property
    def compatible(self) -> bool:
        """Whether the cross term may be zero."""
        return self.share.low <= 0.0 <= self.share.high

    @property
    def text(self) -> str:
        """The share with its interval, as text."""
        return f"{self.share.mean:+.2%} [{self.share.low:+.2%}, {self.share.high:+.2%}]"


def cross_terms(
    task: Task,
    reference: System[Any],
    policies: Mapping[str, Policy],
    episodes: int,
    seed: int,
    level: float = LEVEL,
) -> dict[str, CrossTerm]:
    """The cross term under each policy, in episodes with the seeds ``seed``, ``seed + 1``, …

    ``reference`` is the system, on the same noise, whose filter takes in every measurement
    (:func:`~fusion_gym.envs.privileged.reference_system`). All intervals hold together with the
    probability ``level`` (Bonferroni): where some exclude zero, it is not for their number.

    Raises:
        ConfigurationError: fewer than two episodes, which have no interval, or a negative seed.
        LookupError: a policy looks at a signal that the task withholds.
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
    """The policy with the largest cross term, of those whose may not be zero if there are some."""
    return max(terms.items(), key=lambda item: (not item[1].compatible, abs(item[1].share.mean)))


def usual_policies(task: Task, rate: float) -> list[str]:
    """Two different policies that every environment knows, as texts for ``make_policy``.

    Random requests at a rate, which choose by nothing. And the value of a transmission against the
    price of a token (the middle of a range), which is what an agent comes to look like; where a
    policy may not look at new measurements, every request.
    """
    random = f"random:rate={rate:.4g}"
    if task.information != "sensors":
        return [random, "always"]
    price = task.reward.price
    middle = price.fixed
    if middle is None:
        assert price.span is not None  # Price.create refuses a drawn price without one
        middle = math.sqrt(price.span[0] * price.span[1])
    return [random, f"value_of_information:price={middle:.4g}"]


def _run(
    task: Task, system: System[Any], policy: Policy, episodes: int, seed: int,
) -> Array:  # fmt: skip
    """Rate, error, floor and mismatch (4, E) of episodes, each a mean over steps."""
    batch = EpisodeBatch(task, episodes, owner_of(policy), system)
    batch.seed(np.arange(episodes), [seed + place for place in range(episodes)])
    batch.reset()
    policy.reset(episodes, seed)
    refused = refused_signals(policy, task)
    weights, sums = task.relative_weights[:, 0], np.zeros((4, episodes))
    for _ in range(task.horizon):
        outcome = batch.step(policy(batch.signals().limit(refused)))
        least = batch.reference_error
        squared = [error * error for error in (outcome.error, least, outcome.error - least)]
        sums += np.stack((outcome.granted.mean(0), *(weights @ part for part in squared)))
    return sums / task.horizon


def _summary(parts: Array, level: float) -> CrossTerm:
    """Means, and the share as a ratio of means, whose interval is that of its linear part."""
    rate, error, floor, mismatch = parts
    cross, total = error - floor - mismatch, float(error.mean())
    if total == 0.0:
        return CrossTerm(float(rate.mean()), 0.0, 0.0, 0.0, Interval(0.0, 0.0, 0.0))
    share = float(cross.mean()) / total
    interval = mean_interval(share + (cross - share * error) / total, level=level)
    return CrossTerm(
        float(rate.mean()), total, float(floor.mean()), float(mismatch.mean()), interval
    )
