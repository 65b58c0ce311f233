"""The Kalman filter that takes a censored value at face value."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_gym import linalg
from fusion_gym.filters.base import Expectation, Plan, linear_update
from fusion_gym.sensors import CensoredSensors
from fusion_gym.validation import Array


@dataclass(frozen=True)
class KalmanFilter:
    """Kalman filter that ignores censoring; when nothing arrives the prior is the posterior.

    S = C P Cᵀ + R, K = P Cᵀ S⁻¹. Biased wherever measurements are censored: it stands beside the
    Tobit filters to show what they are worth.
    """

    sensors: CensoredSensors

    def expect(self, mean: Array) -> Expectation:
        """See :class:`fusion_gym.filters.NodeFilter`."""
        latent = linalg.matvec(self.sensors.measurement_matrix, mean)
        one = np.ones_like(latent)
        return Expectation(
            latent=latent,
            value=latent,
            noise_variance=self.sensors.variance * one,
            uncensored_probability=one,
            hazard=np.zeros_like(latent),
            truncated_variance=one,
        )

    def plan(
        self, mean: Array, covariance: Array, expectation: Expectation, held: Array, time: Array
    ) -> Plan:
        """See :class:`fusion_gym.filters.NodeFilter`; ``held`` and ``time`` do not matter here."""
        matrix = self.sensors.measurement_matrix
        innovation = linalg.congruence(matrix, covariance)
        innovation = linalg.add_diagonal(innovation, self.sensors.variance)
        correction, posterior = linear_update(covariance, matrix, innovation)
        return Plan(correction, posterior, mean, covariance)
