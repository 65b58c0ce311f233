"""Kalman filters for sensors that share a noise with the plant, run on bounds of the variances.

Source: adaptive_innovation (K. Xu, X. Li, J. Wang and Y. Gao, "Robust sequential fusion estimation
based on adaptive innovation event-triggered mechanism for uncertain networked systems", 2022).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.plants import LinearPlant
from fusion_gym.validation import Array


@dataclass(frozen=True)
class CorrelatedSensors:
    """y_i = H_i x + η_i + β_i w, where w is the very noise that has just moved the plant.

    Shapes: ``measurement_matrix`` H (sensors, m, n, 1); ``deviation`` (sensors, m, 1), the bound
    of the standard deviation of η; ``coupling`` β Q^½ (sensors, m, r, 1), for w written as Q^½
    times r standard normals. From them follow the bounds ``covariance`` R_ij (sensors, sensors,
    m, m, 1) between the measurement noises of two sensors and ``cross_covariance`` S_i
    (sensors, n, m, 1) between Γ w and a measurement noise. Build one with :meth:`create`.

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
        """Check plain arrays: H (sensors, m, n), variances of η (sensors, m), β (sensors, m, r).

        One number for all sensors or one for each will do for the last two. ``process_deviation``
        (r,) is Q^½, and ``plant.process_factor`` is Γ Q^½.

        Raises:
            ConfigurationError: a wrong shape, a variance <= 0, or an entry that is not finite.
        """
        matrix = validation.array("measurement_matrices", measurement_matrices, (None, None, None))
        matrix = validation.array(
            "measurement_matrices", measurement_matrices, (*matrix.shape[:2], plant.size)
        )
        sensors, size, _ = matrix.shape
        variance = validation.positive(
            "measurement_variance",
            _one_each(measurement_variance, sensors, 1),
            (sensors, size),
        )
        beta = validation.spread(
            "noise_coupling",
            _one_each(noise_coupling, sensors, 2),
            (sensors, size, len(process_deviation)),
        )
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
        """Standard normals that one measurement of all sensors consumes besides the plant's."""
        return self.count * self.size

    def measure(self, state: Array, process_noise: Array, noise: Array) -> Array:
        """Measurements (sensors, m, N) of the state (n, N) that has just been reached.

        ``process_noise`` (r, N) are the normals that moved the plant there, ``noise``
        (sensors·m, N) the sensors' own; both of unit variance for noises at their bounds.

        Source: adaptive_innovation, equations (2) and (3).
        """
        result = linalg.matvec(self.measurement_matrix, state)
        result += self.deviation * noise.reshape(self.count, self.size, noise.shape[-1])
        result += linalg.matvec(self.coupling, process_noise)
        return result


def _one_each(value: ArrayLike, sensors: int, missing: int) -> ArrayLike:
    """One number a sensor as a column that broadcasts over its ``missing`` later axes."""
    try:
        given = np.asarray(value)
    except ValueError:
        return value
    return given.reshape(-1, *[1] * missing) if given.shape == (sensors,) else value


class RobustPlan(NamedTuple):
    """What a delivery would do at every node; none of it depends on the measurement.

    ``gain`` K (sensors, n, m, N); ``innovation_covariance`` (sensors, m, m, N);
    ``delivered_covariance`` (sensors, n, n, N).
    """

    gain: Array
    innovation_covariance: Array
    delivered_covariance: Array


@dataclass(frozen=True)
class RobustKalmanFilter:
    """The minimum-variance filter of each node for noises at the bounds of their variances.

    It knows that its measurement noise is correlated with the noise that moved the plant. Without
    a delivery the posterior is the prior. For smaller actual variances its covariance is an upper
    bound of the actual one (Theorem 1), whatever is delivered, as long as what is delivered does
    not depend on the noise.

    Source: adaptive_innovation, equation (12), with R_ii and S_i of :class:`CorrelatedSensors`.
    """

    sensors: CorrelatedSensors

    def expect(self, mean: Array) -> Array:
        """Expected measurements H x̂ (sensors, m, N) from prior means (sensors, n, N)."""
        return linalg.matvec(self.sensors.measurement_matrix, mean)

    def innovation_covariance(self, covariance: Array) -> Array:
        """H P Hᵀ + H S + (H S)ᵀ + R (sensors, m, m, N), P (sensors, n, n, N) or (n, n, N).

        It holds for any estimate whose prior error contains Γ w, the fused one too.
        """
        sensors = self.sensors
        matrix = sensors.measurement_matrix
        own = np.arange(sensors.count)
        crossed = linalg.matmul(matrix, sensors.cross_covariance)
        noise = sensors.covariance[own, own] + crossed + linalg.transpose(crossed)
        return linalg.congruence(matrix, covariance) + noise

    def plan(self, covariance: Array) -> RobustPlan:
        """Gains and posterior covariances from prior covariances (sensors, n, n, N).

        Source: adaptive_innovation, equation (12).
        """
        sensors = self.sensors
        cross = linalg.matmul(covariance, linalg.transpose(sensors.measurement_matrix))
        cross += sensors.cross_covariance
        innovation = self.innovation_covariance(covariance)
        if sensors.size == 1:
            gain = cross / innovation
        else:
            gain = linalg.transpose(linalg.solve(innovation, linalg.transpose(cross)))
        reduction = linalg.matmul(gain, linalg.transpose(cross))
        return RobustPlan(gain, innovation, linalg.symmetrise(covariance - reduction))


@dataclass(frozen=True)
class JointErrorCovariance:
    """Actual covariances of the errors of all estimates together, cross-covariances included.

    Estimate 0 is the fused one, estimates 1..l are the nodes'. The joint covariance is an array
    (l + 1, l + 1, n, n, N) of blocks. It is exact for every pattern of deliveries that does not
    depend on the noise; it contains (23) and (28), and, by applying the fusion's weights to it,
    (43) and (55) together with the cross-covariances of the fused prediction that these need.

    Shapes: ``transition`` (n, n, 1), ``process_covariance`` (n, n, 1), ``initial_covariance``
    (n, n, 1); ``measurement_matrix`` (l + 1, m, n, 1), ``cross_covariance`` (l + 1, n, m, 1) and
    ``covariance`` (l + 1, l + 1, m, m, 1) as in :class:`CorrelatedSensors`, with zeros for the
    fused estimate, which measures nothing. All are bounds; ``scale`` (N,) makes them actual.

    Source: adaptive_innovation, equations (16), (17), (23), (28), (43), (55).
    """

    transition: Array
    process_covariance: Array
    initial_covariance: Array
    measurement_matrix: Array
    cross_covariance: Array
    covariance: Array

    @classmethod
    def create(cls, plant: LinearPlant, sensors: CorrelatedSensors) -> JointErrorCovariance:
        """From the plant and its sensors."""
        ahead = [(1, 0), (0, 0), (0, 0), (0, 0)]
        return cls(
            transition=plant.transition,
            process_covariance=plant.process_covariance,
            initial_covariance=plant.initial_covariance,
            measurement_matrix=np.pad(sensors.measurement_matrix, ahead),
            cross_covariance=np.pad(sensors.cross_covariance, ahead),
            covariance=np.pad(sensors.covariance, [(1, 0), *ahead]),
        )

    def start(self, scale: Array) -> Array:
        """At time 0 every estimate is the initial mean: all blocks equal, (l+1, l+1, n, n, N)."""
        count = len(self.measurement_matrix)
        actual = scale * self.initial_covariance
        return np.broadcast_to(actual, (count, count, *actual.shape)).copy()

    def predict(self, joint: Array, scale: Array) -> Array:
        """Φ J Φᵀ + scale · Q in every block."""
        moved = linalg.matmul(self.transition, joint)
        moved = linalg.matmul(moved, linalg.transpose(self.transition))
        return moved + scale * self.process_covariance

    def update(self, joint: Array, gain: Array, granted: NDArray[np.bool_], scale: Array) -> Array:
        """The nodes with ``granted`` (l, N) update with their gains (l, n, m, N)."""
        used = np.zeros((len(joint), *gain.shape[1:]))
        used[1:] = np.where(granted[:, None, None], gain, 0.0)
        kept = linalg.identity(joint.shape[-2]) - linalg.matmul(used, self.measurement_matrix)
        result = linalg.matmul(kept[:, None], joint)
        result = linalg.matmul(result, linalg.transpose(kept)[None])
        crossed = linalg.matmul(kept[:, None], (scale * self.cross_covariance)[None])
        crossed = linalg.matmul(crossed, linalg.transpose(used)[None])
        noise = linalg.matmul(used[:, None], scale * self.covariance)
        noise = linalg.matmul(noise, linalg.transpose(used)[None])
        return _symmetric(result - crossed - _transposed(crossed) + noise)

    def fuse(self, joint: Array, weights: Array) -> Array:
        """Estimate 0 becomes Σ_j weights_j · estimate j, weights (l + 1, n, n, N) with sum I."""
        row = linalg.matmul(weights[:, None], joint).sum(0)
        fused = linalg.matmul(row, linalg.transpose(weights)).sum(0)
        result = joint.copy()
        result[0] = row
        result[:, 0] = linalg.transpose(row)
        result[0, 0] = linalg.symmetrise(fused)
        return result


def _transposed(joint: Array) -> Array:
    return joint.swapaxes(0, 1).swapaxes(2, 3)


def _symmetric(joint: Array) -> Array:
    return (joint + _transposed(joint)) * 0.5
