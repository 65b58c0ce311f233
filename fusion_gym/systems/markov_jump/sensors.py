"""Scalar sensors with fading measurements, different sampling periods and correlated noises.

Source: markov_jump (event-triggered distributed fusion estimation for asynchronous Markov jump
systems with correlated noises and fading measurements).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.errors import forbidden
from fusion_gym.namespace import namespace, take
from fusion_gym.systems.markov_jump.plant import MarkovJumpPlant, Modes, draw_mode, probabilities


@dataclass(frozen=True)
class FadingSensors:
    """y_i(k) = β_i(k) H_iθ x(k) + α_i w(k) + η_i(k) at k = n_i, 2 n_i, …; nothing in between.

    w(k) is the noise that moves the plant from k to k + 1, so that all measurement noises are
    correlated with each other and with it. β_i has a discrete distribution on [0, 1].

    Shapes, with l sensors, n states, r noises, M modes, v values: ``measurement_matrix`` H
    (l, n, M), ``period`` n_i (l, 1) whole numbers, ``fading_values`` (l, v) and
    ``fading_probabilities`` (l, v) of β_i, ``noise_coupling`` α (l, r, 1), ``variance`` of η
    (l, 1), ``deviation`` its root.

    Source: markov_jump, equations (2) and (4), Section 6 for the noise α_i w + η_i (G = 1).
    """

    measurement_matrix: Array
    period: NDArray[np.int64]
    fading_values: Array
    fading_probabilities: Array
    noise_coupling: Array
    variance: Array
    deviation: Array

    @classmethod
    def create(
        cls,
        measurement_matrices: ArrayLike,
        sampling_periods: ArrayLike,
        fading_values: ArrayLike,
        fading_probabilities: ArrayLike,
        noise_coupling: ArrayLike,
        measurement_variance: ArrayLike,
        plant: MarkovJumpPlant,
    ) -> FadingSensors:
        """Return sensors from arrays without a batch axis.

        Args:
            measurement_matrices: H (sensors, modes, n).
            sampling_periods: one number for all sensors or one for each.
            fading_values: (sensors, values).
            fading_probabilities: (sensors, values).
            noise_coupling: α (sensors,) or (sensors, r).
            measurement_variance: one number for all sensors or one for each.
            plant: the plant.

        Raises:
            ConfigurationError: a wrong shape, a period that is no whole number >= 1, a fading value
                outside [0, 1], probabilities of another sum, a variance <= 0, or an entry that is
                not finite.
        """
        matrix = validation.array(
            "measurement_matrices", measurement_matrices, (None, plant.modes, plant.size)
        )
        sensors = len(matrix)
        period = validation.spread("sampling_periods", sampling_periods, (sensors,))
        if np.any(period < 1.0) or np.any(period != np.round(period)):
            reason = "each must be a whole number >= 1"
            raise forbidden("sampling_periods", sampling_periods, reason)
        values = validation.array("fading_values", fading_values, (sensors, None))
        if np.any(values < 0.0) or np.any(values > 1.0):
            raise forbidden("fading_values", values, "each must be from 0 to 1")
        variance = validation.positive("measurement_variance", measurement_variance, (sensors,))
        shape = (sensors, len(plant.noise_covariance))
        coupling = validation.by_row(noise_coupling, shape)
        return cls(
            measurement_matrix=np.ascontiguousarray(matrix.transpose(0, 2, 1)),
            period=period.astype(np.int64)[:, None],
            fading_values=values,
            fading_probabilities=probabilities(
                "fading_probabilities", fading_probabilities, values.shape
            ),
            noise_coupling=validation.spread("noise_coupling", coupling, shape)[..., None],
            variance=variance[:, None],
            deviation=np.sqrt(variance)[:, None],
        )

    @property
    def count(self) -> int:
        """Number of sensors."""
        return self.measurement_matrix.shape[0]

    @property
    def noise_channels(self) -> int:
        """Standard normals of one measurement of all sensors: the β_i, then the η_i."""
        return 2 * self.count

    @property
    def fading_mean(self) -> Array:
        """Mean of each β_i, (sensors,)."""
        return np.asarray((self.fading_values * self.fading_probabilities).sum(1))

    @property
    def fading_variance(self) -> Array:
        """Variance of each β_i, (sensors,)."""
        deviation = self.fading_values - self.fading_mean[:, None]
        return np.asarray((deviation**2 * self.fading_probabilities).sum(1))

    def sampled(self, time: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return γ of (4): which sensors measure at the times (N,) >= 1, (sensors, N)."""
        return time % self.period == 0

    def fading(self, noise: Array) -> Array:
        """Return β (sensors, N) from standard normals (sensors, N)."""
        cumulative = np.cumsum(self.fading_probabilities, 1).T[:-1, :, None]
        place = draw_mode(cumulative, noise)
        return namespace(place).take_along_axis(self.fading_values, place, 1)

    def measure(self, state: Array, mode: Modes, process_noise: Array, noise: Array) -> Array:
        """Return the measurements (sensors, N) as if all sensors sampled.

        Args:
            state: (n, N).
            mode: (N,), of the same time.
            process_noise: w (r, N), of the same time.
            noise: the sensors' normals (2·sensors, N).

        Source: markov_jump, equation (4) with γ = 1.
        """
        matrix = take(self.measurement_matrix, mode)
        result = self.fading(noise[: self.count]) * linalg.dot(matrix, state)
        result += linalg.dot(self.noise_coupling, process_noise)
        result += self.deviation * noise[self.count :]
        return result
