"""Linear sensors whose components are censored at thresholds (the Tobit model)."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.plant import true_limits
from fusion_gym.errors import forbidden
from fusion_gym.namespace import namespace
from fusion_gym.systems.linear_plant import Sensors
from fusion_gym.systems.schedule import MatrixSchedule

_RIDGE = 4e-15  # relative, for each state: twice what linalg.root takes for rounding
_LARGEST = 1e26  # what a delivery leaves of a larger variance would drown in its rounding


@dataclass(frozen=True)
class CensoredSensors(Sensors):
    """y = clip(C x + v, τ, υ) by component, v ~ N(0, diag(R)), for several sensors of equal size.

    A component that a sensor does not have is always zero: its row of C and its ``noise_deviation``
    are zero, and it is not censored. ``deviation`` is √R. ``uncensored`` marks lower thresholds of
    minus infinity, which ``finite_threshold`` replaces by zero; ``two_sided`` says whether any
    upper threshold is finite, and ``finite_upper`` replaces infinite ones by zero.
    ``noise_correlation`` is a factor L of the noises' correlations L Lᵀ, over the channels of all
    sensors in their order; ``None`` for independent noises. With a ``schedule`` C and R depend on
    the step.

    Shapes: ``measurement_matrix`` C (sensors, m, n, 1), ``variance`` R (sensors, m, 1),
    ``threshold`` τ and ``upper`` υ (sensors, m, 1), in the unit of the measurement, infinite where
    a component is not censored on that side; ``noise_correlation`` L (sensors·m, sensors·m, 1).

    Source: tobit_token_bucket, equations (1) and (2); round_robin_tobit, equations (2) and (6).
    """

    measurement_matrix: Array
    variance: Array
    threshold: Array
    upper: Array
    deviation: Array
    noise_deviation: Array
    uncensored: NDArray[np.bool_]
    finite_threshold: Array
    finite_upper: Array
    two_sided: bool
    noise_correlation: Array | None = None
    schedule: MatrixSchedule | None = None

    @classmethod
    def create(
        cls,
        measurement_matrix: ArrayLike,
        variance: ArrayLike,
        threshold: ArrayLike,
        states: int,
        upper: ArrayLike = np.inf,
        present: NDArray[np.bool_] | None = None,
    ) -> CensoredSensors:
        """Return sensors from arrays without a batch axis.

        Args:
            measurement_matrix: C (sensors, m, states).
            variance: R, broadcast to (sensors, m).
            threshold: τ, broadcast to (sensors, m).
            states: number of states.
            upper: υ, broadcast to (sensors, m).
            present: the components (sensors, m) that the sensors have, by default all.

        Raises:
            ConfigurationError: a wrong shape, a variance <= 0, a lower threshold that is not below
                the upper one, or an entry that is not finite (infinite thresholds are).
        """
        name, most = "measurement_matrices", validation.MOST_SENSORS
        matrix = validation.array(name, measurement_matrix, (None, None, states), most)
        validation.array(f"{name}[0]", matrix[0], (None, states))  # channels are gone through
        shape = matrix.shape[:2]
        low = validation.spread("censoring_threshold", threshold, shape, infinity=-1)
        high = validation.spread("censoring_upper", upper, shape, infinity=1)
        if np.any(low >= high):
            reason = f"each must be below censoring_upper = {validation.display(high)}"
            raise forbidden("censoring_threshold", low, reason)
        uncensored = np.isneginf(low)
        least = validation.SMALLEST**2
        noise = validation.positive("measurement_variance", variance, shape, least)[..., None]
        here = np.ones(shape) if present is None else np.where(present, 1.0, 0.0)
        return cls(
            measurement_matrix=matrix[..., None],
            variance=noise,
            threshold=low[..., None],
            upper=high[..., None],
            deviation=np.sqrt(noise),
            noise_deviation=np.sqrt(noise) * here[..., None],
            uncensored=uncensored[..., None],
            finite_threshold=np.where(uncensored, 0.0, low)[..., None],
            finite_upper=np.where(np.isposinf(high), 0.0, high)[..., None],
            two_sided=bool(np.isfinite(high).any()),
        )

    def measure(self, state: Array, noise: Array, departure: Array | None = None) -> Array:
        """Return the censored measurements (sensors, m, N).

        Args:
            state: (n, N).
            noise: standard normals (sensors·m, N).
            departure: (4, N), or None; it moves the thresholds.
        """
        shape = (self.count, self.size, noise.shape[-1])
        if self.noise_correlation is not None:
            noise = linalg.matvec(self.noise_correlation, noise)
        latent = linalg.matvec(self.measurement_matrix, state)
        latent += self.noise_deviation * noise.reshape(shape)
        xp = namespace(latent)
        latent = xp.maximum(latent, true_limits(departure, self.threshold))
        if not self.two_sided:
            return latent
        return xp.minimum(latent, true_limits(departure, self.upper))

    @property
    def stacked_matrix(self) -> Array:
        """C (sensors·m, n, 1) of all sensors in their order."""
        return self.measurement_matrix.reshape(-1, *self.measurement_matrix.shape[2:])

    @functools.cached_property
    def noise_factor(self) -> Array:
        """F (sensors·m, sensors·m, 1) with F Fᵀ the filters' covariance of all noises.

        The noise of an absent component is independent, of variance 1.
        """
        deviation = self.deviation.reshape(self.noise_channels, 1, -1)
        factor = self.noise_correlation
        return deviation * (linalg.identity(len(deviation)) if factor is None else factor)

    @functools.cached_property
    def noise_covariance(self) -> Array:
        """R (sensors·m, sensors·m, 1) of all noises in the filters."""
        factor = self.noise_factor
        return linalg.symmetrise(linalg.matmul(factor, linalg.transpose(factor)))

    @property
    def unlimited(self) -> bool:
        """Whether no threshold is finite."""
        return bool(self.uncensored.all()) and not self.two_sided

    @functools.cached_property
    def resolution(self) -> Array:
        """Variance (n, 1) of each state from one measurement of all sensors, 1/Σ C² R⁻¹.

        For a state that no sensor measures it is the largest of the others.
        """
        information = (self.measurement_matrix**2 / self.variance[:, :, None]).sum((0, 1))
        observed = information > 0.0
        xp = namespace(information)
        values = 1.0 / xp.where(observed, information, np.inf)
        return xp.where(observed, values, xp.where(observed.any(0), values.max(0), np.inf))

    def regular(self, covariance: Array) -> Array:
        """Return a regular bound of the covariance (n, n, N), larger by its rounding.

        No variance exceeds 10²⁶ resolutions: beyond, an update depends on the covariance's shape
        only.
        """
        result = linalg.add_diagonal(
            covariance, len(covariance) * _RIDGE * linalg.diagonal(covariance)
        )
        xp, limit = namespace(result), _LARGEST * self.resolution
        if xp is np and not result.max() > limit.min():  # each scale is 1
            return result
        scale = xp.sqrt(limit / xp.maximum(linalg.diagonal(result), limit))
        return result * linalg.outer(scale, scale)

    def censored(self, measurement: Array) -> NDArray[np.bool_]:
        """Return which components (sensors, m, N) lie at a threshold."""
        below = measurement <= self.threshold
        return below | (measurement >= self.upper) if self.two_sided else below
