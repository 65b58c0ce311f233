"""Sensors whose noise contains the process noise of the present step.

Source: adaptive_innovation (K. Xu, X. Li, J. Wang and Y. Gao, "Robust sequential fusion estimation
based on adaptive innovation event-triggered mechanism for uncertain networked systems", 2022).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.systems.linear_plant import LinearPlant, Sensors


@dataclass(frozen=True)
class CorrelatedSensors(Sensors):
    """y_i = H_i x + η_i + β_i w, where w is the noise that has just moved the plant.

    Shapes: ``measurement_matrix`` H (sensors, m, n, 1); ``deviation`` (sensors, m, 1), the bound of
    the standard deviation of η; ``coupling`` β Q^½ (sensors, m, r, 1), for w written as Q^½ times r
    standard normals. They imply the bounds ``covariance`` R_ij (sensors, sensors, m, m, 1) of two
    sensors' measurement noises and ``cross_covariance`` S_i (sensors, n, m, 1) of Γ w and a
    measurement noise.

    Source: adaptive_innovation, equations (2), (3), (5), (6).
    """

    measurement_matrix: Array
    deviation: Array
    coupling: Array
    covariance: Array
    cross_covariance: Array

    @classmethod
    def create(
        cls,
        measurement_matrices: ArrayLike,
        measurement_variance: ArrayLike,
        noise_coupling: ArrayLike,
        process_deviation: Array,
        plant: LinearPlant,
    ) -> CorrelatedSensors:
        """Return sensors from arrays without a batch axis.

        Args:
            measurement_matrices: H (sensors, m, n).
            measurement_variance: variances of η (sensors, m), or one number for all or for each
                sensor.
            noise_coupling: β (sensors, m, r), or one number for all or for each sensor.
            process_deviation: Q^½ (r,).
            plant: the plant, whose ``process_factor`` is Γ Q^½.

        Raises:
            ConfigurationError: a wrong shape, a variance <= 0, or an entry that is not finite.
        """
        shape = (None, None, plant.size)
        matrix = validation.array("measurement_matrices", measurement_matrices, shape)
        sensors, size, _ = matrix.shape
        given = validation.by_row(measurement_variance, (sensors, size))
        variance = validation.positive("measurement_variance", given, (sensors, size))
        shares = (sensors, size, len(process_deviation))
        given = validation.by_row(noise_coupling, shares)
        beta = validation.spread("noise_coupling", given, shares)
        coupling = (beta * process_deviation)[..., None]
        shared = linalg.matmul(coupling[:, None], linalg.transpose(coupling)[None])
        own = variance[:, None, :, None] * np.eye(size) * np.eye(sensors)[:, :, None, None]
        return cls(
            measurement_matrix=matrix[..., None],
            deviation=np.sqrt(variance)[..., None],
            coupling=coupling,
            covariance=shared + own[..., None],
            cross_covariance=linalg.matmul(plant.process_factor, linalg.transpose(coupling)),
        )

    def measure(self, state: Array, process_noise: Array, noise: Array) -> Array:
        """Return the measurements (sensors, m, N).

        Args:
            state: the present state (n, N).
            process_noise: the normals (r, N) that moved the plant to it.
            noise: the sensors' normals (sensors·m, N). Both have unit variance for noises at their
                bounds.

        Source: adaptive_innovation, equations (2) and (3).
        """
        result = linalg.matvec(self.measurement_matrix, state)
        result += self.deviation * noise.reshape(self.count, self.size, noise.shape[-1])
        result += linalg.matvec(self.coupling, process_noise)
        return result

    def select(self, sensor: int) -> CorrelatedSensors:
        """Return one of the sensors alone."""
        own = slice(sensor, sensor + 1)
        parts = {name: value[own] for name, value in vars(self).items() if name != "covariance"}
        return CorrelatedSensors(**parts, covariance=self.covariance[own, own])
