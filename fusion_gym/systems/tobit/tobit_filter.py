"""The standard Tobit Kalman filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_gym import gaussian, linalg
from fusion_gym.arrays import Array
from fusion_gym.systems.tobit.filters import Expectation, Plan, linear_update
from fusion_gym.systems.tobit.sensors import CensoredSensors


def expect_censored(sensors: CensoredSensors, mean: Array) -> Expectation:
    """Moments of a censored measurement, given the predicted state (sensors, n, N).

    With ζ = (τ - C x̂)/√R: q = 1 - Φ(ζ), λ = φ(ζ)/q, ŷ = q (C x̂ + λ √R) + (1 - q) τ.
    Source: tobit_token_bucket, equations (5)-(7) and (23).
    """
    latent = linalg.matvec(sensors.measurement_matrix, mean)
    return censored_moments(sensors, latent, sensors.deviation)


def censored_moments(sensors: CensoredSensors, latent: Array, deviation: Array) -> Expectation:
    """Moments of clip(z, τ, υ) for z ~ N(latent, deviation²), both (sensors, m, N).

    ``noise_variance`` is the total variance of the censored value; ``hazard`` and
    ``truncated_variance`` are mean and variance of the standardised z given that it is uncensored.
    """
    if sensors.two_sided:
        return _two_sided_moments(sensors, latent, deviation)
    moments = gaussian.tobit_moments((sensors.threshold - latent) / deviation)
    q = moments.uncensored_probability
    excess = np.where(sensors.uncensored, 0.0, moments.excess)
    variance = q * moments.truncated_variance + q * (1.0 - q) * excess * excess
    value = q * (latent + deviation * moments.hazard) + (1.0 - q) * sensors.finite_threshold
    return Expectation(
        latent=latent,
        value=value,
        noise_variance=deviation * deviation * variance,
        uncensored_probability=q,
        hazard=moments.hazard,
        truncated_variance=moments.truncated_variance,
    )


def _two_sided_moments(sensors: CensoredSensors, latent: Array, deviation: Array) -> Expectation:
    """With a, b the probabilities below and above and p between: y has mean a τ + b υ + p centre.

    The variance is that within the interval and, by the law of total variance, that between the
    three values τ, υ and centre. Source: round_robin_tobit, equations (9), (12)-(14), (20).
    """
    low = (sensors.threshold - latent) / deviation
    high = (sensors.upper - latent) / deviation
    moments = gaussian.interval_moments(low, high)
    below, above = gaussian.upper_tail(-low), gaussian.upper_tail(high)
    inside = moments.probability
    centre = latent + deviation * moments.mean
    to_low = np.where(np.isinf(sensors.threshold), 0.0, centre - sensors.finite_threshold)
    to_high = np.where(np.isinf(sensors.upper), 0.0, sensors.finite_upper - centre)
    between = (
        below * inside * to_low**2
        + inside * above * to_high**2
        + below * above * (to_low + to_high) ** 2
    )
    return Expectation(
        latent=latent,
        value=below * sensors.finite_threshold + above * sensors.finite_upper + inside * centre,
        noise_variance=inside * deviation**2 * moments.variance + between,
        uncensored_probability=inside,
        hazard=moments.mean,
        truncated_variance=np.clip(moments.variance, 1e-12, 1.0),
    )


@dataclass(frozen=True)
class TobitKalmanFilter:
    """Tobit Kalman filter; when nothing arrives the prior is the posterior.

    S = q C P Cᵀ q + R v, K = P Cᵀ q S⁻¹ with q, v of :func:`expect_censored`.
    Source: Allik et al., "The Tobit Kalman filter" (IEEE Trans. Control Syst. Technol. 24, 2016);
    tobit_token_bucket, equations (21)-(23) with κ₁ = 1 and S = diag(R v).
    """

    sensors: CensoredSensors

    def expect(self, mean: Array) -> Expectation:
        """See :class:`NodeFilter`."""
        return expect_censored(self.sensors, mean)

    def plan(
        self, mean: Array, covariance: Array, expectation: Expectation, held: Array, time: Array
    ) -> Plan:
        """See :class:`NodeFilter`; ``held`` and ``time`` do not matter here."""
        weighted = expectation.uncensored_probability[:, :, None] * self.sensors.measurement_matrix
        innovation = linalg.congruence(weighted, covariance)
        noise = self.sensors.variance * expectation.truncated_variance
        innovation = linalg.add_diagonal(innovation, noise)
        correction, posterior = linear_update(covariance, weighted, innovation)
        return Plan(correction, posterior, mean, covariance)
