"""A centre for which silence is information: a silent measurement lies in a known interval."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.errors import refusal
from fusion_gym.systems.silence import Silence
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

        z is a standard normal truncated to the interval (c - θ, c + θ) of
        :class:`~fusion_gym.systems.silence.Silence`. A silent sensor whose request the tokens would
        not have paid for gives no information.

    Assumes: a linear plant, Gaussian noises, uncensored sensors, the trigger of the option
    ``trigger`` with this threshold and without a min_interval.

    Source: J. Sijs and M. Lazar, "Event based state estimation with time synchronous updates",
    IEEE Trans. Automatic Control 57, 2012.
    """

    silence: Silence

    local_means = Centre.local_means
    variances = Centre.variances

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
        silent = silent & (self.silence.threshold > 0.0)
        middle = self.silence.middle(prediction.held, prediction.expectation.value)
        for sensor in np.flatnonzero(silent.any(-1)):
            for channel in range(self.sensors.size):
                row = self.sensors.measurement_matrix[sensor, channel]
                across = linalg.matvec(covariance, row)
                variance = (row * across).sum(0) + self.sensors.variance[sensor, channel]
                deviation = np.sqrt(variance)
                shift = middle[sensor, channel] - (row * mean).sum(0)
                first, second = self.silence.moments(
                    self.silence.threshold[sensor], shift, deviation, 0.0
                )
                gain = np.where(silent[sensor], across / deviation, 0.0)
                mean = mean + gain * first
                covariance = covariance - (1.0 - second) * linalg.outer(gain, gain)
        return mean, covariance


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
    if not sensors.unlimited:
        allowed = "'kalman', 'tobit' or 'adf' with censored sensors"
        raise refusal("filter", "truncated", allowed)
    silence = Silence.create(
        options.trigger, options.trigger_threshold, sensors.count, sensors.size
    )
    feedback = Feedback.in_full(sensors.count)
    return TruncatedCentre(KalmanFilter(sensors), feedback, silence)
