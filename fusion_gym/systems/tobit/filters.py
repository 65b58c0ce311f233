"""Filters of censored sensors: Kalman, Tobit, the paper's bound, and an assumed density.

Before the network answers, a node does not know only whether its request is granted: a delivered
value is the current measurement, and otherwise the held value stays. A filter therefore plans both
outcomes, and the grant selects one. Neither covariance depends on the current measurement, so a
policy may use both without using the measurement.

A node's prior is x = x̂ + G z with z ~ N(0, I) and G Gᵀ its covariance, which may be singular. The
posterior of z is regular for every G.

Source of the bound: tobit_token_bucket, Theorems 1 and 2. Simulation confirms four corrections,
which docs/tobit_oscillator.md describes: (29) starts from the previous posterior; K_{t+1} in (30)
is K_t; C{Υ∘Ω}Cᵀ is Υ∘(C Ω Cᵀ); without a delivery the filter updates with the held value.
"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import gaussian, linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.namespace import active_rows, in_runs, namespace
from fusion_gym.systems.tobit.sensors import CensoredSensors

_STARVED = 1e6  # P - P Cᵀ S⁻¹ C P loses its digits where C P Cᵀ is so many times the noise
_LARGE = 16  # states from which on a product by BLAS is faster than a sum of outer products
_RIDGE = 1e-14  # relative, for each row: above the rounding of a sum or a Gram matrix
# Below this probability of an uncensored value, q counts as this: q enters only in ratios whose
# limits are reached long before, and 1/q must stay finite.
_SMALLEST_PROBABILITY = 1e-290
# The same where a held value is divided by q, and the ratio is squared.
_SMALLEST_DIVISOR = 1e-140
_LEAST = 1e-290  # a variance below it has no inverse
_FAR = 50.0  # a threshold this many deviations away never censors


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


@dataclass(frozen=True)
class NodeFilter(ABC):
    """A local filter for sensors of one kind, all nodes at once.

    ``predicts`` says whether the estimate only moves by the plant's matrix without a delivery.
    """

    predicts: ClassVar[bool] = False
    sensors: CensoredSensors

    def expect(self, mean: Array) -> Expectation:
        """Return the predicted measurements from prior means (n, N) or (sensors, n, N).

        With ζ = (τ - C x̂)/√R: q = 1 - Φ(ζ), λ = φ(ζ)/q, ŷ = q (C x̂ + λ √R) + (1 - q) τ.

        Source: tobit_token_bucket, equations (5)-(7) and (23).
        """
        latent = linalg.matvec(self.sensors.measurement_matrix, mean)
        return censored_moments(self.sensors, latent, self.sensors.deviation)

    @abstractmethod
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
class KalmanFilter(NodeFilter):
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

    predicts = True

    @property
    def silence(self) -> Array | None:
        """Weight Z (sensors, 1) of a silent sensor's information; ``None`` for none."""
        return None

    def expect(self, mean: Array) -> Expectation:
        """See :class:`NodeFilter`."""
        latent = linalg.matvec(self.sensors.measurement_matrix, mean)
        xp = namespace(latent)
        ones, zeros = xp.ones_like(latent), xp.zeros_like(latent)
        return Expectation(latent, latent, self.sensors.variance * ones, ones, zeros, ones)

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
    with a policy that transmits less, the estimated covariance is too small.

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

    predicts = False
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


def censored_moments(sensors: CensoredSensors, latent: Array, deviation: Array) -> Expectation:
    """Return the moments of clip(z, τ, υ) for z ~ N(latent, deviation²), both (sensors, m, N).

    ``noise_variance`` is the total variance of the censored value; ``hazard`` and
    ``truncated_variance`` are mean and variance of the standardised z given that it is uncensored.
    """
    if sensors.two_sided:
        return _two_sided_moments(sensors, latent, deviation)
    moments = gaussian.tobit_moments((sensors.threshold - latent) / deviation)
    q = moments.uncensored_probability
    excess = namespace(q).where(sensors.uncensored, 0.0, moments.excess)
    variance = q * moments.truncated_variance + q * (1.0 - q) * excess * excess
    value = q * (latent + deviation * moments.hazard) + (1.0 - q) * sensors.finite_threshold
    noise, own = deviation * deviation * variance, moments.truncated_variance
    return Expectation(latent, value, noise, q, moments.hazard, own)


def _two_sided_moments(sensors: CensoredSensors, latent: Array, deviation: Array) -> Expectation:
    """Return the moments for thresholds on both sides.

    With probabilities a below, b above and p between, y has mean a τ + b υ + p centre. By the law
    of total variance, the variance is the one within the interval plus the variance of τ, υ and
    centre. Source: round_robin_tobit, equations (9), (12)-(14), (20).
    """
    low = (sensors.threshold - latent) / deviation
    high = (sensors.upper - latent) / deviation
    moments = gaussian.interval_moments(low, high)
    below, above = gaussian.upper_tail(-low), gaussian.upper_tail(high)
    xp, inside = namespace(latent, deviation), moments.probability
    centre = latent + deviation * moments.mean
    to_low = xp.where(np.isinf(sensors.threshold), 0.0, centre - sensors.finite_threshold)
    to_high = xp.where(np.isinf(sensors.upper), 0.0, sensors.finite_upper - centre)
    between = (
        below * inside * to_low**2
        + inside * above * to_high**2
        + below * above * (to_low + to_high) ** 2
    )
    value = below * sensors.finite_threshold + above * sensors.finite_upper + inside * centre
    noise = inside * deviation**2 * moments.variance + between
    own = xp.clip(moments.variance, 1e-12, 1.0)
    return Expectation(latent, value, noise, inside, moments.mean, own)


@dataclass(frozen=True)
class TobitKalmanFilter(KalmanFilter):
    r"""Tobit Kalman filter; without a delivery the prior is the posterior.

    S = q C P Cᵀ q + R v, K = P Cᵀ q S⁻¹ with q, v of :meth:`NodeFilter.expect`.

    Equation:
        $$
        \zeta=\frac{\tau-C\hat x}{\sqrt R},\quad q=1-\Phi(\zeta),\quad
        \lambda=\frac{\varphi(\zeta)}{q},\quad v=1-\lambda(\lambda-\zeta)
        $$

        $$
        \hat y=q\,(C\hat x+\lambda\sqrt R)+(1-q)\,\tau,\qquad S=q\,C P C^{\mathsf T}q+R\,v,\qquad
        K=P C^{\mathsf T}q\,S^{-1}
        $$

        $$
        \hat x^{+}=\hat x+K(y-\hat y),\qquad P^{+}=P-K S K^{\mathsf T}
        $$

        τ is the threshold below which the sensor shows τ; φ and Φ are the normal density and
        distribution. q is the probability of an uncensored value, given the predicted state, and v
        the variance of the standardised noise given that. With an upper threshold as well, q is the
        probability between the two, λ and v the mean and variance of the standardised noise there,
        and ŷ = a τ + b υ + q (C x̂ + λ √R), with a and b the probabilities below and above.

    Assumes: a linear plant and Gaussian noises; q and v are those at the predicted state, as if
    it were exact, and transmissions are not chosen by the noise.

    Source: Allik et al., "The Tobit Kalman filter" (IEEE Trans. Control Syst. Technol. 24, 2016);
    tobit_token_bucket, equations (21)-(23) with κ₁ = 1 and S = diag(R v).
    """

    expect = NodeFilter.expect


@dataclass(frozen=True)
class AssumedDensityFilter:
    r"""Assumed-density filter at the centre, of one scalar measurement after another.

    Let S = C P Cᵀ + R, K = P Cᵀ/S and t = (C x̂ - τ)/√S. An uncensored component gets the Kalman
    update. A component at its lower threshold τ moves the mean by -√S h K, and P loses
    P Cᵀ C P h (h - t)/S, with the hazard h = φ(t)/(1 - Φ(t)); at the upper threshold the signs
    are mirrored. These are the exact posterior mean and covariance of a Gaussian prior given
    that event; the posterior is then taken to be Gaussian again.

    Equation:
        $$
        S=C P C^{\mathsf T}+R,\qquad t=\frac{C\hat x-\tau}{\sqrt S},\qquad
        h=\frac{\varphi(t)}{1-\Phi(t)}
        $$

        $$
        y>\tau:\qquad \hat x^{+}=\hat x+P C^{\mathsf T}\frac{y-C\hat x}{S},\qquad P^{+}=P-\frac{P
        C^{\mathsf T}C P}{S}
        $$

        $$
        y=\tau:\qquad \hat x^{+}=\hat x-P C^{\mathsf T}\frac{h}{\sqrt S},\qquad P^{+}=P-\frac{P
        C^{\mathsf T}C P}{S}\,h(h-t)
        $$

        One scalar measurement after another. At an upper threshold the signs of t and of the step
        are mirrored. Where measurements are censored the order of the sensors changes the mean
        error by some thousandths.

    Assumes: a linear plant, Gaussian noises, and a posterior that is nearly Gaussian;
    transmissions are not chosen by the noise.

    Source: P. S. Maybeck, "Stochastic models, estimation, and control", volume 2, 1982, chapter
    12, for assumed densities; the moments are a truncated normal variable's.
    """

    sensors: CensoredSensors

    def expect(self, mean: Array, root: Array) -> Expectation:
        """Return the moments of the measurements (sensors, m, N) under the prior N(mean, G Gᵀ)."""
        matrix = self.sensors.measurement_matrix
        latent = linalg.matvec(matrix, mean)
        xp = namespace(mean)
        spread = linalg.total(xp.square(linalg.matmul(matrix, root))) + self.sensors.variance
        return censored_moments(self.sensors, latent, xp.sqrt(spread))

    def update(
        self, mean: Array, root: Array, measurement: Array, granted: NDArray[np.bool_]
    ) -> tuple[Array, Array]:
        """Return mean (n, N) and root (n, n, N) after the granted (sensors, N) measurements."""
        sensors, xp = self.sensors, namespace(mean, root)
        active = active_rows(granted).tolist()
        for sensor, component in itertools.product(active, range(sensors.size)):
            place = sensor, component
            row, value = sensors.measurement_matrix[place], measurement[place]
            scalar = Scalar.from_row(root, row, sensors.variance[place])
            latent, deviation = linalg.dot(row, mean), xp.sqrt(scalar.variance)
            step = (value - latent) / scalar.variance
            loss = xp.ones_like(step)
            for sign, threshold in ((1.0, sensors.threshold), (-1.0, sensors.upper)):
                limit = threshold[place]
                if np.isfinite(limit).all():
                    censored = value <= limit if sign > 0 else value >= limit
                    distance = sign * (latent - limit) / deviation
                    step = xp.where(censored, -sign * gaussian.hazard(distance) / deviation, step)
                    loss = xp.where(censored, 1.0 - gaussian.truncated_variance(distance), loss)
            mean = mean + scalar.cross * xp.where(granted[sensor], step, 0.0)
            root = scalar.posterior(xp.where(granted[sensor], loss, 0.0))
        return mean, root

    def expected_covariance(self, mean: Array, root: Array) -> Array:
        """Return the expected covariance (sensors, n, n, N) after a single sensor's delivery.

        The update runs by component, each with the expected share of variance that the measurement
        explains; it is exact for sensors of one component.
        """
        matrix, noise = self.sensors.measurement_matrix, self.sensors.variance
        xp, latent = namespace(mean, root), linalg.matvec(matrix, mean)
        root = root[None]
        for component in range(self.sensors.size):
            row = matrix[:, component]
            scalar = Scalar.from_row(root, row, noise[:, component])
            share, deviation = xp.ones_like(scalar.variance), xp.sqrt(scalar.variance)
            for sign, threshold in ((1.0, self.sensors.threshold), (-1.0, self.sensors.upper)):
                limit = threshold[:, component]
                distance = sign * (latent[:, component] - limit) / deviation
                distance = xp.where(np.isfinite(limit), distance, _FAR)
                share -= gaussian.upper_tail(distance) * gaussian.truncated_variance(distance)
            root = scalar.posterior(share)
        return linalg.gram(root)


@dataclass(frozen=True)
class BoundConstants:
    """The constants κ₁..κ₈ of the bound and (1 + ε₁₄, 1 + 1/ε₁₄), from ε₁..ε₁₄ > 0.

    Source: tobit_token_bucket, below equation (30).
    """

    kappa: tuple[float, ...]
    second_moment: tuple[float, float]

    @classmethod
    def create(cls, epsilon: ArrayLike) -> BoundConstants:
        """Return the constants of the 14 scalars.

        Args:
            epsilon: ε₁..ε₁₄, each > 0.

        Raises:
            ConfigurationError: another number of entries, or an entry <= 0.
        """
        given = validation.array("bound_epsilon", epsilon, (14,))
        e = validation.positive("bound_epsilon", given, (14,))
        kappa = (
            1 + e[0] + e[1] + e[2] + e[3] + e[4],
            1 + 1 / e[0] + 1 / e[6] + 1 / e[9] + 1 / e[11] + 1 / e[12],
            1 + e[5],
            1 + e[6] + e[7] + e[8] + 1 / e[1],
            1 + 1 / e[2] + 1 / e[7] + e[9] + e[10],
            1 + 1 / e[3] + e[11],
            1 + 1 / e[4] + 1 / e[8] + 1 / e[10] + e[12],
            1 + 1 / e[5],
        )
        return cls(tuple(float(k) for k in kappa), (float(1 + e[13]), float(1 + 1 / e[13])))


@dataclass(frozen=True)
class EventError:
    """The bound Ξ of the event error that the paper adds to a delivered measurement.

    Ξ(G) = ``growth`` G + ``offset``, G' = Ξ(G), G₀ = ``initial``; each of shape (sensors, 1), in
    squared units of the measurement. It belongs to the dynamic event trigger: a delivered
    measurement is the current one and has no event error, under any policy.

    Source: tobit_token_bucket, equations (33), (34) and below (30).
    """

    growth: Array
    offset: Array
    initial: Array

    def at(self, time: Array) -> Array:
        """Return Ξ(G_{t-1}) (sensors, N) at the steps t = ``time`` (N,), counted from 1."""
        xp, rate = namespace(time), self.growth - 1.0
        logarithm = np.log1p(rate)  # exact also where the growth is nearly 1
        ramp = xp.expm1(logarithm * time) / np.where(rate, rate, 1.0)
        ramp = xp.where(rate == 0.0, time, ramp)
        return self.initial * xp.exp(logarithm * time) + self.offset * ramp

    @classmethod
    def create(
        cls, trigger: Mapping[str, ArrayLike], young: tuple[float, float], sensors: int
    ) -> EventError:
        """Return the bound of a dynamic event trigger.

        Args:
            trigger: ``threshold`` σ, ``decay`` λ and ``initial`` η₀ of each sensor, >= 0, and
                ``divisor`` χ, > 0.
            young: the factors (d, e) of Young's inequality, > 0.
            sensors: number of sensors.

        Raises:
            ConfigurationError: a wrong shape, or a number outside these limits.
        """
        shape = (sensors,)
        sigma, lam, eta = (
            validation.not_negative(f"trigger_{name}", trigger[name], shape)
            for name in ("threshold", "decay", "initial")
        )
        chi = validation.positive("trigger_divisor", trigger["divisor"], shape)
        d, e = validation.positive("bound_young", young, (2,))
        growth = (1 + d) * (1 + e) * lam**2 + (1 + chi) * (1 + 1 / d) / chi**2
        offset = ((1 + d) * (1 + 1 / e) + (1 + 1 / d) * (1 + 1 / chi)) * sigma**2
        return cls(growth[:, None], offset[:, None], (eta**2)[:, None])


@dataclass(frozen=True)
class BoundTobitFilter(NodeFilter):
    r"""Tobit Kalman filter whose gain minimises the trace of the paper's bound.

    ``event_error`` (or None) is the κ₆ Ξ term of a delivery; ``hold`` says what happens without
    one: True updates with the held value as the paper does, False predicts.

    Equation:
        $$
        \tilde C=q\,C,\quad a=q\lambda\sqrt R,\quad u=(1-q)\tau,\quad
        \Omega=(1+\epsilon_{14})P+(1+1/\epsilon_{14})\,\hat x\hat x^{\mathsf T}
        $$

        $$
        S_{\mathrm{delivered}}=\kappa_2\,a a^{\mathsf
        T}+\mathrm{diag}\left(qR+q(1-q)\left(\kappa_3\,C\Omega C^{\mathsf
        T}+\kappa_8\tau^2\right)\right)+\kappa_6\,\Xi\,I
        $$

        $$
        S_{\mathrm{held}}=\kappa_2\,a a^{\mathsf T}+\kappa_4\,\tilde C\Omega\tilde C^{\mathsf
        T}+\kappa_5\,\bar y\bar y^{\mathsf T}+\kappa_7\,u u^{\mathsf T}
        $$

        $$
        K=\kappa_1 P\tilde C^{\mathsf T}\left(\kappa_1\tilde C P\tilde C^{\mathsf
        T}+S\right)^{-1},\qquad P^{+}=\kappa_1(I-K\tilde C)P(I-K\tilde C)^{\mathsf T}+K S
        K^{\mathsf T}
        $$

        q, λ and ŷ as in the :class:`TobitKalmanFilter`, x̂⁺
        = x̂ + K (ȳ − ŷ) with ȳ the value that is held, which is the new one after a delivery. Of C
        Ω Cᵀ in the diagonal only the diagonal counts. κ₁ to κ₈ come of the 14 numbers ε of
        ``bound_epsilon``; Ξ bounds the trigger's event error (``event_error``).

    Assumes: the paper's dynamic event trigger, for Ξ; and that censoring is independent of the
    noise, which it is not, so that the bound is not proven.

    Source: tobit_token_bucket, equations (20)-(37), Theorems 1 and 2.
    """

    constants: BoundConstants
    event_error: EventError | None
    hold: bool

    @property
    def predicts(self) -> bool:  # type: ignore[override]
        """See :class:`NodeFilter`; not if it holds."""
        return not self.hold

    def __post_init__(self) -> None:
        matrices = self.sensors.measurement_matrix[..., 0]
        ranks = np.linalg.matrix_rank(matrices)
        if self.hold and np.any(ranks < self.sensors.size):
            raise validation.ConfigurationError(
                f"measurement_matrices with row ranks {ranks.tolist()} are not allowed with "
                f"filter='paper', silent='hold': each must have its {self.sensors.size} rows "
                "independent, because the held update (37) has no noise term"
            )

    def outcomes(
        self, matrix: Array, expectation: Expectation, held: Array, time: Array
    ) -> Outcomes:
        """See :class:`NodeFilter`.

        Source: tobit_token_bucket, equations (30) and (37). At the optimal gain (30) is
        κ₁ P - κ₁ P C̃ᵀ Φ⁻¹ C̃ P κ₁, with Φ = κ₁ C̃ P C̃ᵀ + S and C̃ = q C; here P = I.
        """
        latent = expectation.latent
        spread = linalg.gram(matrix)
        grow, shift = self.constants.second_moment
        moment = grow * spread + shift * linalg.outer(latent, latent)
        correction, delivered = self._delivered(matrix, linalg.diagonal(moment), expectation, time)
        if self.hold:
            silent = self._held(matrix, spread, moment, expectation, held)
        else:
            prior = np.broadcast_to(linalg.identity(matrix.shape[2]), delivered.shape)
            silent = np.zeros(delivered[:, 0].shape), prior
        return Outcomes(correction, delivered, *silent)

    def _delivered(
        self, matrix: Array, moments: Array, expectation: Expectation, time: Array
    ) -> tuple[Array, Array]:
        """Return correction and bound after a delivery, θ = 0."""
        k1, k2, k3, _, _, k6, _, k8 = self.constants.kappa
        variance, threshold = self.sensors.variance, self.sensors.finite_threshold
        xp = namespace(matrix)
        q = xp.maximum(expectation.uncensored_probability, _SMALLEST_PROBABILITY)
        a = q * expectation.hazard * self.sensors.deviation
        noise = q * variance + q * (1.0 - q) * (k3 * moments + k8 * threshold**2)
        if self.event_error is not None:
            noise = noise + k6 * self.event_error.at(time)[:, None]
        weighted = np.sqrt(k1) * q[:, :, None] * matrix
        correction, bound = linear_update(weighted, noise, np.sqrt(k2) * a)
        return np.sqrt(k1) * correction, k1 * bound

    def _held(
        self, matrix: Array, spread: Array, moment: Array, expectation: Expectation, held: Array
    ) -> tuple[Array, Array]:
        """θ = 1: mean and bound after the update with the held value ȳ.

        Every term of Φ but two is scaled by q on both sides, so the update is written in units of
        q: Φ = q (N + F Fᵀ) q with F = [√κ₅ ȳ, √κ₇ (1 - q) τ]/q, whose rows may be huge and of very
        different size. :func:`_pinned_solve` takes them in without loss of digits, and the gain
        itself, which grows as 1/q, is never formed. N is singular where a row of the prediction is
        known; a ridge of its rounding counts as noise, so that the bound stays one.
        """
        k1, k2, _, k4, k5, _, k7, _ = self.constants.kappa
        threshold = self.sensors.finite_threshold
        xp = namespace(matrix)
        q = xp.maximum(expectation.uncensored_probability, _SMALLEST_PROBABILITY)
        bias = expectation.hazard * self.sensors.deviation
        core = k1 * spread + k4 * moment + k2 * linalg.outer(bias, bias)
        ridge = linalg.diagonal(core)
        core = linalg.add_diagonal(core, xp.where(ridge > _LEAST, _RIDGE * ridge, 1.0))
        columns = _pinned_columns(held, threshold, q, np.sqrt(k5), np.sqrt(k7))
        whitened, pull = _pinned_solve(core, matrix, columns)
        across = linalg.transpose(matrix)
        uncensored = expectation.latent + bias
        step = linalg.matvec(across, pull) - linalg.matvec(linalg.transpose(whitened), uncensored)
        reduction = linalg.symmetrise(linalg.matmul(across, whitened))
        return k1 * step, k1 * linalg.identity(matrix.shape[2]) - k1**2 * reduction


def _pinned_columns(
    held: Array, threshold: Array, q: Array, a: float, b: float
) -> list[tuple[Array, Array]]:
    """Columns of F and factors c with F c = (ȳ - u)/q and F Fᵀ = (a² ȳ ȳᵀ + b² u uᵀ)/q².

    ``held`` ȳ and ``q`` are (…, m, N), ``threshold`` τ broadcasts to them, u = (1 - q) τ; a factor
    is (…, 1, N). The columns a ȳ and b u are rotated into each other so that the second is zero
    in the row p where the first is largest. Its other rows are a b/r times
    ȳ_p u - u_p ȳ = (e_p τ - τ_p e) - q ȳ_p τ + q_p τ_p ȳ with e = ȳ - τ, which loses no digits
    where ȳ lies at the threshold and q is tiny.
    """
    xp = namespace(held, q)
    floored = xp.maximum(q, _SMALLEST_DIVISOR)
    if not np.any(threshold):
        return [(a * held / floored, np.full(held[..., :1, :].shape, 1.0 / a))]
    u = (1.0 - q) * threshold
    size = xp.hypot(a * held, b * u)
    row = xp.argmax(size / floored, axis=-2)[..., None, :]

    def at_row(values: Array) -> Array:
        return xp.take_along_axis(xp.broadcast_to(values, size.shape), row, axis=-2)

    radius = at_row(size)
    radius = xp.where(radius > 0.0, radius, 1.0)
    held_p, u_p, q_p, threshold_p = at_row(held), at_row(u), at_row(q), at_row(threshold)
    above = held - threshold
    above_p = at_row(above)
    crossed = (above_p * threshold - threshold_p * above) / floored
    crossed += q_p / q * threshold_p * held - held_p * threshold
    crossed *= a * b / radius
    crossed = xp.where(np.arange(size.shape[-2])[:, None] == row, 0.0, crossed)
    first = (a * a * held_p * held + b * b * u_p * u) / (radius * floored)
    return [
        (first, (above_p + q_p * threshold_p) / radius),
        (crossed, -(a / b * held_p + b / a * u_p) / radius),
    ]


def _pinned_solve(
    core: Array, right: Array, columns: list[tuple[Array, Array]]
) -> tuple[Array, Array]:
    """(N + F Fᵀ)⁻¹ B and (N + F Fᵀ)⁻¹ F c, one column of F after another.

    ``core`` N (…, m, m, N) is positive definite, ``right`` B (…, m, n, N); ``columns`` are those
    of :func:`_pinned_columns`. Each step is the Sherman-Morrison formula: with h = M⁻¹ f,
    (M + f fᵀ)⁻¹ = M⁻¹ - h hᵀ/(1 + fᵀ h), and (M + f fᵀ)⁻¹ f = h/(1 + fᵀ h). It is written with f of
    unit size, for fᵀ h may overflow.
    """
    xp, n = namespace(core, right), right.shape[-2]
    # Powers of two, which no rounding depends on.
    exponents = [xp.frexp(xp.abs(f).max())[1] for f, _ in columns]
    sizes = [xp.ldexp(1.0, xp.maximum(exponent, -400)) for exponent in exponents]
    units = [f / size for (f, _), size in zip(columns, sizes, strict=True)]
    stacked = xp.concatenate([right, *(unit[..., None, :] for unit in units)], axis=-2)
    solved = linalg.solve(core, stacked)
    shift = xp.zeros_like(units[0])
    for place, (unit, size, (_, factor)) in enumerate(zip(units, sizes, columns, strict=True)):
        h = solved[..., n + place, :]
        weight = h / (size**-2.0 + linalg.dot(unit, h))[..., None, :]
        shift = shift + weight * (factor / size - linalg.dot(unit, shift)[..., None, :])
        projected = linalg.matvec(linalg.transpose(solved), unit)
        solved = solved - linalg.outer(weight, projected)
    return solved[..., :n, :], shift
