"""The Tobit Kalman filter, and the centre's assumed-density filter of censored values."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion_gym import gaussian, linalg
from fusion_gym.arrays import Array
from fusion_gym.namespace import active_rows, namespace
from fusion_gym.systems.tobit.filters import Expectation, KalmanFilter, Scalar
from fusion_gym.systems.tobit.sensors import CensoredSensors

_FAR = 50.0  # a threshold this many deviations away never censors


def expect_censored(sensors: CensoredSensors, mean: Array) -> Expectation:
    """Return the moments of a censored measurement from predicted states (sensors, n, N).

    With ζ = (τ - C x̂)/√R: q = 1 - Φ(ζ), λ = φ(ζ)/q, ŷ = q (C x̂ + λ √R) + (1 - q) τ.

    Source: tobit_token_bucket, equations (5)-(7) and (23).
    """
    latent = linalg.matvec(sensors.measurement_matrix, mean)
    return censored_moments(sensors, latent, sensors.deviation)


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
    return Expectation(
        latent=latent,
        value=value,
        noise_variance=deviation * deviation * variance,
        uncensored_probability=q,
        hazard=moments.hazard,
        truncated_variance=moments.truncated_variance,
    )


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
    return Expectation(
        latent=latent,
        value=below * sensors.finite_threshold + above * sensors.finite_upper + inside * centre,
        noise_variance=inside * deviation**2 * moments.variance + between,
        uncensored_probability=inside,
        hazard=moments.mean,
        truncated_variance=xp.clip(moments.variance, 1e-12, 1.0),
    )


@dataclass(frozen=True)
class TobitKalmanFilter(KalmanFilter):
    r"""Tobit Kalman filter; without a delivery the prior is the posterior.

    S = q C P Cᵀ q + R v, K = P Cᵀ q S⁻¹ with q, v of :func:`expect_censored`.

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

    def expect(self, mean: Array) -> Expectation:
        """See :class:`NodeFilter`."""
        return expect_censored(self.sensors, mean)


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
        for sensor in active_rows(granted).tolist():
            for component in range(self.sensors.size):
                value, taken = measurement[sensor, component], granted[sensor]
                mean, root = self._take(mean, root, sensor, component, value, taken)
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

    def _take(
        self,
        mean: Array,
        root: Array,
        sensor: int,
        component: int,
        value: Array,
        granted: NDArray[np.bool_],
    ) -> tuple[Array, Array]:
        row = self.sensors.measurement_matrix[sensor, component]
        scalar = Scalar.from_row(root, row, self.sensors.variance[sensor, component])
        xp = namespace(mean, root)
        latent, deviation = linalg.dot(row, mean), xp.sqrt(scalar.variance)
        step = (value - latent) / scalar.variance
        loss = xp.ones_like(step)
        for sign, threshold in ((1.0, self.sensors.threshold), (-1.0, self.sensors.upper)):
            limit = threshold[sensor, component]
            if not np.isfinite(limit).all():
                continue
            censored = value <= limit if sign > 0 else value >= limit
            distance = sign * (latent - limit) / deviation
            step = xp.where(censored, -sign * gaussian.hazard(distance) / deviation, step)
            loss = xp.where(censored, _loss(distance), loss)
        step = xp.where(granted, step, 0.0)
        loss = xp.where(granted, loss, 0.0)
        return mean + scalar.cross * step, scalar.posterior(loss)


def _loss(distance: Array) -> Array:
    """Return h (h - t) = 1 - variance of a standard normal beyond t."""
    return 1.0 - gaussian.truncated_variance(distance)
