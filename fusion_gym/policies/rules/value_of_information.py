"""Transmit a packet whose expected improvement of the estimate exceeds a price or threshold."""

from dataclasses import dataclass

import numpy as np

from fusion_gym.core.knowledge import Signals
from fusion_gym.errors import forbidden
from fusion_gym.policies.base import Requests, check_at_most, check_price, parameter, strongest
from fusion_gym.policies.belief_rule import BeliefRule


@dataclass
class ValueOfInformation(BeliefRule):
    r"""Request the sensors whose packet has a value of at least ``threshold``, or of its price.

    The value is v(s) = ‖x* - x̂‖² - E‖x* - x̂(s)‖². x* is the best estimate, x̂ the centre's estimate
    without transmissions and x̂(s) its estimate after the packet of s only
    (:mod:`fusion_gym.core.beliefs`). With memory x* uses all unsent measurements, without memory
    the measurements of this step. The norm has the weights of the reward, scaled to a mean of 1. In
    most settings this is the strongest rule, above all with memory.

    Args:
        own: every sensor decides locally, by its memory and the broadcasts.
        threshold: θ >= 0, in squared units of the states; 0.03 without a price.
        price: price of a token in the reward's units, instead of the threshold.
        at_most: most requests in a step, by the highest value; None for no limit.

    Raises:
        ConfigurationError: both thresholds, a value that is not allowed, ``at_most`` with
            ``own``, or a task whose policies do not see the sensors.

    Equation:
        $$
        v(s)=\lVert x^\star-\hat x\rVert_W^2-\mathrm{E}\,\lVert x^\star-\hat x(s)\rVert_W^2,\qquad
        \delta_s(t)=1\Rightarrow v(s)\ge\theta
        $$

        x* is the best estimate, x̂ the centre's estimate without transmissions, x̂(s) its estimate
        after a transmission of s only; the expectation is over the packet's arrival. W are the
        reward's weights with mean 1, θ is ``threshold``. With ``price`` p instead, v in the
        reward's units must reach p times the tokens of the transmission. With ``at_most``, the
        sensors of the highest value are requested.

    Assumes: x* is the conditional mean given the knowledge of its owner, and only this step counts.

    Sources: :mod:`fusion_gym.core.beliefs` lists them.

    Example: ``value_of_information:threshold=0.03,at_most=1`` in ``fusion_gym/TobitOscillator-v1
    filter=tobit random_start=True token_rate=2 memory=True``.
    """

    threshold: float | None = parameter(None, check_price)
    price: float | None = parameter(None, check_price)
    at_most: int | None = parameter(None, check_at_most)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.threshold is not None and self.price is not None:
            reason = "leave one of them out"
            raise forbidden("price", self.price, reason, f"with threshold = {self.threshold}")

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        value = self.beliefs(signals).value
        if self.price is None:
            least = np.asarray(0.03 if self.threshold is None else self.threshold)
        else:
            value = self.task.error_scale * value
            least = self.price * signals["token_cost"]
        return strongest(value, value >= least, self.at_most, signals["age"])
