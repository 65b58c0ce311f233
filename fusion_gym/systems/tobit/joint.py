"""The Kalman filter of all delivered measurements together, whose noises may be correlated."""

from dataclasses import dataclass

import numpy as np

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.namespace import active_rows, namespace
from fusion_gym.systems.tobit.centre import (
    Centre,
    CentrePrediction,
    FederatedCentre,
    Gaussian,
    Packets,
)
from fusion_gym.systems.tobit.filters import KalmanFilter, joint_update
from fusion_gym.systems.tobit.sensors import CensoredSensors
from fusion_gym.validation import ConfigurationError

_MOST_CHANNELS = 100  # whose joint covariance is solved in every step


@dataclass(frozen=True)
class JointCentre(FederatedCentre):
    r"""Kalman filter at the centre, of all deliveries of a step, without nodes.

    With C and y the delivered rows and R the joint covariance of their noises: S = C P Cᵀ + R, K =
    P Cᵀ S⁻¹, x̂ = x⁻ + K (y - C x⁻), P = P⁻ - K C P⁻. It is optimal for uncensored sensors and
    ignores censoring.

    Equation:
        $$
        S=C P C^{\mathsf T}+R,\qquad K=P C^{\mathsf T}S^{-1}
        $$

        $$
        \hat x^{+}=\hat x+K(y-C\hat x),\qquad P^{+}=P-K C P
        $$

        y and C stack the measurements of all sensors that have arrived in the step, and R is the
        covariance of their noises, correlations between sensors included. When nothing arrives the
        prediction stays.

    Assumes: a linear plant, Gaussian noises whose joint covariance is known, uncensored sensors,
    and transmissions that are not chosen by the noise.

    Source: B. D. O. Anderson and J. B. Moore, "Optimal Filtering", 1979, chapter 3.
    """

    def update(
        self, prior: Gaussian, prediction: CentrePrediction, measurement: Array, granted: Packets
    ) -> Gaussian:
        """See :class:`Centre`."""
        mean, covariance = prior
        xp, sensors, runs = namespace(granted), self.sensors, granted.shape[-1]
        every = xp.repeat(granted, sensors.size, axis=0)
        channels = active_rows(every)
        if not channels.size:
            return mean, covariance
        taken = every[channels].astype(np.float64)
        innovation = (measurement - prediction.expectation.value).reshape(-1, runs)[channels]
        # A channel that has not arrived stands for nothing, with a variance of 1.
        noise = taken[:, None] * taken * sensors.noise_covariance[np.ix_(channels, channels)]
        matrix = linalg.matmul(sensors.stacked_matrix[channels], prediction.root)
        both = taken[:, None] * xp.concatenate([matrix, innovation[:, None]], axis=1)
        both = linalg.whiten(linalg.add_diagonal(noise, 1.0 - taken), both)
        shift, posterior = joint_update(both[:, :-1], both[:, -1])
        posterior = linalg.congruence(prediction.root, posterior)
        mean = mean + linalg.matvec(prediction.root, shift)
        return mean, xp.where(granted.any(0), posterior, covariance)

    local_means = Centre.local_means


def joint_centre(sensors: CensoredSensors) -> JointCentre:
    """Return the centre of ``filter="joint"``.

    Args:
        sensors: the sensors.

    Raises:
        ConfigurationError: more than 100 channels.
    """
    channels = sensors.noise_channels
    if channels > _MOST_CHANNELS:
        raise ConfigurationError(
            f"filter = 'joint' is not allowed with {sensors.count} sensors of {sensors.size} "
            f"channels: together they may have at most {_MOST_CHANNELS}, because a step costs "
            "their cube; with independent noises 'kalman' is the same filter"
        )
    return JointCentre(KalmanFilter(sensors), np.ones((sensors.count, 1)))
