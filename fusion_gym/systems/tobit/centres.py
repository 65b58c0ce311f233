"""Centres of linear systems: all deliveries together, a hold of values, silence as information."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.errors import ConfigurationError, forbidden, refusal
from fusion_gym.namespace import active_rows, namespace
from fusion_gym.systems.linear_plant import LinearPlant
from fusion_gym.systems.silence import Silence
from fusion_gym.systems.tobit.centre import (
    Centre,
    CentrePrediction,
    FederatedCentre,
    Gaussian,
    Packets,
)
from fusion_gym.systems.tobit.filters import KalmanFilter, joint_update
from fusion_gym.systems.tobit.sensors import CensoredSensors

_MOST_CHANNELS = 100  # whose joint covariance is solved in every step
_ROUNDS = 2  # a third changes errors by less than a thousandth
_LEAST_SHARE = 1e-9  # of a variance; the rest of the difference is rounding


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


@dataclass(frozen=True)
class HoldCentre(Centre):
    r"""Least squares of the held values, weighted by the noises, without a filter.

    The covariance is the mean squared error by the model. It follows the second moment Σ of (x, d),
    with d = C x - ȳ what happened since the deliveries.

    Equation:
        $$
        \hat x=C^{+}\bar y,\qquad C^{+}=(C^{\mathsf T}R^{-1}C)^{-1}C^{\mathsf T}R^{-1},\qquad
        P=C^{+}\,\Sigma_{dd}\,(C^{+})^{\mathsf T}
        $$

        $$
        \Sigma'=F\Sigma F^{\mathsf T}+\begin{pmatrix}I\\C\end{pmatrix}W\begin{pmatrix}I\\
        C\end{pmatrix}^{\mathsf T},\qquad F=\begin{pmatrix}A&0\\C(A-I)&I\end{pmatrix}
        $$

        ȳ, C and R stack the last delivered values, matrices and variances of all sensors. A
        delivery of sensor i sets d_i = -v_i: its rows and columns of Σ become zero but for the
        covariance R_i.

    Assumes: deliveries at times that do not depend on the values, for P; and sensors that together
    determine the state.

    Source: none; the hold of control practice, with the moments of the model.
    """

    filter: KalmanFilter
    plant: LinearPlant
    traceable = False

    @functools.cached_property
    def inverse(self) -> Array:
        """C⁺ (n, channels, 1)."""
        matrix, size, deviation = _unit_free(self.sensors)
        inverse: Array = np.linalg.pinv(matrix) / size[:, None] / deviation
        return inverse[..., None]

    @functools.cached_property
    def motion(self) -> tuple[Array, Array]:
        """F and the covariance of the noise of (x, d), each (n + channels, n + channels, 1)."""
        matrix, transition = self.sensors.stacked_matrix[..., 0], self.plant.transition[..., 0]
        channels, n = matrix.shape
        still: Array = np.eye(n)
        state = [transition, np.zeros((n, channels))]
        motion: Array = np.block([state, [matrix @ (transition - still), np.eye(channels)]])
        both = np.concatenate([still, matrix])[..., None]
        return motion[..., None], linalg.congruence(both, self.plant.process_covariance)

    def predict(self, mean: Array, covariance: Array, held: Array, time: Array) -> CentrePrediction:
        """See :class:`Centre`; the prediction of the start, when every value is delivered."""
        n, channels = self.inverse.shape[:2]
        moment = np.zeros((n + channels, n + channels, mean.shape[-1]))
        moment[:n, :n] = covariance + linalg.outer(mean, mean)
        return self._predict((mean, covariance), held, moment)

    def advance(self, model: LinearPlant, state: Any) -> tuple[Gaussian, CentrePrediction]:
        """See :class:`Centre`; the estimate stays."""
        before = state.prediction
        if before is None:
            runs, plant = state.mean.shape[-1], self.plant
            first = (plant.initial_mean, plant.initial_covariance)
            mean, covariance = (np.repeat(values, runs, axis=-1) for values in first)
            before = self.predict(mean, covariance, state.held, state.time)
        transition, noise = self.motion
        moment = self._delivered(before.moment, state.age == 0.0)
        moment = linalg.congruence(transition, moment) + noise
        prior = state.mean, self._covariance(moment)
        return prior, self._predict(prior, state.held, moment)

    def update(
        self, prior: Gaussian, prediction: CentrePrediction, measurement: Array, granted: Packets
    ) -> Gaussian:
        """See :class:`Centre`."""
        held = np.where(granted[:, None], measurement, prediction.held)
        mean = linalg.matvec(self.inverse, held.reshape(-1, held.shape[-1]))
        return mean, self._covariance(self._delivered(prediction.moment, granted))

    def _predict(self, prior: Gaussian, held: Array, moment: Array) -> CentrePrediction:
        expectation, root = self.filter.expect(prior[0]), linalg.root(prior[1])
        observed = linalg.matmul(self.sensors.measurement_matrix, root)
        spread = linalg.total(observed * observed) + self.sensors.variance
        return CentrePrediction(expectation, np.sqrt(spread), root, held=held, moment=moment)

    def _delivered(self, moment: Array, granted: Packets) -> Array:
        """Return Σ after the deliveries (sensors, N)."""
        n = self.plant.size
        late = np.repeat(~granted, self.sensors.size, axis=0).astype(np.float64)
        keep = np.concatenate([np.ones((n, late.shape[-1])), late])
        result = keep[:, None] * keep * moment
        noise = (1.0 - late) * self.sensors.variance.reshape(-1, 1)
        places = np.arange(n, len(keep))
        result[places, places] += noise
        return result

    def _covariance(self, moment: Array) -> Array:
        n = self.plant.size
        return linalg.congruence(self.inverse, moment[n:, n:])


def _unit_free(sensors: CensoredSensors) -> tuple[Array, Array, Array]:
    """Return R^-½ C S⁻¹ (channels, n), S (n,) that makes its columns of length 1, and √R."""
    deviation = sensors.deviation.reshape(-1)
    matrix = sensors.stacked_matrix[..., 0] / deviation[:, None]
    size = np.sqrt((matrix * matrix).sum(0))
    size = np.where(size > 0.0, size, 1.0)
    return matrix / size, size, deviation


def hold_centre(sensors: CensoredSensors, plant: LinearPlant) -> HoldCentre:
    """Return the centre of ``filter="hold"``.

    Args:
        sensors: the sensors.
        plant: the plant of the model.

    Raises:
        ConfigurationError: censored sensors, or sensors that do not determine the state.
    """
    for part in (plant, sensors):
        part.refuse_schedule("with filter='hold'")
    rank = int(np.linalg.matrix_rank(_unit_free(sensors)[0]))
    if rank < plant.size:
        raise ConfigurationError(
            f"filter = 'hold' is not allowed with measurement_matrices of rank {rank}: together "
            f"they must determine all {plant.size} states, because a held value has no model"
        )
    if not sensors.unlimited:
        raise forbidden("filter", "hold", "a held limit is no measurement", "with censored sensors")
    return HoldCentre(KalmanFilter(sensors), plant)


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
    traceable = False
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
        noise = sensors.variance.reshape(sensors.noise_channels, -1)
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
