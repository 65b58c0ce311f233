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
    Gaussian,
    Packets,
)
from fusion_gym.systems.tobit.filters import KalmanFilter
from fusion_gym.systems.tobit.sensors import CensoredSensors

_ROUNDS = 2  # a third changes errors by less than a thousandth
_LEAST_SHARE = 1e-9  # of a variance; the rest of the difference is rounding


@dataclass(frozen=True)
class TruncatedCentre(FederatedCentre):
    r"""Kalman filter for which silence is a measurement in an interval, by moment matching.

    The centre processes the deliveries first, and then all channels of silent sensors together by
    expectation propagation: each silence stands for a Gaussian measurement that has the moments of
    the truncation, given the deliveries and the other silences. Two rounds take all channels at
    once, so the order of the sensors has no effect. With one silent channel the first has the exact
    moments.

    Equation:
        $$
        \text{silent:}\quad y\in(c-\theta,\ c+\theta),\qquad s=C P_{\setminus}C^{\mathsf T},\quad
        S=s+R,\qquad z=\frac{y-C\hat x_{\setminus}}{\sqrt S}
        $$

        $$
        \tau=\frac{1-\mathrm{var}\,z}{R+s\,\mathrm{var}\,z},\qquad
        \nu=\tau\,C\hat x_{\setminus}+\frac{\sqrt S\,\mathrm E[z]}{R+s\,\mathrm{var}\,z}
        $$

        $$
        P^{+}=\Bigl(P^{-1}+\sum\tau\,C^{\mathsf T}C\Bigr)^{-1},\qquad
        \hat x^{+}=P^{+}\Bigl(P^{-1}\hat x+\sum\nu\,C^{\mathsf T}\Bigr)
        $$

        z is a standard normal truncated to the interval (c - θ, c + θ) of
        :class:`~fusion_gym.systems.silence.Silence`, τ and ν are precision and information of the
        channel's measurement, and x̂∖ and P∖ are the estimate without that measurement. A silent
        sensor whose request the tokens would not have paid for gives no information.

    Assumes: a linear plant, Gaussian noises, uncensored sensors, the trigger of the option
    ``trigger`` with this threshold and without a min_interval.

    Source: J. Sijs and M. Lazar, "Event based state estimation with time synchronous updates",
    IEEE Trans. Automatic Control 57, 2012; T. P. Minka, "Expectation propagation for approximate
    Bayesian inference", Uncertainty in Artificial Intelligence 17, 2001.
    """

    silence: Silence

    predictable = False
    separable = False
    reads_silence = True
    numpy_only = "filter"
    local_means = Centre.local_means
    variances = Centre.variances

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
        if not silent.any():
            return mean, covariance
        middle = self.silence.middle(prediction.held, prediction.expectation.value)
        shift = middle - linalg.matvec(self.sensors.measurement_matrix, mean)
        root = linalg.root(covariance)
        z, posterior = self._truncate(root, shift, silent)
        some = silent.any(0)
        mean = np.where(some, mean + linalg.matvec(root, z), mean)
        return mean, np.where(some, linalg.congruence(root, posterior), covariance)

    def _truncate(self, root: Array, shift: Array, silent: Packets) -> tuple[Array, Array]:
        """Return mean and covariance of z, x = x̂ + G z, given that measurements are silent.

        Args:
            root: G (n, n, N).
            shift: c - C x̂ (sensors, m, N).
            silent: (sensors, N).
        """
        sensors = self.sensors
        matrix = linalg.matmul(sensors.stacked_matrix, root)
        noise = sensors.variance.reshape(-1, 1)
        threshold = np.repeat(self.silence.threshold, sensors.size, axis=0)
        middle, silent = shift.reshape(noise.shape[0], -1), np.repeat(silent, sensors.size, axis=0)
        precision = information = np.zeros(silent.shape)
        z, posterior = np.zeros(root.shape[1:]), linalg.identity(len(root))
        for _ in range(_ROUNDS if len(noise) > 1 else 1):
            spread = linalg.dot(linalg.matmul(matrix, posterior), matrix)
            left = np.maximum(1.0 - precision * spread, _LEAST_SHARE)
            own, variance = (linalg.matvec(matrix, z) - spread * information) / left, spread / left
            deviation = np.sqrt(variance + noise)
            first, second = self.silence.moments(threshold, middle - own, deviation, 0.0)
            rest = noise + variance * second
            precision = np.where(silent, (1.0 - second) / rest, 0.0)
            information = precision * own + np.where(silent, deviation * first / rest, 0.0)
            weighted = linalg.matmul(linalg.transpose(precision[:, None] * matrix), matrix)
            posterior = linalg.inverse(linalg.identity(len(root)) + weighted)
            z = linalg.matvec(posterior, linalg.matvec(linalg.transpose(matrix), information))
        return z, posterior


def truncated_centre(options: Any, sensors: CensoredSensors) -> TruncatedCentre:
    """Return the centre of ``filter="truncated"``.

    Args:
        options: options of the environment.
        sensors: the sensors.

    Raises:
        ConfigurationError: censored sensors, a trigger that is missing or measures several channels
            together, or a threshold that is not allowed.
    """
    if not sensors.unlimited:
        allowed = "'kalman', 'tobit' or 'adf' with censored sensors"
        raise refusal("filter", "truncated", allowed)
    silence = Silence.create(
        options.trigger, options.trigger_threshold, sensors.count, sensors.size
    )
    return TruncatedCentre(KalmanFilter(sensors), np.ones((sensors.count, 1)), silence)
