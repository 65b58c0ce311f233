"""Joint estimation of a state and an unknown input: sensors, gain, covariance, input model.

The estimated quantity is z(k) = [x(k); d(k - 1)], of length s = n + q: an input becomes observable
only after it has acted, so its estimate comes one sampling instant late.

Source: unknown_input (Y. Sun, M. Fu, J. Mao and G. Wei, "Recursive filtering of multi-rate
cyber-physical systems with unknown inputs under adaptive event-triggered mechanisms", 2023); S.
Gillijns and B. De Moor, "Unbiased minimum-variance input and state estimation for linear
discrete-time systems", Automatica 43, 2007.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.namespace import namespace, set_at, update_at
from fusion_gym.systems.unknown_input.plant import UnknownInputPlant
from fusion_gym.systems.unknown_input.sensors import InputSensors

_ALL = slice(None)


@dataclass(frozen=True)
class JointGain:
    """The unbiased gain of the smallest variance for [x(k); d(k - 1)], for every input.

    The gain 𝒢 = [N; L] (l, s, m, N) hides the input: 𝒢 C ℬ = [ℬ; I], which is (13) and (14). All
    such gains are [ℬ; I] (C ℬ)⁺ + Z Uᵀ with free Z, and the smallest covariance has Z = (T - [ℬ; I]
    (C ℬ)⁺ Ω) U (Uᵀ Ω U)⁻¹ with T = [Φ Cᵀ; 0], Φ the covariance of x(k) given the past without its
    input, and Ω = C Φ Cᵀ + R. This equals L = ((Cℬ)ᵀ Ω⁻¹ Cℬ)⁻¹ (Cℬ)ᵀ Ω⁻¹ and N = ℬ L + Φ Cᵀ U (Uᵀ Ω
    U)⁻¹ Uᵀ, without an inverse of a nearly singular matrix. With as many inputs as measurements U
    is empty and the gain is unique.

    ``onto`` is [ℬ; I] (C ℬ)⁺ (l, s, m, 1).

    Source: unknown_input, equations (8)-(14), (19), with (20) replaced by the minimiser.
    """

    sensors: InputSensors
    onto: Array

    @classmethod
    def create(cls, plant: UnknownInputPlant, sensors: InputSensors) -> JointGain:
        """Return the gain of a plant and its sensors."""
        lifted = np.concatenate((plant.input_matrix, linalg.identity(plant.inputs)))
        return cls(sensors, linalg.matmul(lifted[None], sensors.inverse))

    def gain(self, covariance: Array, noise: Array) -> Array:
        """Return 𝒢 (l, s, m, N) from Φ (l, n, n, N) and R (l, m, m, N)."""
        sensors = self.sensors
        u = sensors.complement
        free = u.shape[-2]
        if not free:
            return np.broadcast_to(self.onto, (*self.onto.shape[:-1], covariance.shape[-1])).copy()
        cross = linalg.matmul(covariance, linalg.transpose(sensors.measurement_matrix))
        innovation = linalg.matmul(sensors.measurement_matrix, cross) + noise
        through = linalg.matmul(innovation, u)
        weight = linalg.matmul(linalg.transpose(u), through)
        target = -linalg.matmul(self.onto, through)
        states = slice(cross.shape[1])
        target = update_at(np.add, target, (..., states, _ALL, _ALL), linalg.matmul(cross, u))
        if free == 1:  # rounding may make it negative
            choice = target / weight
        else:
            weight = linalg.symmetrise(weight)
            choice = linalg.transpose(linalg.solve(weight, linalg.transpose(target)))
        return self.onto + linalg.matmul(choice, linalg.transpose(u))

    def covariance(self, gain: Array, covariance: Array, noise: Array) -> Array:
        """Return the covariance M Φ Mᵀ + 𝒢 R 𝒢ᵀ (l, s, s, N) of any such gain, M = [I; 0] - 𝒢 C."""
        unit = np.eye(gain.shape[1], covariance.shape[1])[..., None]
        moved = unit - linalg.matmul(gain, self.sensors.measurement_matrix)
        return linalg.congruence(moved, covariance) + linalg.congruence(gain, noise)


@dataclass(frozen=True)
class InputModel:
    """A filter's model of the input without a delivery: d(k) = r d(k - 1) + η(k).

    It implies z(k + 1) = F z(k) + [ℬ η + w; η] with F = [[𝒜, r ℬ], [0, r I]]. ``memory`` r = 1 is a
    random walk; with r < 1 the input's variance stays bounded. The actual input follows no such
    model.

    Shapes: ``state_rows`` [𝒜, r ℬ] (n, s, 1), ``memory`` (q, 1), ``change`` covariance of [ℬ η + w;
    η] (s, s, 1), ``initial_mean`` (s, 1), ``initial_covariance`` (s, s, 1).
    """

    state_rows: Array
    memory: Array
    change: Array
    plant: UnknownInputPlant
    initial_mean: Array
    initial_covariance: Array

    @classmethod
    def create(
        cls, plant: UnknownInputPlant, memory: ArrayLike, change: ArrayLike, deviation: ArrayLike
    ) -> InputModel:
        """Return the model of a plant's input.

        Args:
            plant: the plant.
            memory: r in [0, 1]: one number, or one per input.
            change: deviation of η > 0: one number, or one per input.
            deviation: deviation > 0 of an input without a measurement: one number, or one per
                input.

        Raises:
            ConfigurationError: a number outside these limits.
        """
        n, q = plant.size, plant.inputs
        retention = validation.not_negative("input_memory", memory, (q,))
        if np.any(retention > 1.0):
            raise validation.refusal("input_memory", memory, ">= 0 and <= 1")
        steps = validation.positive("input_change", change, (q,))
        first = validation.positive("input_deviation", deviation, (q,))
        b = plant.input_matrix[..., 0]
        spread = np.concatenate((b, np.eye(q))) * steps
        noise = spread @ spread.T
        noise[:n, :n] += plant.process_covariance[..., 0]
        start = np.zeros((n + q, n + q))
        start[:n, :n] = plant.initial_covariance[..., 0]
        start[n:, n:] = np.diag(first**2)
        return cls(
            state_rows=np.concatenate((plant.transition[..., 0], b * retention), axis=1)[..., None],
            memory=retention[:, None],
            change=noise[..., None],
            plant=plant,
            initial_mean=np.concatenate((plant.initial_mean, np.zeros((q, 1)))),
            initial_covariance=start[..., None],
        )

    @property
    def size(self) -> int:
        """Number of states n."""
        return self.plant.size

    def predict(self, mean: Array) -> Array:
        """Return F ẑ (..., s, N) from (..., s, N)."""
        n = self.size
        parts = linalg.matvec(self.state_rows, mean), self.memory * mean[..., n:, :]
        return namespace(mean).concatenate(parts, axis=-2)

    def predict_covariance(self, covariance: Array) -> Array:
        """Return F P Fᵀ plus the covariance of [ℬ η + w; η], (..., s, s, N)."""
        n = self.size
        states, inputs = slice(n), slice(n, None)
        rows = linalg.matmul(self.state_rows, covariance)
        upper = linalg.matmul(rows, linalg.transpose(self.state_rows))
        cross = rows[..., n:, :] * self.memory
        lower = covariance[..., n:, n:, :] * self.memory
        lower *= self.memory[:, None]
        result = namespace(covariance).empty(covariance.shape)
        result = set_at(result, (..., states, states, _ALL), upper)
        result = set_at(result, (..., states, inputs, _ALL), cross)
        result = set_at(result, (..., inputs, states, _ALL), linalg.transpose(cross))
        result = set_at(result, (..., inputs, inputs, _ALL), lower)
        result += self.change
        upper = linalg.symmetrise(result[..., :n, :n, :])
        return set_at(result, (..., states, states, _ALL), upper)

    def without_input(self, covariance: Array) -> Array:
        """Return Φ = 𝒜 Ξ_x 𝒜ᵀ + 𝒲 (..., n, n, N) from the joint covariance (..., s, s, N)."""
        n, plant = self.size, self.plant
        moved = linalg.congruence(plant.transition, covariance[..., :n, :n, :])
        return moved + plant.process_covariance
