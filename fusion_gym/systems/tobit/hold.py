"""The centre that practice runs: it holds the last value of every sensor."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.errors import ConfigurationError, forbidden
from fusion_gym.systems.linear_plant import LinearPlant
from fusion_gym.systems.tobit.centre import Centre, CentrePrediction, Gaussian, Packets
from fusion_gym.systems.tobit.filters import KalmanFilter
from fusion_gym.systems.tobit.sensors import CensoredSensors


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
    numpy_only = "filter"

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
    rank = int(np.linalg.matrix_rank(_unit_free(sensors)[0]))
    if rank < plant.size:
        raise ConfigurationError(
            f"filter = 'hold' is not allowed with measurement_matrices of rank {rank}: together "
            f"they must determine all {plant.size} states, because a held value has no model"
        )
    if not sensors.unlimited:
        raise forbidden("filter", "hold", "a held limit is no measurement", "with censored sensors")
    return HoldCentre(KalmanFilter(sensors), plant)
