"""Assumed-density filter: a Gaussian with the exact moments of the censored posterior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion_gym import gaussian, linalg
from fusion_gym.arrays import Array
from fusion_gym.systems.tobit.filters import Expectation
from fusion_gym.systems.tobit.sensors import CensoredSensors
from fusion_gym.systems.tobit.tobit_filter import censored_moments

_FAR = 50.0  # a threshold this many deviations away never censors


@dataclass(frozen=True)
class AssumedDensityFilter:
    """Takes scalar measurements one after another at the centre, sensor by sensor.

    Let S = C P Cᵀ + R, K = P Cᵀ/S and t = (C x̂ - τ)/√S. An uncensored component gets the Kalman
    update. A component at its lower threshold τ moves the mean by -√S h K, and P loses
    P Cᵀ C P h (h - t)/S, with the hazard h = φ(t)/(1 - Φ(t)); at the upper threshold the signs
    are mirrored. These are the exact posterior mean and covariance of a Gaussian prior given
    that event; the posterior is then taken to be Gaussian again.
    """

    sensors: CensoredSensors

    def expect(self, mean: Array, covariance: Array) -> Expectation:
        """Moments of the measurements (sensors, m, N) under the prior (n, N), (n, n, N)."""
        matrix = self.sensors.measurement_matrix
        latent = linalg.matvec(matrix, mean)
        spread = (matrix * linalg.matmul(matrix, covariance)).sum(-2) + self.sensors.variance
        return censored_moments(self.sensors, latent, np.sqrt(spread))

    def update(
        self, mean: Array, covariance: Array, measurement: Array, granted: NDArray[np.bool_]
    ) -> tuple[Array, Array]:
        """Posterior (n, N), (n, n, N) after the granted (sensors, N) measurements."""
        for sensor in range(self.sensors.count):
            if not granted[sensor].any():
                continue
            for component in range(self.sensors.size):
                mean, covariance = self._take(
                    mean, covariance, sensor, component, measurement[sensor, component],
                    granted[sensor],
                )  # fmt: skip
        return mean, covariance

    def expected_covariance(self, mean: Array, covariance: Array) -> Array:
        """Expected posterior covariance (sensors, n, n, N) if one sensor alone delivers.

        Component by component, each with the share of its variance that the possibly censored
        measurement is expected to explain; exact for sensors of one component.
        """
        matrix, noise = self.sensors.measurement_matrix, self.sensors.variance
        latent = linalg.matvec(matrix, mean)
        result = np.broadcast_to(covariance, (self.sensors.count, *covariance.shape))
        for component in range(self.sensors.size):
            row = matrix[:, component]
            cross = linalg.matvec(result, row)
            variance = linalg.dot(row, cross) + noise[:, component]
            share = np.ones_like(variance)
            for sign, threshold in ((1.0, self.sensors.threshold), (-1.0, self.sensors.upper)):
                limit = threshold[:, component]
                distance = sign * (latent[:, component] - limit) / np.sqrt(variance)
                distance = np.where(np.isfinite(limit), distance, _FAR)
                share -= gaussian.upper_tail(distance) * gaussian.truncated_variance(distance)
            result = result - linalg.outer(cross, cross) * (share / variance)[:, None, None]
        return result

    def _take(
        self,
        mean: Array,
        covariance: Array,
        sensor: int,
        component: int,
        value: Array,
        granted: NDArray[np.bool_],
    ) -> tuple[Array, Array]:
        row = self.sensors.measurement_matrix[sensor, component]
        cross = linalg.matvec(covariance, row)
        variance = linalg.dot(row, cross) + self.sensors.variance[sensor, component]
        latent, deviation = linalg.dot(row, mean), np.sqrt(variance)
        step = (value - latent) / variance
        loss = np.ones_like(step)
        for sign, threshold in ((1.0, self.sensors.threshold), (-1.0, self.sensors.upper)):
            limit = threshold[sensor, component]
            if not np.isfinite(limit).all():
                continue
            censored = value <= limit if sign > 0 else value >= limit
            distance = sign * (latent - limit) / deviation
            step = np.where(censored, -sign * gaussian.hazard(distance) / deviation, step)
            loss = np.where(censored, _loss(distance), loss)
        step = np.where(granted, step, 0.0)
        loss = np.where(granted, loss / variance, 0.0)
        return mean + cross * step, covariance - linalg.outer(cross, cross) * loss


def _loss(distance: Array) -> Array:
    """h (h - t) = 1 - variance of a standard normal beyond t: what a censored value explains."""
    return 1.0 - gaussian.truncated_variance(distance)
