"""Linear sensors of the state, each with its own noise covariance.

Source: unknown_input, equation (2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.systems.linear_plant import Sensors
from fusion_gym.systems.unknown_input.plant import UnknownInputPlant
from fusion_gym.validation import ConfigurationError

_RANK = 1e-8  # singular values below this share of what they could be count as zero


@dataclass(frozen=True)
class InputSensors(Sensors):
    """y_i(k) = C_i x(k) + ν_i(k), ν_i ~ N(0, V_i), with an input that every sensor can observe.

    Shapes: ``measurement_matrix`` C (l, m, n, 1), ``covariance`` V (l, m, m, 1), ``factor``
    (l, m, m, 1) with factor factorᵀ = V. From the plant: ``inverse`` (C ℬ)⁺ (l, q, m, 1) and
    ``complement`` U (l, m, m - q, 1), an orthonormal basis of the kernel of (C ℬ)ᵀ.

    Source: unknown_input, equation (2).
    """

    measurement_matrix: Array
    covariance: Array
    factor: Array
    inverse: Array
    complement: Array

    @classmethod
    def create(
        cls, matrices: ArrayLike, covariances: ArrayLike, plant: UnknownInputPlant
    ) -> InputSensors:
        """Return sensors from arrays without a batch axis.

        Args:
            matrices: C (l, m, n).
            covariances: V: one number, one per sensor, variances (l, m), or matrices (l, m, m).
            plant: the plant.

        Raises:
            ConfigurationError: a wrong shape, a V_i that is not positive definite, or a sensor that
                cannot observe the input: rank(C_i ℬ) below the number of inputs.
        """
        c = validation.array("measurement_matrices", matrices, (None, None, plant.size))
        noise = _noise_covariances(covariances, *c.shape[:2])
        inverses, complements = [], []
        for sensor, matrix in enumerate(c):
            inverse, complement = _observable_input(sensor, matrix, plant)
            inverses.append(inverse)
            complements.append(complement)
        return cls(
            measurement_matrix=c[..., None],
            covariance=noise[..., None],
            factor=np.asarray(np.linalg.cholesky(noise), dtype=np.float64)[..., None],
            inverse=np.array(inverses)[..., None],
            complement=np.array(complements)[..., None],
        )

    def measure(self, state: Array, noise: Array) -> Array:
        """Return measurements (l, m, N) of the state (n, N) with standard normals (l·m, N)."""
        result = linalg.matvec(self.measurement_matrix, state)
        result += linalg.matvec(self.factor, noise.reshape(self.count, self.size, -1))
        return result

    def expect(self, mean: Array) -> Array:
        """Return C x̂ (l, m, N) of means (l, s, N) or (s, N) that begin with the n states."""
        matrix = self.measurement_matrix
        return linalg.matvec(matrix, mean[..., : matrix.shape[2], :])


def _noise_covariances(value: ArrayLike, sensors: int, size: int) -> Array:
    """Return V as (l, m, m)."""
    try:
        values = np.asarray(value)
    except ValueError:
        values = np.empty(0)
    if values.shape == (sensors, size, size):
        return np.array(
            [
                validation.covariance(f"measurement_covariance[{i}]", value, size, definite=True)
                for i, value in enumerate(values)
            ]
        )
    value = validation.by_row(value, (sensors, size))
    variances = validation.positive("measurement_covariance", value, (sensors, size))
    return variances[..., None] * np.eye(size)


def _observable_input(sensor: int, matrix: Array, plant: UnknownInputPlant) -> tuple[Array, Array]:
    """Return (C ℬ)⁺ and the kernel of (C ℬ)ᵀ, or refuse a C ℬ of deficient rank."""
    inputs = plant.input_matrix[..., 0]
    q, observed = plant.inputs, matrix @ inputs
    left, values, right = np.linalg.svd(observed)
    possible = np.linalg.norm(matrix, 2) * np.linalg.norm(inputs, 2)
    rank = int(np.sum(values > _RANK * possible))
    if rank < q:
        raise ConfigurationError(
            f"measurement_matrices[{sensor}] = {validation.display(matrix)} is not allowed: the "
            f"sensor must measure every input, but rank(C B) is {rank} for {q} "
            f"input{'s' if q > 1 else ''} (B is the input matrix over one sampling interval)"
        )
    return right.T @ np.diag(1.0 / values) @ left[:, :q].T, left[:, q:]
