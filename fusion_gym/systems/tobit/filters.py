"""What every node filter of censored sensors offers, and the two that take values as they are.

Before the network answers, a node already knows everything but whether its request is granted:
the delivered value would be the current measurement, the alternative is the held one. So a filter
plans both outcomes at once; a grant selects one of them. Neither covariance depends on the
current measurement, so a policy may look at both without looking at the measurement.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.fusion.rules import alike, inverses
from fusion_gym.systems.tobit.sensors import CensoredSensors
from fusion_gym.validation import ConfigurationError


class Expectation(NamedTuple):
    """What a node expects of its next measurement; every array has shape (sensors, m, N).

    ``latent``: C x̂, the expectation without censoring. ``value``: the expectation of the censored
    measurement. ``noise_variance``: variance of the censored measurement given the predicted
    state. ``uncensored_probability`` q, ``hazard`` λ and ``truncated_variance`` v of the
    standardised threshold (of 1, 0 and 1 where a filter ignores censoring).
    """

    latent: Array
    value: Array
    noise_variance: Array
    uncensored_probability: Array
    hazard: Array
    truncated_variance: Array


_MANY, _LARGE = 6, 3  # sensors and states


@dataclass(frozen=True)
class Outcomes:
    """Both outcomes at every node.

    ``correction`` (sensors, m, n, N): the transposed gain of a delivery, so that the delivered
    mean is prior + correctionᵀ innovation; ``delivered_covariance`` (sensors, n, n, N);
    ``silent_mean`` (sensors, n, N) and ``silent_covariance`` (sensors, n, n, N).
    """

    correction: Array
    delivered_covariance: Array
    silent_mean: Array
    silent_covariance: Array

    @functools.cached_property
    def silent_information(self) -> Array:
        """The inverse (sensors, n, n, N) of the silent covariance."""
        return inverses(self.silent_covariance)

    @property
    def informed(self) -> bool:
        """Whether both informations are known already, or that of silence is cheap to have.

        It is where many nodes have one and the same covariance, too large for a closed form.
        """
        if {"silent_information", "delivered_information"} <= vars(self).keys():
            return True
        sensors, states = self.silent_covariance.shape[:2]
        return alike(self.silent_covariance) and sensors >= _MANY and states >= _LARGE

    @functools.cached_property
    def delivered_information(self) -> Array:
        """The inverse (sensors, n, n, N) of the delivered covariance."""
        return linalg.inverse(self.delivered_covariance)

    def information(self, granted: NDArray[np.bool_]) -> Array:
        """The nodes' informations (sensors, n, n, N) after the answer ``granted`` (sensors, N).

        Only what was granted is inverted anew: bitwise the inverse of the covariances that result.
        """
        if not granted.any():
            return self.silent_information
        if granted.all() or "delivered_information" in vars(self):
            grant = granted[:, None, None]
            return np.where(grant, self.delivered_information, self.silent_information)
        result = np.ascontiguousarray(self.silent_information).copy()
        sensor, run = np.nonzero(granted)
        delivered = np.moveaxis(self.delivered_covariance[sensor, :, :, run], 0, -1)
        values = linalg.inverse(np.ascontiguousarray(delivered))
        result[sensor, :, :, run] = np.moveaxis(values, -1, 0)
        return result


class NodeFilter(Protocol):
    """A local filter for sensors of one kind, all nodes at once."""

    @property
    def sensors(self) -> CensoredSensors:
        """The sensors whose measurements the nodes filter."""
        ...

    def expect(self, mean: Array) -> Expectation:
        """Expectation of the measurements from the prior means (sensors, n, N)."""
        ...

    def outcomes(
        self, mean: Array, covariance: Array, expectation: Expectation, held: Array, time: Array
    ) -> Outcomes:
        """Both outcomes from the priors (sensors, n, N), (sensors, n, n, N).

        ``held`` (sensors, m, N) is the last delivered measurement, ``time`` (N,) the number of
        the step in its episode, counted from 1.
        """
        ...


def linear_update(
    sensors: CensoredSensors,
    covariance: Array,
    matrix: Array,
    innovation_covariance: Array,
    noise: Array,
    bias: Array | None = None,
) -> tuple[Array, Array]:
    """Correction S⁻¹ C P (…, m, n, N) and posterior covariance P - P Cᵀ S⁻¹ C P (…, n, n, N).

    The minimum-variance update for ``matrix`` C (…, m, n, N) and innovation covariance
    S = C P Cᵀ + N (…, m, m, N), with N = diag(``noise``) + ``bias`` ``bias``ᵀ, both (…, m, N).
    Where P is far larger than what ``sensors`` leave of it, the difference has no digits left,
    and the posterior is :func:`joseph_form` instead.
    """
    cross = linalg.matmul(matrix, covariance)
    correction = linalg.solve(innovation_covariance, cross)
    reduction = linalg.matmul(linalg.transpose(cross), correction)
    posterior = linalg.symmetrise(covariance - reduction)
    lanes = sensors.starved(covariance)
    if lanes.size:
        gain = linalg.transpose(in_lanes(correction, lanes))
        parts = [gain * np.sqrt(in_lanes(noise, lanes))[..., None, :, :]]
        if bias is not None:
            parts.append(linalg.matvec(gain, in_lanes(bias, lanes))[..., None, :])
        prior, matrix = in_lanes(covariance, lanes), in_lanes(matrix, lanes)
        posterior[..., lanes] = joseph_form(sensors, prior, matrix, gain, parts)
    return correction, posterior


def joseph_form(
    sensors: CensoredSensors, covariance: Array, matrix: Array, gain: Array, noise: list[Array]
) -> Array:
    """(I - K C) P (I - K C)ᵀ + Σ V Vᵀ (…, n, n, N) for any gain K (…, n, m, N).

    A sum of squares, which keeps its small eigenvalues beside large ones. ``noise`` are the V
    (…, n, k, N), what the gain makes of the measurement's noise.
    Source: R. S. Bucy and P. D. Joseph, "Filtering for stochastic processes with applications to
    guidance", 1968.
    """
    keep = linalg.identity(covariance.shape[-2]) - linalg.matmul(gain, matrix)
    retention = linalg.matmul(keep, linalg.root(covariance))
    return sensors.gram(np.concatenate([retention, *noise], axis=-2))


def in_lanes(values: Array, lanes: NDArray[np.intp]) -> Array:
    """The runs with these numbers, of values with one column a run or one for all."""
    return values if values.shape[-1] == 1 else values[..., lanes]


@dataclass(frozen=True)
class KalmanFilter:
    r"""Kalman filter that ignores censoring; when nothing arrives the prior is the posterior.

    S = C P Cᵀ + R, K = P Cᵀ S⁻¹. Biased wherever measurements are censored: it stands beside the
    Tobit filters to show what they are worth.

    Equation:
        $$
        S=C P C^{\mathsf T}+R,\qquad K=P C^{\mathsf T}S^{-1}
        $$

        $$
        \hat x^{+}=\hat x+K(y-C\hat x),\qquad P^{+}=P-K S K^{\mathsf T}
        $$

        When nothing arrives the prediction stays.

    Assumes: a linear plant, Gaussian noises independent of one another, uncensored
    measurements, and transmissions that are not chosen by the noise.

    Source: R. E. Kalman, "A new approach to linear filtering and prediction problems", Journal
    of Basic Engineering 82, 1960.
    """

    sensors: CensoredSensors

    def expect(self, mean: Array) -> Expectation:
        """See :class:`NodeFilter`."""
        latent = linalg.matvec(self.sensors.measurement_matrix, mean)
        ones = np.ones_like(latent)
        return Expectation(
            latent=latent,
            value=latent,
            noise_variance=self.sensors.variance * ones,
            uncensored_probability=ones,
            hazard=np.zeros_like(latent),
            truncated_variance=ones,
        )

    def outcomes(
        self, mean: Array, covariance: Array, expectation: Expectation, held: Array, time: Array
    ) -> Outcomes:
        """See :class:`NodeFilter`; ``held`` and ``time`` do not matter here."""
        matrix = self.sensors.measurement_matrix
        innovation = linalg.congruence(matrix, covariance)
        noise = self.sensors.variance
        innovation = linalg.add_diagonal(innovation, noise)
        correction, posterior = linear_update(self.sensors, covariance, matrix, innovation, noise)
        return Outcomes(correction, posterior, mean, covariance)


@dataclass(frozen=True)
class StochasticEventFilter:
    r"""Kalman filter for which silence is a measurement too, of variance R + Z⁻¹.

    A sensor that stays silent with probability exp(-zᵀ Z z / 2), z its innovation and
    Z = ``weight`` · I, says by its silence that z was small: as if z = 0 had been measured with
    the additional noise variance Z⁻¹. So the silent mean is the prior's, and
    P' = P - P Cᵀ (C P Cᵀ + R + Z⁻¹)⁻¹ C P. Under federated fusion several nodes together give the
    exact posterior, whatever mixture of deliveries and silences occurred, because z is taken
    against the centre's prediction, which all nodes share.

    Exact if the policy is ``stochastic_event`` with this weight, every request is granted and the
    sensors are uncensored. Otherwise silence is over-interpreted: after a denial, under censoring
    or with a more silent policy the claimed covariance is too small.

    ``weight`` has shape (sensors, 1), in the inverse squared unit of the measurement, >= 0; with
    weight 0 silence says nothing. Build one with :meth:`create`.

    Equation:
        $$
        \text{delivered:}\qquad K=P C^{\mathsf T}(C P C^{\mathsf T}+R)^{-1},\quad \hat x^{+}=\hat
        x+K(y-C\hat x),\quad P^{+}=P-K C P
        $$

        $$
        \text{silent:}\qquad \hat x^{+}=\hat x,\qquad P^{+}=P-P C^{\mathsf T}\left(C P C^{\mathsf
        T}+R+Z^{-1}\right)^{-1}C P
        $$

        Z = w I is the weight of the policy ``stochastic_event`` (``stochastic_weight``).

    Assumes: a linear plant, Gaussian noises, uncensored sensors, the policy
    ``stochastic_event`` with the same weight, and that every request is granted.

    Source: D. Han, Y. Mo, J. Wu, S. Weerakkody, B. Sinopoli and L. Shi, "Stochastic
    event-triggered sensor schedule for remote state estimation", IEEE Trans. Automatic Control
    60(10), 2015, the estimator of the closed-loop schedule.
    """

    sensors: CensoredSensors
    weight: Array

    @classmethod
    def create(cls, sensors: CensoredSensors, weight: ArrayLike | None) -> StochasticEventFilter:
        """Check the weight, one number > 0 or one a sensor.

        Raises:
            ConfigurationError: no weight, another number of entries, or an entry <= 0.
        """
        if weight is None:
            raise ConfigurationError(
                "stochastic_weight = None is not allowed with filter='stochastic': it must be the "
                "weight of the policy 'stochastic_event', a number > 0 or one a sensor"
            )
        checked = validation.positive("stochastic_weight", weight, (sensors.count,))
        return cls(sensors, checked[:, None])

    def expect(self, mean: Array) -> Expectation:
        """See :class:`NodeFilter`; censoring is ignored."""
        return KalmanFilter(self.sensors).expect(mean)

    def outcomes(
        self, mean: Array, covariance: Array, expectation: Expectation, held: Array, time: Array
    ) -> Outcomes:
        """See :class:`NodeFilter`; ``held`` and ``time`` do not matter here."""
        matrix = self.sensors.measurement_matrix
        innovation = linalg.congruence(matrix, covariance)
        noise = self.sensors.variance
        innovation = linalg.add_diagonal(innovation, noise)
        correction, delivered = linear_update(self.sensors, covariance, matrix, innovation, noise)
        # Both sides times √Z, so that weight 0 is no exception: √Z C measured with √Z S √Z + I.
        weight = self.weight[:, None, None]
        ones = np.ones((matrix.shape[-3], 1))
        scaled = linalg.add_diagonal(weight * innovation, ones)
        noise = self.weight[:, None] * noise + ones
        matrix = np.sqrt(weight) * matrix
        _, silent = linear_update(self.sensors, covariance, matrix, scaled, noise)
        return Outcomes(correction, delivered, mean, silent)
