"""The interface of node filters of censored sensors, and two filters that ignore censoring.

Before the network answers, a node does not know only whether its request is granted: a delivered
value is the current measurement, and otherwise the held value stays. A filter therefore plans both
outcomes, and the grant selects one. Neither covariance depends on the current measurement, so a
policy may use both without using the measurement.

A node's prior is x = x̂ + G z with z ~ N(0, I) and G Gᵀ its covariance, which may be singular. The
posterior of z is regular for every G.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.namespace import in_runs, namespace
from fusion_gym.systems.tobit.sensors import CensoredSensors


class Expectation(NamedTuple):
    """The predicted distribution of a node's next measurement; every array is (sensors, m, N).

    ``latent``: C x̂, the expectation without censoring. ``value``: the expectation of the censored
    measurement. ``noise_variance``: variance of the censored measurement given the predicted state.
    ``uncensored_probability`` q, ``hazard`` λ and ``truncated_variance`` v of the standardised
    threshold (1, 0 and 1 for a filter that ignores censoring).
    """

    latent: Array
    value: Array
    noise_variance: Array
    uncensored_probability: Array
    hazard: Array
    truncated_variance: Array


_STARVED = 1e6  # P - P Cᵀ S⁻¹ C P loses its digits where C P Cᵀ is so many times the noise
_LARGE = 16  # states from which on a product by BLAS is faster than a sum of outer products
_RIDGE = 1e-14  # relative, for each row: above the rounding of a Gram matrix


class Outcomes(NamedTuple):
    """Both outcomes at every node, in the coordinates z of its prior.

    ``correction`` (sensors, m, n, N): the transposed gain of a delivery, so that the delivered mean
    is correctionᵀ innovation; ``delivered_covariance`` (sensors, n, n, N); ``silent_mean``
    (sensors, n, N) and ``silent_covariance`` (sensors, n, n, N).
    """

    correction: Array
    delivered_covariance: Array
    silent_mean: Array
    silent_covariance: Array


class NodeFilter(Protocol):
    """A local filter for sensors of one kind, all nodes at once."""

    @property
    def sensors(self) -> CensoredSensors:
        """The sensors of the nodes."""

    def expect(self, mean: Array) -> Expectation:
        """Return the predicted measurements from prior means (n, N) or (sensors, n, N)."""

    def outcomes(
        self, matrix: Array, expectation: Expectation, held: Array, time: Array
    ) -> Outcomes:
        """Return both outcomes.

        Args:
            matrix: C G (sensors, m, n, N).
            expectation: the predicted measurements.
            held: the last delivered measurement (sensors, m, N).
            time: the number of the step in its episode (N,), counted from 1.
        """


def linear_update(matrix: Array, noise: Array, bias: Array | None = None) -> tuple[Array, Array]:
    """Return the correction S⁻¹ B (…, m, n, N) and the covariance I - Bᵀ S⁻¹ B (…, n, n, N).

    This is the minimum-variance update of z ~ N(0, I) with the innovation covariance S = B Bᵀ + N,
    N = diag(``noise``) + ``bias`` ``bias``ᵀ. Where the difference would lose its digits the
    covariance has the Joseph form (I - K B) (I - K B)ᵀ + K N Kᵀ, with a ridge in proportion to its
    diagonal that keeps it definite.

    Args:
        matrix: B (…, m, n, N).
        noise: variances (…, m, N).
        bias: (…, m, N).
    """
    spread = linalg.gram(matrix)
    total = linalg.add_diagonal(spread, noise)
    if bias is not None:
        total += linalg.outer(bias, bias)
    correction = linalg.solve(total, matrix)
    size = matrix.shape[-2]
    identity = linalg.identity(size)
    posterior = identity - linalg.matmul(linalg.transpose(matrix), correction)
    posterior = linalg.symmetrise(posterior)
    xp, large = namespace(matrix, noise), linalg.diagonal(spread) > _STARVED * noise

    def exact(correction: Array, matrix: Array, noise: Array, *bias: Array) -> tuple[Array]:
        gain = linalg.transpose(correction)
        parts = [identity - linalg.matmul(gain, matrix), gain * xp.sqrt(noise)[..., None, :, :]]
        parts += [linalg.matvec(gain, part)[..., None, :] for part in bias]
        form = linalg.gram(xp.concatenate(parts, axis=-2))
        return (linalg.add_diagonal(form, size * _RIDGE * linalg.diagonal(form)),)

    arguments = (correction, matrix, noise) if bias is None else (correction, matrix, noise, bias)
    (posterior,) = in_runs(large, exact, arguments, (posterior,))
    return correction, posterior


class Scalar(NamedTuple):
    """A scalar measurement c x + v of a prior covariance G Gᵀ.

    ``root`` G (…, n, n, N) · ``projection`` g = Gᵀ cᵀ and ``cross`` G g, both (…, n, N) · ``noise``
    R (…, 1) or (…, N), the variance of v · ``variance`` S = gᵀ g + R (…, N).
    """

    root: Array
    projection: Array
    cross: Array
    noise: Array
    variance: Array

    @classmethod
    def from_row(cls, root: Array, row: Array, noise: Array) -> Scalar:
        """Return the measurement of ``row`` c (…, n, 1) or (…, n, N)."""
        projection = linalg.matvec(linalg.transpose(root), row)
        variance = linalg.dot(projection, projection) + noise
        return cls(root, projection, linalg.matvec(root, projection), noise, variance)

    def posterior(self, share: Array | float) -> Array:
        """Return a root of P - P cᵀ c P s/S, s the share of variance that the measurement explains.

        It is G (I - w g gᵀ) with (1 - w gᵀ g)² = 1 - s gᵀ g/S, which loses no digits for any P.

        Source: J. E. Potter's form; P. S. Maybeck, "Stochastic models, estimation, and control",
        volume 1, 1979, section 7.3.
        """
        left = share * self.noise + (1.0 - share) * self.variance
        weight = share / (self.variance + namespace(left).sqrt(left * self.variance))
        return self.root - linalg.outer(self.cross * weight[..., None, :], self.projection)


def joint_update(matrix: Array, value: Array) -> tuple[Array, Array]:
    """Return mean (…, n, N) and covariance (…, n, n, N) of z ~ N(0, I) given B z + v.

    The covariance is (I + Bᵀ B)⁻¹, or the result of one channel after another where that sum would
    lose its digits.

    Args:
        matrix: B (…, c, n, N), of any number of channels c.
        value: B z + v (…, c, N), with v ~ N(0, I).
    """
    size = matrix.shape[-2]
    xp = namespace(matrix, value)
    both = xp.concatenate([matrix, value[..., None, :]], axis=-2)
    if size < _LARGE:
        total = linalg.total(matrix[..., :, None, :] * both[..., None, :, :], -4)
    else:
        total = linalg.matmul(linalg.transpose(matrix), both)
    covariance = linalg.inverse(linalg.identity(size) + total[..., :size, :])
    mean = linalg.matvec(covariance, total[..., size, :])
    large = linalg.total(matrix * matrix) > _STARVED
    results = in_runs(large, _sequential_update, (matrix, value), (mean, covariance))
    return results[0], results[1]


def _sequential_update(matrix: Array, value: Array) -> tuple[Array, Array]:
    """Return the results of :func:`joint_update`, one channel after another."""
    size = matrix.shape[-2]
    root, shift = linalg.identity(size), namespace(matrix).zeros_like(matrix[..., 0, :, :])
    for channel in range(matrix.shape[-3]):
        row = matrix[..., channel, :, :]
        scalar = Scalar.from_row(root, row, np.ones(1))
        residual = value[..., channel, :] - linalg.dot(row, shift)
        shift = shift + scalar.cross * (residual / scalar.variance)[..., None, :]
        root = scalar.posterior(1.0)
    return shift, linalg.gram(root)


@dataclass(frozen=True)
class KalmanFilter:
    r"""Kalman filter that ignores censoring; without a delivery the prior is the posterior.

    S = C P Cᵀ + R, K = P Cᵀ S⁻¹. It is biased where measurements are censored, and serves as the
    reference for the Tobit filters.

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

    @property
    def silence(self) -> Array | None:
        """Weight Z (sensors, 1) of a silent sensor's information; ``None`` for none."""
        return None

    def expect(self, mean: Array) -> Expectation:
        """See :class:`NodeFilter`."""
        latent = linalg.matvec(self.sensors.measurement_matrix, mean)
        xp = namespace(latent)
        ones = xp.ones_like(latent)
        return Expectation(
            latent=latent,
            value=latent,
            noise_variance=self.sensors.variance * ones,
            uncensored_probability=ones,
            hazard=xp.zeros_like(latent),
            truncated_variance=ones,
        )

    def outcomes(
        self, matrix: Array, expectation: Expectation, held: Array, time: Array
    ) -> Outcomes:
        """See :class:`NodeFilter`; ``held`` and ``time`` have no effect."""
        weighted = expectation.uncensored_probability[:, :, None] * matrix
        noise = self.sensors.variance * expectation.truncated_variance
        correction, delivered = linear_update(weighted, noise)
        nothing = np.zeros(matrix.shape[:1] + matrix.shape[2:])
        prior = np.broadcast_to(linalg.identity(matrix.shape[2]), delivered.shape)
        return Outcomes(correction, delivered, nothing, prior)


@dataclass(frozen=True)
class StochasticEventFilter(KalmanFilter):
    r"""Kalman filter for which silence is a measurement, of variance R + Z⁻¹.

    A sensor stays silent with probability exp(-zᵀ Z z / 2), z its innovation and Z = ``weight`` ·
    I. Its silence is equivalent to a measurement z = 0 with the additional noise variance Z⁻¹. The
    silent mean is therefore the prior's, and P' = P - P Cᵀ (C P Cᵀ + R + Z⁻¹)⁻¹ C P. Under
    federated fusion several nodes together give the exact posterior for every mixture of deliveries
    and silences, because z refers to the centre's prediction, which all nodes share.

    The filter is exact if the policy is ``stochastic_event`` with this weight, every request
    arrives at once and the sensors are uncensored. After a denial or a loss, under censoring or
    with a policy that transmits less, the claimed covariance is too small.

    ``weight`` has shape (sensors, 1), in the inverse squared unit of the measurement, >= 0; with
    weight 0 silence carries no information.

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
    ``stochastic_event`` with the same weight, and that every request arrives at once.

    Source: D. Han, Y. Mo, J. Wu, S. Weerakkody, B. Sinopoli and L. Shi, "Stochastic
    event-triggered sensor schedule for remote state estimation", IEEE Trans. Automatic Control
    60(10), 2015, the estimator of the closed-loop schedule.
    """

    weight: Array

    @classmethod
    def create(cls, sensors: CensoredSensors, weight: ArrayLike | None) -> StochasticEventFilter:
        """Return the filter of a weight.

        Args:
            sensors: the sensors.
            weight: one number > 0 or one per sensor.

        Raises:
            ConfigurationError: no weight, another number of entries, or an entry <= 0.
        """
        if weight is None:
            allowed = "the weight of the policy 'stochastic_event', a number > 0, or one per sensor"
            raise validation.refusal("stochastic_weight", None, allowed, "with filter='stochastic'")
        checked = validation.positive("stochastic_weight", weight, (sensors.count,))
        return cls(sensors, checked[:, None])

    @property
    def silence(self) -> Array:
        """See :class:`KalmanFilter`."""
        return self.weight

    def outcomes(
        self, matrix: Array, expectation: Expectation, held: Array, time: Array
    ) -> Outcomes:
        """See :class:`NodeFilter`; ``held`` and ``time`` have no effect."""
        plain = super().outcomes(matrix, expectation, held, time)
        # Both sides times √Z, so that weight 0 is no exception: √Z C measured with √Z R √Z + I.
        noise = 1.0 + self.weight[:, None] * expectation.noise_variance
        _, silent = linear_update(np.sqrt(self.weight)[:, None, None] * matrix, noise)
        return plain._replace(silent_covariance=silent)
