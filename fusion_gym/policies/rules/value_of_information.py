"""Transmit what is worth it: the change of the estimate that a packet brings, against a price."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fusion_gym import validation
from fusion_gym.core.system import Signals
from fusion_gym.policies.base import Requests, check_at_most, parameter, strongest
from fusion_gym.policies.believing import BelievingRule
from fusion_gym.validation import ConfigurationError


def _optional(name: str, value: float | None) -> None:
    if value is not None:
        validation.number(name, value, at_least=0.0)


@dataclass
class ValueOfInformation(BelievingRule):
    """Request the sensors whose transmission is worth at least ``threshold``, or its ``price``.

    v(s) = ‖x* - x̂‖² - E‖x* - x̂(s)‖² with x* the estimate that could be made, x̂ the centre's if
    nobody transmits and x̂(s) if s alone does (:mod:`fusion_gym.core.beliefs`): with memory x*
    holds all that was measured and not sent, without it this step's measurements. ``threshold`` is
    in squared units of the states, weighted as in the reward by weights of mean 1; ``price`` is
    that of a token in the reward's units, and v(s) in these must be at least price · tokens. Just
    one of them is given; by default the threshold is 0.03.

    ``at_most`` limits a step to the sensors of highest value (None: no limit). ``steps`` sums the
    distances over as many steps ahead, without noise and further transmissions. With ``own`` every
    sensor decides by itself, on its own memory and what it hears.

    Assumes: x* is the conditional mean given all that its owner knows, and that what counts is
    the next ``steps`` steps.

    Sources: see :mod:`fusion_gym.core.beliefs`.

    Raises:
        ConfigurationError: both thresholds, a value that is not allowed, ``at_most`` or ``steps``
            with ``own``, or a task whose policies do not see the sensors.
    """

    threshold: float | None = parameter(None, _optional)
    price: float | None = parameter(None, _optional)
    at_most: int | None = parameter(None, check_at_most)
    steps: int = parameter(1, validation.integer, at_least=1)
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
