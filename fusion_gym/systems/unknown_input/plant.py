"""A linear plant with an unknown input at its sampling instants, and its linear sensors.

Source: unknown_input (Y. Sun, M. Fu, J. Mao and G. Wei, "Recursive filtering of multi-rate
cyber-physical systems with unknown inputs under adaptive event-triggered mechanisms", 2023).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.plant import true_motion
from fusion_gym.namespace import ndtr
from fusion_gym.systems.linear_plant import LinearDynamics, Sensors, covariance_factor, initial_law
from fusion_gym.systems.unknown_input.signals import InputSignal

_LONGEST_PERIOD = 1000  # small steps between two instants
_RANK = 1e-8  # singular values below this share of what they could be count as zero


@dataclass(frozen=True)
class UnknownInputPlant(LinearDynamics):
    """x(k + 1) = 𝒜 x(k) + ℬ d(k) + w(k), w ~ N(0, 𝒲), from one sampling instant to the next.

    Between two instants the plant makes ``sampling_period`` a small steps x' = A x + B d + ω, ω ~
    N(0, W), with a constant input d. So 𝒜 = Aᵃ, ℬ = Σ Aʲ B and 𝒲 = Σ Aʲ W Aʲᵀ over j = 0..a - 1.
    One draw per instant is exact, because no filter and no sensor uses the small steps.

    In addition to the shapes of the base, with 𝒜 and 𝒲: ``input_matrix`` ℬ (n, q, 1), and
    ``initial_half_width`` (n, 1) of a uniform x(0) about the mean, which filters assume to be
    normal.

    Source: unknown_input, equations (1), (3) and (4), lifted with a constant input.
    """

    input_matrix: Array
    initial_half_width: Array | None = None

    @classmethod
    def create(
        cls,
        transition: ArrayLike,
        input_matrix: ArrayLike,
        process_covariance: ArrayLike,
        sampling_period: int,
        initial_mean: ArrayLike,
        initial_covariance: ArrayLike,
        initial_half_width: ArrayLike | None = None,
    ) -> UnknownInputPlant:
        """Return the plant of the matrices of a small step, without a batch axis.

        Args:
            transition: A (n, n).
            input_matrix: B (n, q), q <= n.
            process_covariance: W (n, n).
            sampling_period: a, from 1 to 1000.
            initial_mean: (n,).
            initial_covariance: (n, n).
            initial_half_width: (n,), or None.

        Raises:
            ConfigurationError: a wrong shape, an entry that is not finite, a number outside these
                limits, or a covariance that is not positive semi-definite.
        """
        small = validation.square("transition", transition)
        n = len(small)
        inputs = validation.array("input_matrix", input_matrix, (n, None))
        process = validation.covariance("process_covariance", process_covariance, n)
        law, half = initial_law(initial_mean, initial_covariance, n), None
        if initial_half_width is not None:
            half = validation.not_negative("initial_half_width", initial_half_width, (n,))[:, None]
        steps = validation.integer(
            "sampling_period", sampling_period, at_least=1, at_most=_LONGEST_PERIOD
        )
        lifted, lifted_inputs, lifted_process = np.eye(n), np.zeros_like(inputs), np.zeros((n, n))
        for _ in range(steps):
            lifted_inputs += lifted @ inputs
            lifted_process += lifted @ process @ lifted.T
            lifted = small @ lifted
        lifted_process = (lifted_process + lifted_process.T) / 2
        return cls(
            transition=lifted[..., None],
            input_matrix=lifted_inputs[..., None],
            process_covariance=lifted_process[..., None],
            process_factor=covariance_factor(lifted_process)[..., None],
            **law,
            initial_half_width=half,
        )

    @property
    def inputs(self) -> int:
        """Number of inputs q."""
        return self.input_matrix.shape[1]

    def start(self, noise: Array) -> Array:
        """Draw x(0) (n, N) from standard normals (n, N)."""
        if self.initial_half_width is None:
            return self.initial_mean + linalg.matvec(self.initial_factor, noise)
        return self.initial_mean + self.initial_half_width * (2.0 * ndtr(noise) - 1.0)

    def advance(
        self, state: Array, inputs: Array, noise: Array, departure: Array | None = None
    ) -> Array:
        """Return x(k + 1) (n, N).

        Args:
            state: x(k) (n, N).
            inputs: d(k) (q, N).
            noise: standard normals (r, N).
            departure: (4, N), or None; with it the plant moves by I + c (𝒜 - I).
        """
        moved = true_motion(departure, state, linalg.matvec(self.transition, state))
        moved += linalg.matvec(self.input_matrix, inputs)
        if self.noise_channels:
            moved += linalg.matvec(self.process_factor, noise)
        return moved

    def open_loop(self, signal: InputSignal, horizon: int) -> Array:
        """Return the mean squared error (n + q,) over k = 1..horizon of predictions with input 0.

        The last q entries are the input's mean square. The closed form uses the signal's first two
        moments.
        """
        return self.second_moments(signal, horizon, np.zeros(self.size)).mean(0)

    def magnitude(self, signal: InputSignal, horizon: int) -> Array:
        """Return the root mean square (n + q,) of state and input over k = 1..horizon."""
        return np.sqrt(self.second_moments(signal, horizon, self.initial_mean[:, 0]).mean(0))

    def second_moments(self, signal: InputSignal, horizon: int, offset: Array) -> Array:
        """Return mean squares (horizon, n + q) of state and input at k = 1..horizon.

        The state's mean starts at ``offset`` (n,). The error's random part has the covariance C' =
        𝒜 C 𝒜ᵀ + 𝒜 X ℬᵀ + (𝒜 X ℬᵀ)ᵀ + ℬ R(0) ℬᵀ + 𝒲 with X the covariance of the error and the
        coming input, X(k + 1) = X(k) + 𝒜ᵏ ℬ R(k + 1).
        """
        a, b = self.transition[..., 0], self.input_matrix[..., 0]
        means, lags = signal.mean(horizon), signal.covariance(horizon + 1)
        if self.initial_half_width is None:
            spread = self.initial_covariance[..., 0].copy()
        else:
            spread = np.diag(self.initial_half_width[:, 0] ** 2 / 3.0)
        mean, cross, reach = offset, np.zeros((self.size, self.inputs)), b
        result = []
        for k in range(horizon):
            crossed = a @ cross @ b.T
            spread = a @ spread @ a.T + crossed + crossed.T + b @ lags[0] @ b.T
            spread = spread + self.process_covariance[..., 0]
            mean = a @ mean + b @ means[k]
            cross = cross + reach @ lags[k + 1]
            reach = a @ reach
            inputs = np.diagonal(lags[0]) + means[k] ** 2
            own = np.maximum(np.diagonal(spread), 0.0)  # it may cancel
            result.append(np.concatenate((own + mean**2, inputs)))
        return np.array(result)


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
    if validation.array_shape(value) == (sensors, size, size):
        names = (f"measurement_covariance[{sensor}]" for sensor in range(sensors))
        pairs = zip(names, np.asarray(value), strict=True)
        return np.array([validation.covariance(*pair, size, definite=True) for pair in pairs])
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
        raise validation.ConfigurationError(
            f"measurement_matrices[{sensor}] = {validation.display(matrix)} is not allowed: the "
            f"sensor must measure every input, but rank(C B) is {rank} for {q} "
            f"input{'s' if q > 1 else ''} (B is the input matrix over one sampling interval)"
        )
    return right.T @ np.diag(1.0 / values) @ left[:, :q].T, left[:, q:]
