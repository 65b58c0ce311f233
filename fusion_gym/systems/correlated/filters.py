"""Sensors that share a noise with the plant, and Kalman filters at the bounds of the variances.

Source: adaptive_innovation (K. Xu, X. Li, J. Wang and Y. Gao, "Robust sequential fusion estimation
based on adaptive innovation event-triggered mechanism for uncertain networked systems", 2022).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.namespace import namespace
from fusion_gym.systems.linear_plant import LinearPlant, Sensors
from fusion_gym.systems.schedule import MatrixSchedule


@dataclass(frozen=True)
class CorrelatedSensors(Sensors):
    """y_i = H_i x + η_i + β_i w, where w is the noise that has just moved the plant.

    Shapes: ``measurement_matrix`` H (sensors, m, n, 1); ``deviation`` (sensors, m, 1), the bound of
    the standard deviation of η; ``coupling`` β Q^½ (sensors, m, r, 1), for w written as Q^½ times r
    standard normals. They imply the bounds ``covariance`` R_ij (sensors, sensors, m, m, 1) of two
    sensors' measurement noises and ``cross_covariance`` S_i (sensors, n, m, 1) of Γ w and a
    measurement noise. With a ``schedule`` all of them depend on the step.

    Source: adaptive_innovation, equations (2), (3), (5), (6).
    """

    measurement_matrix: Array
    deviation: Array
    coupling: Array
    covariance: Array
    cross_covariance: Array
    schedule: MatrixSchedule | None = None

    @classmethod
    def create(
        cls, options: Any, process_deviation: Array, plant: LinearPlant
    ) -> CorrelatedSensors:
        """Return the sensors of an environment's options.

        Args:
            options: arrays without a batch axis: ``measurement_matrices`` H (sensors, m, n),
                ``measurement_variance``, variances of η (sensors, m), and ``noise_coupling`` β
                (sensors, m, r); of the last two also one number for all or for each sensor.
            process_deviation: Q^½ (r,).
            plant: the plant, whose ``process_factor`` is Γ Q^½.

        Raises:
            ConfigurationError: a wrong shape, a variance <= 0, or an entry that is not finite.
        """
        shape = (None, None, plant.size)
        matrix = validation.array("measurement_matrices", options.measurement_matrices, shape)
        sensors, size, _ = matrix.shape
        given = validation.by_row(options.measurement_variance, (sensors, size))
        variance = validation.positive("measurement_variance", given, (sensors, size))
        shares = (sensors, size, len(process_deviation))
        given = validation.by_row(options.noise_coupling, shares)
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
        own, schedule = slice(sensor, sensor + 1), self.schedule

        def parts(values: Mapping[str, Any]) -> dict[str, Any]:
            pairs = {"covariance": (own, own)}
            return {name: value[pairs.get(name, own)] for name, value in values.items()}

        arrays = parts({k: value for k, value in vars(self).items() if k != "schedule"})
        changed = schedule and schedule._replace(stacks=parts(schedule.stacks))
        return CorrelatedSensors(**arrays, schedule=changed)


class RobustOutcomes(NamedTuple):
    """The effect of a delivery at every node, independent of the measurement.

    ``gain`` K (sensors, n, m, N); ``innovation_covariance`` (sensors, m, m, N);
    ``delivered_covariance`` (sensors, n, n, N).
    """

    gain: Array
    innovation_covariance: Array
    delivered_covariance: Array


@dataclass(frozen=True)
class RobustKalmanFilter:
    r"""Minimum-variance filter of each node for noises at the bounds of their variances.

    It accounts for the correlation of the measurement noise with the process noise. Without a
    delivery the posterior is the prior. For smaller actual variances its covariance is an upper
    bound of the actual one (Theorem 1), for every pattern of deliveries that does not depend on the
    noise.

    Equation:
        $$
        S_y=H P H^{\mathsf T}+H S+(H S)^{\mathsf T}+R,\qquad K=(P H^{\mathsf T}+S)\,S_y^{-1}
        $$

        $$
        \hat x^{+}=\hat x+K(y-H\hat x),\qquad P^{+}=P-K(P H^{\mathsf T}+S)^{\mathsf T}
        $$

        S = Γ σ_w² βᵀ is the covariance of the process noise and the sensor's noise, R = σ_η² + β
        σ_w² βᵀ; all variances stand at their bounds. When nothing arrives the prediction stays.

    Assumes: a linear plant, variances below their bounds, all in one proportion, and
    transmissions that are not chosen by the noise.

    Source: adaptive_innovation, equation (12), with R_ii and S_i of :class:`CorrelatedSensors`.
    """

    sensors: CorrelatedSensors

    def expect(self, mean: Array) -> Array:
        """Return the expected measurements H x̂ (sensors, m, N) of prior means (sensors, n, N)."""
        return linalg.matvec(self.sensors.measurement_matrix, mean)

    def innovation_covariance(self, covariance: Array) -> Array:
        """Return H P Hᵀ + H S + (H S)ᵀ + R (sensors, m, m, N).

        It holds for any estimate whose prior error contains Γ w, including the fused one.

        Args:
            covariance: P (sensors, n, n, N) or (n, n, N).
        """
        sensors = self.sensors
        matrix = sensors.measurement_matrix
        own = np.arange(sensors.count)
        crossed = linalg.matmul(matrix, sensors.cross_covariance)
        noise = sensors.covariance[own, own] + crossed + linalg.transpose(crossed)
        return linalg.congruence(matrix, covariance) + noise

    def outcomes(self, covariance: Array) -> RobustOutcomes:
        """Return gains and posterior covariances from prior covariances (sensors, n, n, N).

        Source: adaptive_innovation, equation (12).
        """
        sensors = self.sensors
        matrix, common = sensors.measurement_matrix, sensors.cross_covariance
        cross = linalg.matmul(covariance, linalg.transpose(matrix))
        cross += common
        innovation = self.innovation_covariance(covariance)
        gain = linalg.transpose(linalg.solve(innovation, linalg.transpose(cross)))
        rest = linalg.identity(covariance.shape[-2]) - linalg.matmul(gain, matrix)
        shared = linalg.matmul(linalg.matmul(rest, common), linalg.transpose(gain))
        own = np.arange(sensors.count)
        delivered = linalg.congruence(rest, covariance)
        delivered += linalg.congruence(gain, sensors.covariance[own, own])
        delivered -= shared + linalg.transpose(shared)
        return RobustOutcomes(gain, innovation, delivered)


@dataclass(frozen=True)
class JointErrorCovariance:
    """Bound of the joint covariance of the errors of all estimates.

    Estimate 0 is the fused one, estimates 1..l are the nodes'. The joint covariance is an array
    (l + 1, l + 1, n, n, N) of blocks. It is exact for every pattern of deliveries that does not
    depend on the noise. It contains (23) and (28). With the fusion's weights it gives (43) and (55)
    together with the cross-covariances of the fused prediction in them.

    Shapes: ``measurement_matrix`` (l + 1, m, n, 1), ``cross_covariance`` (l + 1, n, m, 1) and
    ``covariance`` (l + 1, l + 1, m, m, 1) as in :class:`CorrelatedSensors`, with zeros for the
    fused estimate, which measures nothing. They and the plant's covariances are bounds; actual
    values are proportional.

    Source: adaptive_innovation, equations (16), (17), (23), (28), (43), (55).
    """

    plant: LinearPlant
    measurement_matrix: Array
    cross_covariance: Array
    covariance: Array

    @classmethod
    def create(cls, plant: LinearPlant, sensors: CorrelatedSensors) -> JointErrorCovariance:
        """Return the recursion of a plant and its sensors."""
        for part in (plant, sensors):
            part.refuse_schedule("with track_actual=True")
        ahead = [(1, 0), (0, 0), (0, 0), (0, 0)]
        return cls(
            plant=plant,
            measurement_matrix=np.pad(sensors.measurement_matrix, ahead),
            cross_covariance=np.pad(sensors.cross_covariance, ahead),
            covariance=np.pad(sensors.covariance, [(1, 0), *ahead]),
        )

    def start(self, runs: int) -> Array:
        """Return the joint covariance (l+1, l+1, n, n, N) of time 0: all estimates are equal."""
        count, start = len(self.measurement_matrix), self.plant.initial_covariance
        return np.broadcast_to(start, (count, count, *start.shape[:2], runs)).copy()

    def predict(self, joint: Array) -> Array:
        """Return Φ J Φᵀ + Q in every block."""
        moved = linalg.matmul(self.plant.transition, joint)
        moved = linalg.matmul(moved, linalg.transpose(self.plant.transition))
        return moved + self.plant.process_covariance

    def update(self, joint: Array, gain: Array, granted: NDArray[np.bool_]) -> Array:
        """Return the joint covariance after granted (l, N) nodes update with gains (l, n, m, N)."""
        xp, nothing = namespace(gain), np.zeros((1, *gain.shape[1:]))
        used = xp.concatenate((nothing, xp.where(granted[:, None, None], gain, 0.0)))
        retention = linalg.identity(joint.shape[-2]) - linalg.matmul(used, self.measurement_matrix)
        result = linalg.matmul(retention[:, None], joint)
        result = linalg.matmul(result, linalg.transpose(retention)[None])
        crossed = linalg.matmul(retention[:, None], self.cross_covariance[None])
        crossed = linalg.matmul(crossed, linalg.transpose(used)[None])
        noise = linalg.matmul(used[:, None], self.covariance)
        noise = linalg.matmul(noise, linalg.transpose(used)[None])
        return _symmetric(result - crossed - _transposed(crossed) + noise)

    def fuse(self, joint: Array, weights: Array) -> Array:
        """Return the joint covariance after estimate 0 becomes Σ_j weights_j · estimate j."""
        row = linalg.total(linalg.matmul(weights[:, None], joint), 0)
        fused = linalg.total(linalg.matmul(row, linalg.transpose(weights)), 0)
        xp, column = namespace(joint), linalg.transpose(row)[1:, None]
        first = xp.concatenate((linalg.symmetrise(fused)[None], row[1:]))
        others = xp.concatenate((column, joint[1:, 1:]), axis=1)
        return xp.concatenate((first[None], others))


def _transposed(joint: Array) -> Array:
    return joint.swapaxes(0, 1).swapaxes(2, 3)


def _symmetric(joint: Array) -> Array:
    return (joint + _transposed(joint)) * 0.5
