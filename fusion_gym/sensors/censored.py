"""Linear sensors whose components are censored from below (the Tobit model)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.validation import Array


@dataclass(frozen=True)
class CensoredSensors:
    """y = max(C x + v, τ) by component, v ~ N(0, diag(R)), for several sensors of equal size.

    ``deviation`` is √R, ``uncensored`` marks thresholds of minus infinity, which
    ``finite_threshold`` replaces by zero.

    Shapes: ``measurement_matrix`` C (sensors, m, n, 1), ``variance`` R (sensors, m, 1),
    ``threshold`` τ (sensors, m, 1), in the unit of the measurement, minus infinity where a
    component is never censored. Build one with :meth:`create`.

    Source: tobit_token_bucket, equations (1) and (2).
    """

    measurement_matrix: Array
    variance: Array
    threshold: Array
    deviation: Array
    uncensored: NDArray[np.bool_]
    finite_threshold: Array

    @classmethod
    def create(
        cls, measurement_matrix: ArrayLike, variance: ArrayLike, threshold: ArrayLike, states: int
    ) -> CensoredSensors:
        """Check plain arrays: C (sensors, m, states); R and τ broadcast to (sensors, m).

        Raises:
            ConfigurationError: a wrong shape, a variance <= 0, or an entry that is not finite
                (minus infinity is a threshold).
        """
        matrix = validation.array("measurement_matrices", measurement_matrix, (None, None, states))
        shape = matrix.shape[:2]
        low = validation.spread("censoring_threshold", threshold, shape, minus_infinity=True)
        uncensored = np.isneginf(low)
        noise = validation.positive("measurement_variance", variance, shape)[..., None]
        return cls(
            measurement_matrix=matrix[..., None],
            variance=noise,
            threshold=low[..., None],
            deviation=np.sqrt(noise),
            uncensored=uncensored[..., None],
            finite_threshold=np.where(uncensored, 0.0, low)[..., None],
        )

    @property
    def count(self) -> int:
        """Number of sensors."""
        return self.measurement_matrix.shape[0]

    @property
    def size(self) -> int:
        """Number of measured components m of each sensor."""
        return self.measurement_matrix.shape[1]

    @property
    def noise_channels(self) -> int:
        """Standard normals that one measurement of all sensors consumes."""
        return self.count * self.size

    def measure(self, state: Array, noise: Array) -> Array:
        """Censored measurements (sensors, m, N) of the state (n, N) from normals (sensors·m, N)."""
        shape = (self.count, self.size, noise.shape[-1])
        latent = linalg.matvec(self.measurement_matrix, state)
        latent += self.deviation * noise.reshape(shape)
        return np.maximum(latent, self.threshold)
