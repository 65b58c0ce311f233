"""Markov jump linear plant, whose matrices follow a Markov chain, and its fading sensors.

Source: markov_jump (event-triggered distributed fusion estimation for asynchronous Markov jump
systems with correlated noises and fading measurements).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.plant import true_motion
from fusion_gym.errors import forbidden
from fusion_gym.namespace import namespace, ndtr, take
from fusion_gym.systems.linear_plant import covariance_factor, initial_law

Modes = NDArray[np.int64]


def probabilities(field: str, value: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """Return entries from 0 to 1 whose last axis has the exact sum 1.

    Args:
        field: the field's name, for errors.
        value: the entries, with a sum near 1.
        shape: their shape.

    Raises:
        ConfigurationError: a wrong shape, an entry outside [0, 1], or another sum.
    """
    values = validation.array(field, value, shape)
    total = values.sum(-1, keepdims=True)
    if np.any(values < 0.0) or np.any(np.abs(total - 1.0) > 1e-9):
        what = "rows add up" if values.ndim > 1 else "entries add up"
        sums = np.round(total[..., 0], 12).tolist()
        reason = f"it must have entries from 0 to 1 whose {what} to 1, not {sums}"
        raise forbidden(field, values, reason)
    return np.asarray(values / total)


def draw_mode(cumulative: Array, noise: Array) -> Modes:
    """Return the index (...) that a discrete distribution gives a standard normal.

    Args:
        cumulative: cumulative probabilities (values - 1, ...), without the last one.
        noise: standard normals (...).
    """
    return (ndtr(noise) > cumulative).sum(0)


@dataclass(frozen=True)
class MarkovJumpPlant:
    """x(k+1) = Φ_θ x(k) + Γ_θ w(k) with θ = θ(k) a Markov chain, w ~ N(0, Q).

    Shapes, with n states, r noises and M modes: ``transition`` Φ (n, n, M), ``process_gain`` Γ
    (n, r, M), ``noise_covariance`` Q (r, r), ``noise_factor`` Q^½ (r, r', 1), ``mode_transition`` p
    (M, M), p[a, b] the probability of a move from a to b, ``initial_probabilities`` (M,),
    ``initial_mean`` μ₀ (n, 1), ``initial_covariance`` P₀ (n, n, 1), ``initial_factor`` (n, n, 1).

    Source: markov_jump, equations (1) and (3), Assumptions 1 to 3.
    """

    transition: Array
    process_gain: Array
    noise_covariance: Array
    noise_factor: Array
    mode_transition: Array
    initial_probabilities: Array
    initial_mean: Array
    initial_covariance: Array
    initial_factor: Array

    @classmethod
    def create(cls, options: Any) -> MarkovJumpPlant:
        """Return the plant of an environment's options.

        Args:
            options: arrays without a batch axis: ``transitions`` Φ (modes, n, n), ``process_gains``
                Γ (modes, n, r), ``process_covariance`` Q (r, r) or one number, ``mode_transition``
                p (modes, modes), ``initial_probabilities`` (modes,), ``initial_mean`` μ₀ (n,) and
                ``initial_covariance`` P₀ (n, n).

        Raises:
            ConfigurationError: a wrong shape, an entry that is not finite, probabilities of another
                sum, a covariance that is not positive semi-definite, or a plant that is not
                mean-square stable.
        """
        matrices = validation.array("transitions", options.transitions, (None, None, None))
        modes, size, _ = matrices.shape
        matrices = validation.array("transitions", matrices, (modes, size, size))
        gains = validation.array("process_gains", options.process_gains, (modes, size, None))
        noises = gains.shape[2]
        values = options.process_covariance
        if isinstance(values, (int, float, np.number)):
            values = validation.number("process_covariance", values) * np.eye(noises)
        noise = validation.covariance("process_covariance", values, noises)
        chain, first = options.mode_transition, options.initial_probabilities
        plant = cls(
            transition=np.ascontiguousarray(matrices.transpose(1, 2, 0)),
            process_gain=np.ascontiguousarray(gains.transpose(1, 2, 0)),
            noise_covariance=noise,
            noise_factor=(covariance_factor(noise) if noise.any() else noise)[..., None],
            mode_transition=probabilities("mode_transition", chain, (modes, modes)),
            initial_probabilities=probabilities("initial_probabilities", first, (modes,)),
            **initial_law(options.initial_mean, options.initial_covariance, size),
        )
        radius = plant.second_moment_radius()
        if radius >= 1.0 - 1e-9:
            raise validation.ConfigurationError(
                f"transitions = {validation.display(matrices)} are not allowed: with this "
                "mode_transition the plant must be mean-square stable, and the spectral radius of "
                f"its second-moment operator is {radius:.4g}, which must be < 1"
            )
        return plant

    @property
    def size(self) -> int:
        """Number of states n."""
        return self.transition.shape[0]

    @property
    def modes(self) -> int:
        """Number of modes M."""
        return self.transition.shape[2]

    @property
    def noise_channels(self) -> int:
        """Standard normals of one w: the rank of Q."""
        return self.noise_factor.shape[1]

    def second_moment_radius(self) -> float:
        """Return the spectral radius of the operator [p_nm Φ_n ⊗ Φ_n] that moves the P_m of (10).

        The plant is mean-square stable if and only if it is below one.
        """
        squares = [np.kron(phi, phi) for phi in np.moveaxis(self.transition, -1, 0)]
        chain = self.mode_transition
        operator = np.block(
            [[chain[n, m] * squares[n] for n in range(self.modes)] for m in range(self.modes)]
        )
        return float(np.abs(np.linalg.eigvals(operator)).max())

    def true_radius(self, factor: float) -> float:
        """Return the root of the second-moment radius with I + c (Φ - I) in place of each Φ."""
        still = np.eye(self.size)[..., None]
        moved = replace(self, transition=still + factor * (self.transition - still))
        return moved.second_moment_radius() ** 0.5

    @property
    def unmoved(self) -> tuple[str, ...]:
        """Options of the true plant that have no effect."""
        still = bool((self.transition == np.eye(self.size)[..., None]).all())
        quiet = not (self.noise_factor.any() and self.process_gain.any())
        result = {"true_process_noise": quiet, "true_transition": still}
        return tuple(name for name, absent in result.items() if absent)

    def start(self, noise: Array) -> tuple[Array, Modes]:
        """Return x(0) (n, N) and θ(0) (N,) from standard normals (n + 1, N), the mode's last."""
        state = self.initial_mean + linalg.matvec(self.initial_factor, noise[:-1])
        return state, draw_mode(np.cumsum(self.initial_probabilities)[:-1, None], noise[-1])

    def process_noise(self, noise: Array) -> Array:
        """Return w (r, N) from standard normals (noise_channels, N)."""
        return linalg.matvec(self.noise_factor, noise)

    def advance(
        self, state: Array, mode: Modes, process_noise: Array, departure: Array | None = None
    ) -> Array:
        """Return x(k+1) (n, N).

        Args:
            state: x(k) (n, N).
            mode: θ(k) (N,).
            process_noise: w(k) (r, N).
            departure: (4, N), or None; with it the plant moves by I + c (Φ_θ - I).

        Source: markov_jump, equation (3).
        """
        moved = linalg.matvec(take(self.transition, mode), state)
        moved = true_motion(departure, state, moved)
        return moved + linalg.matvec(take(self.process_gain, mode), process_noise)

    def jump(self, mode: Modes, noise: Array) -> Modes:
        """Return θ(k+1) (N,) from θ(k) (N,) and standard normals (N,)."""
        cumulative = np.cumsum(self.mode_transition, 1).T[:-1]
        return draw_mode(take(cumulative, mode), noise)


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
    def create(cls, options: Any, plant: MarkovJumpPlant) -> FadingSensors:
        """Return the sensors of an environment's options.

        Args:
            options: arrays without a batch axis: ``measurement_matrices`` H (sensors, modes, n),
                ``fading_values`` and ``fading_probabilities`` (sensors, values), ``noise_coupling``
                α (sensors,) or (sensors, r); ``sampling_periods`` and ``measurement_variance``, one
                number for all sensors or one for each.
            plant: the plant.

        Raises:
            ConfigurationError: a wrong shape, a period that is no whole number >= 1, a fading value
                outside [0, 1], probabilities of another sum, a variance <= 0, or an entry that is
                not finite.
        """
        shape = None, plant.modes, plant.size
        matrix = validation.array("measurement_matrices", options.measurement_matrices, shape)
        sensors, given = len(matrix), options.sampling_periods
        period = validation.spread("sampling_periods", given, (sensors,))
        if np.any(period < 1.0) or np.any(period != np.round(period)):
            reason = "each must be a whole number >= 1"
            raise forbidden("sampling_periods", given, reason)
        values = validation.array("fading_values", options.fading_values, (sensors, None))
        if np.any(values < 0.0) or np.any(values > 1.0):
            raise forbidden("fading_values", values, "each must be from 0 to 1")
        share, given = options.fading_probabilities, options.measurement_variance
        variance = validation.positive("measurement_variance", given, (sensors,))
        couplings = sensors, len(plant.noise_covariance)
        coupling = validation.by_row(options.noise_coupling, couplings)
        return cls(
            measurement_matrix=np.ascontiguousarray(matrix.transpose(0, 2, 1)),
            period=period.astype(np.int64)[:, None],
            fading_values=values,
            fading_probabilities=probabilities("fading_probabilities", share, values.shape),
            noise_coupling=validation.spread("noise_coupling", coupling, couplings)[..., None],
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
