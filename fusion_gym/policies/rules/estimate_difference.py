"""Transmit when the best estimate differs enough from the centre's estimate."""

from dataclasses import dataclass

import numpy as np

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.beliefs import Beliefs
from fusion_gym.core.knowledge import Signals
from fusion_gym.policies.base import Requests, check_at_most, parameter, strongest
from fusion_gym.policies.belief_rule import BeliefRule


@dataclass
class EstimateDifference(BeliefRule):
    r"""Request the sensors of the highest value when ‖x* - x̂‖ >= ``threshold``.

    x* is the best estimate and x̂ the centre's estimate without transmissions
    (:mod:`fusion_gym.core.beliefs`). The norm has the weights of the reward, scaled to a mean of 1,
    and the unit of the states. With ``own`` and without memory it is the change of the estimate by
    the sensor's own measurement.

    Args:
        own: every sensor decides locally, by its memory and the broadcasts.
        threshold: θ >= 0, in the unit of the states, or without a unit.
        whitened: weigh by the inverse of the centre's claimed covariance.
        at_most: most requests in a step, by the highest value; None for no limit.

    Raises:
        ConfigurationError: a value that is not allowed, ``at_most`` with ``own``, or a task whose
            policies do not see the sensors.

    Equation:
        $$
        \lVert x^\star-\hat x\rVert_W\ge\theta\ \Rightarrow\ \text{request the sensors of the
        highest value}\ v(s)
        $$

        x* is the best estimate, x̂ the centre's estimate without transmissions, W the reward's
        weights with mean 1 (with ``whitened`` P⁻¹, P the centre's covariance of x̂), θ
        ``threshold``, v as in
        :class:`~fusion_gym.policies.rules.value_of_information.ValueOfInformation`; ``at_most``
        sensors are requested. With ``own`` every sensor compares its own x* and x̂.

    Assumes: x* is the conditional mean given the knowledge of its owner. The squared error is then
    the squared error of x*, which no decision changes, plus the squared difference.

    Sources: Y. Xu and J. P. Hespanha, "Optimal communication logics in networked control systems",
    IEEE CDC 2004; G. M. Lipsa and N. C. Martins, "Remote state estimation with communication costs
    for first-order LTI systems", IEEE Trans. Automatic Control 56, 2011.

    Example: ``estimate_difference:threshold=0.25`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2 memory=True``.
    """

    threshold: float = parameter(0.2, validation.number, at_least=0.0)
    whitened: bool = parameter(False, validation.boolean)
    at_most: int | None = parameter(1, check_at_most)

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        beliefs, age = self.beliefs(signals), signals["age"]
        squared = _whitened(beliefs) if self.whitened else beliefs.loss
        requests = np.broadcast_to(squared >= self.threshold * self.threshold, age.shape)
        if self.own or self.at_most is None:
            return requests.copy()
        return strongest(beliefs.value, requests, self.at_most, age)


def _whitened(beliefs: Beliefs) -> Array:
    """Return (x* - x̂)ᵀ P⁻¹ (x* - x̂), with P the centre's covariance of x̂ (k, N)."""
    difference, covariance = beliefs.difference, beliefs.silent.covariance
    return linalg.dot(difference, linalg.solve_vector(covariance, difference))
