"""A centre for which silence is information: a silent measurement lies in a known interval."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.errors import refusal
from fusion_gym.gaussian import interval_moments
from fusion_gym.systems.tobit.centre import (
    Centre,
    CentrePrediction,
    FederatedCentre,
    Feedback,
    Gaussian,
    Packets,
)
from fusion_gym.systems.tobit.filters import KalmanFilter
from fusion_gym.systems.tobit.options import refuse_fusion
from fusion_gym.systems.tobit.sensors import CensoredSensors

# Parameter of each trigger that bounds a silent measurement.
TRIGGERS = {
    "innovation_threshold": "threshold",
    "report_on_change": "reportable_change",
    "send_on_delta": "threshold",
}


@dataclass(frozen=True)
class TruncatedCentre(FederatedCentre):
    r"""Kalman filter for which silence is a measurement in an interval, by moment matching.

    The centre processes the deliveries first, then each channel of the silent sensors. A channel's
    prediction is truncated to the interval that its trigger leaves silent, and the posterior of the
    truncation is taken to be Gaussian.

    Equation:
        $$
        \text{silent:}\quad y\in(c-\theta,\ c+\theta),\qquad S=C P C^{\mathsf T}+R,\qquad
        z=\frac{y-C\hat x}{\sqrt S}
        $$

        $$
        \hat x^{+}=\hat x+\frac{P C^{\mathsf T}}{\sqrt S}\,\mathrm E[z],\qquad
        P^{+}=P-\frac{P C^{\mathsf T}C P}{S}\,(1-\mathrm{var}\,z)
        $$

        z is a standard normal truncated to the interval. Its centre c is the last delivered value
        under ``send_on_delta`` and ``report_on_change``, and the predicted measurement under
        ``innovation_threshold``. θ is ``trigger_threshold``. A silent sensor whose request the
        tokens would not have paid for gives no information.

    Assumes: a linear plant, Gaussian noises, uncensored sensors, the trigger of the option
    ``trigger`` with this threshold and without a min_interval.

    Source: J. Sijs and M. Lazar, "Event based state estimation with time synchronous updates",
    IEEE Trans. Automatic Control 57, 2012; J. Wu, Q.-S. Jia, K. H. Johansson and L. Shi,
    "Event-based sensor data scheduling: trade-off between communication rate and estimation
    quality", IEEE Trans. Automatic Control 58, 2013.
    """

    trigger: str
    threshold: Array

    local_means = Centre.local_means

    @property
    def predictable(self) -> bool:
        """See :class:`Centre`."""
        return False

    @property
    def separable(self) -> bool:
        """See :class:`Centre`."""
        return False

    @property
    def reads_silence(self) -> bool:
        """See :class:`Centre`."""
        return True

    @property
    def numpy_only(self) -> str | None:
        """See :class:`Centre`."""
        return "filter"

    def predict(self, mean: Array, covariance: Array, held: Array, time: Array) -> CentrePrediction:
        """See :class:`Centre`; ``time`` has no effect."""
        return super().predict(mean, covariance, held, time)._replace(held=held)

    def update(
        self, prior: Gaussian, prediction: CentrePrediction, measurement: Array, granted: Packets
    ) -> Gaussian:
        """See :class:`Centre`."""
        mean, covariance = super().update(prior, prediction, measurement, granted)
        silent = ~granted if prediction.possible is None else ~granted & prediction.possible
        silent = silent & (self.threshold > 0.0)
        middle = prediction.held
        if self.trigger == "innovation_threshold":
            middle = prediction.expectation.value
        for sensor in np.flatnonzero(silent.any(-1)):
            for channel in range(self.sensors.size):
                row = self.sensors.measurement_matrix[sensor, channel]
                across = linalg.matvec(covariance, row)
                variance = (row * across).sum(0) + self.sensors.variance[sensor, channel]
                deviation = np.sqrt(variance)
                shift = middle[sensor, channel] - (row * mean).sum(0)
                width = np.maximum(self.threshold[sensor], 1e-300)
                low, high = (shift - width) / deviation, (shift + width) / deviation
                moments = interval_moments(low, np.maximum(high, np.nextafter(low, np.inf)))
                gain = np.where(silent[sensor], across / deviation, 0.0)
                mean = mean + gain * moments.mean
                covariance = covariance - (1.0 - moments.variance) * linalg.outer(gain, gain)
        return mean, covariance

    def variances(
        self, prior: Gaussian, prediction: CentrePrediction, weights: Array
    ) -> tuple[Array, Array]:
        """See :class:`Centre`; packets that hold the expected measurement."""
        expected, runs = prediction.expectation.value, prior[0].shape[-1]

        def trace(granted: Packets) -> Array:
            whole = np.broadcast_to(granted[:, None], (self.sensors.count, runs))
            return linalg.weighted_trace(
                self.update(prior, prediction, expected, whole)[1], weights
            )

        single = np.stack([trace(own) for own in np.eye(self.sensors.count, dtype=np.bool_)])
        silent = trace(np.zeros(self.sensors.count, dtype=np.bool_))
        return silent, silent - single


def truncated_centre(options: Any, sensors: CensoredSensors) -> TruncatedCentre:
    """Return the centre of ``filter="truncated"``.

    Args:
        options: options of the environment.
        sensors: the sensors.

    Raises:
        ConfigurationError: an option of the nodes' fusion, censored sensors, a trigger that is
            missing or measures several channels together, or a threshold that is not allowed.
    """
    refuse_fusion(options, "truncated")
    where = "with filter='truncated'"
    if not sensors.unlimited:
        allowed = "'kalman', 'tobit' or 'adf' with censored sensors"
        raise refusal("filter", "truncated", allowed)
    if options.trigger is None or options.trigger_threshold is None:
        name = "trigger" if options.trigger is None else "trigger_threshold"
        raise refusal(name, None, "the policy whose silence the filter reads", where)
    if sensors.size > 1 and options.trigger != "report_on_change":
        raise refusal("trigger", options.trigger, "'report_on_change'", "for several channels")
    threshold = validation.not_negative(
        "trigger_threshold", options.trigger_threshold, (sensors.count,)
    )
    feedback = Feedback.in_full(sensors.count)
    return TruncatedCentre(KalmanFilter(sensors), feedback, options.trigger, threshold[:, None])
