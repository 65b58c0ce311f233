"""Silence as information: a silent measurement lies in an interval that its trigger leaves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.declaration import plain_options
from fusion_gym.errors import refusal
from fusion_gym.gaussian import interval_moments
from fusion_gym.linalg import TOLERANCE

Trigger = Literal["innovation_threshold", "report_on_change", "send_on_delta"]
# Parameter of each trigger that bounds a silent measurement.
_PARAMETERS = {
    "innovation_threshold": "threshold",
    "report_on_change": "reportable_change",
    "send_on_delta": "threshold",
}
_LEAST = 1e-300


@dataclass(frozen=True)
class Silence:
    r"""The interval of a silent measurement, and the moments of its prediction given silence.

    Equation:
        $$
        y\in(c-\theta,\ c+\theta),\qquad \Pr\{\text{silent}\mid y\}=p+(1-p)\,1[\,|y-c|<\theta\,]
        $$

        c is the last delivered value under ``send_on_delta`` and ``report_on_change``, and the
        predicted measurement under ``innovation_threshold``. θ is ``trigger_threshold``, for the
        first two less a millionth, as in the rules. p is the probability that a request would have
        failed: 1 where the tokens would not have paid for it, and else the probability of a loss.

    Assumes: the policy ``trigger`` with this threshold and without a min_interval.

    Source: J. Sijs and M. Lazar, "Event based state estimation with time synchronous updates",
    IEEE Trans. Automatic Control 57, 2012; J. Wu, Q.-S. Jia, K. H. Johansson and L. Shi,
    "Event-based sensor data scheduling: trade-off between communication rate and estimation
    quality", IEEE Trans. Automatic Control 58, 2013.
    """

    trigger: Trigger
    threshold: Array

    @classmethod
    def create(cls, options: Any, sensors: int, channels: int) -> Silence:
        """Return the silence of the options ``trigger`` and ``trigger_threshold``.

        Args:
            options: name of the policy, and one number >= 0 or one per sensor.
            sensors: number of sensors.
            channels: number of channels of a sensor.

        Raises:
            ConfigurationError: an option is missing or not allowed, or a sensor has several
                channels and the trigger is not ``report_on_change``.
        """
        trigger, threshold = options.trigger, options.trigger_threshold
        if trigger is None or threshold is None:
            missing = "trigger" if trigger is None else "trigger_threshold"
            allowed = "that of the policy whose silence the filter reads"
            raise refusal(missing, None, allowed, "with filter='truncated'")
        if channels > 1 and trigger != "report_on_change":
            raise refusal("trigger", trigger, "'report_on_change'", "for several channels")
        checked = validation.not_negative("trigger_threshold", threshold, (sensors,))
        return cls(trigger, checked[:, None])

    @property
    def policy_defaults(self) -> dict[str, dict[str, Any]]:
        """The parameters of the trigger's policy."""
        threshold = tuple(plain_options(self.threshold[:, 0]))
        return {self.trigger: {_PARAMETERS[self.trigger]: threshold}}

    def middle(self, held: Array, expected: Array) -> Array:
        """Return the middle c of the interval from held values and predicted measurements."""
        return expected if self.trigger == "innovation_threshold" else held

    def moments(
        self, threshold: Array, shift: Array, deviation: Array, failure: Array | float
    ) -> tuple[Array, Array]:
        """Return mean and variance (…, N) of the standardised prediction, given silence.

        Args:
            threshold: θ.
            shift: c minus the predicted measurement.
            deviation: deviation of the prediction.
            failure: p.
        """
        narrow = 0.0 if self.trigger == "innovation_threshold" else TOLERANCE
        width = np.maximum((1.0 - narrow) * threshold, _LEAST)
        low, high = (shift - width) / deviation, (shift + width) / deviation
        inside = interval_moments(low, np.maximum(high, np.nextafter(low, np.inf)))
        likely = (1.0 - failure) * np.where(threshold > 0.0, inside.probability, 0.0)
        total = failure + likely
        # Silence that is impossible is taken for the interval.
        share = np.where(total > 0.0, likely / np.where(total > 0.0, total, 1.0), 1.0)
        mean = share * inside.mean
        square = 1.0 - share + share * (inside.variance + inside.mean**2)
        return mean, square - mean**2
