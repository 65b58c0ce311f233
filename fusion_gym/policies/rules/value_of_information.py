"""Transmit what is worth it: the change of the estimate that a packet brings, against a price."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fusion_gym import validation
from fusion_gym.core.system import Signals
from fusion_gym.policies.base import Requests, check_at_most, parameter, strongest
from fusion_gym.policies.belief_rule import BeliefRule
from fusion_gym.validation import ConfigurationError


def _optional(name: str, value: float | None) -> None:
    if value is not None:
        validation.number(name, value, at_least=0.0)


@dataclass
class ValueOfInformation(BeliefRule):
    r"""Request the sensors whose transmission is worth at least ``threshold``, or its ``price``.

    v(s) = ‖x* - x̂‖² - E‖x* - x̂(s)‖² with x* the estimate that could be made, x̂ the centre's if
    nobody transmits and x̂(s) if s alone does (:mod:`fusion_gym.core.beliefs`): with memory x*
    holds all that was measured and not sent, without it this step's measurements. The norm has
    the reward's weights, of mean 1. It is the strongest rule in most settings, above all with
    memory.

    Args:
        own: every sensor decides locally, by its memory and what it receives.
        threshold: θ >= 0, in squared units of the states; 0.03 where no price is given either.
        price: of a token, in the reward's units, in the place of the threshold.
        at_most: most sensors requested in a step, those of the highest value; None for no limit.
        steps: steps ahead over which the distances are summed, without noise and further
            transmissions.

    Raises:
        ConfigurationError: both thresholds, a value that is not allowed, ``at_most`` or ``steps``
            with ``own``, or a task whose policies do not see the sensors.

    Equation:
        $$
        v(s)=\lVert x^\star-\hat x\rVert_W^2-\mathrm{E}\,\lVert x^\star-\hat x(s)\rVert_W^2,\qquad
        \delta_s(t)=1\Rightarrow v(s)\ge\theta
        $$

        x* is the best estimate that could be made, x̂ the centre's if nobody transmits, x̂(s) if s
        alone transmits; the expectation is over the packet's arrival. W are weights of mean 1 as in
        the reward, θ is ``threshold``. With ``price`` p in its place, v in the reward's units must
        reach p times the tokens of the transmission. Of those, the ``at_most`` of the highest
        value; with ``steps`` h the squares are summed over h steps ahead.

    Assumes: x* is the conditional mean given all that its owner knows, and that what counts is
    the next ``steps`` steps.

    Sources: see :mod:`fusion_gym.core.beliefs`.

    Example: ``value_of_information:threshold=0.03,at_most=1`` in ``fusion_gym/TobitOscillator-v1
    filter=tobit random_start=True token_rate=2 memory=True``.
    """

    threshold: float | None = parameter(None, _optional)
    price: float | None = parameter(None, _optional)
    at_most: int | None = parameter(None, check_at_most)
    steps: int = parameter(1, validation.integer, at_least=1, at_most=validation.MOST_STEPS)
    together: ClassVar[tuple[str, ...]] = ("at_most", "steps")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.threshold is not None and self.price is not None:
            raise ConfigurationError(
                f"price = {self.price} is not allowed beside threshold = {self.threshold}: one of "
                "them must be left out"
            )

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        value = self.beliefs(signals).value(self.steps)
        if self.price is None:
            least = np.asarray(0.03 if self.threshold is None else self.threshold)
        else:
            value = self.task.error_scale * value
            least = self.price * signals["token_cost"]
        return strongest(value, value >= least, self.at_most, signals["age"])
