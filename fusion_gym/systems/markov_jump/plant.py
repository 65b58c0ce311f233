"""Markov jump linear plant: the matrices follow the mode of a Markov chain.

Source: markov_jump (event-triggered distributed fusion estimation for asynchronous Markov jump
systems with correlated noises and fading measurements).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.nature import true_motion
from fusion_gym.errors import forbidden
from fusion_gym.namespace import ndtr, take
from fusion_gym.systems.linear_plant import covariance_factor, initial_law
from fusion_gym.validation import ConfigurationError

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
    def create(
        cls,
        transitions: ArrayLike,
        process_gains: ArrayLike,
        process_covariance: ArrayLike,
        mode_transition: ArrayLike,
        initial_probabilities: ArrayLike,
        initial_mean: ArrayLike,
        initial_covariance: ArrayLike,
    ) -> MarkovJumpPlant:
        """Return a plant from arrays without a batch axis.

        Args:
            transitions: Φ (modes, n, n).
            process_gains: Γ (modes, n, r).
            process_covariance: Q (r, r), or a number for r = 1.
            mode_transition: p (modes, modes).
            initial_probabilities: (modes,).
            initial_mean: μ₀ (n,).
            initial_covariance: P₀ (n, n).

        Raises:
            ConfigurationError: a wrong shape, an entry that is not finite, probabilities of another
                sum, a covariance that is not positive semi-definite, or a plant that is not
                mean-square stable.
        """
        matrices = validation.array("transitions", transitions, (None, None, None))
        modes, size, _ = matrices.shape
        matrices = validation.array("transitions", transitions, (modes, size, size))
        gains = validation.array("process_gains", process_gains, (modes, size, None))
        noises = gains.shape[2]
        values: ArrayLike = process_covariance
        if isinstance(process_covariance, (int, float, np.number)):
            values = validation.number("process_covariance", process_covariance) * np.eye(noises)
        noise = validation.covariance("process_covariance", values, noises)
        plant = cls(
            transition=np.ascontiguousarray(matrices.transpose(1, 2, 0)),
            process_gain=np.ascontiguousarray(gains.transpose(1, 2, 0)),
            noise_covariance=noise,
            noise_factor=(covariance_factor(noise) if noise.any() else noise)[..., None],
            mode_transition=probabilities("mode_transition", mode_transition, (modes, modes)),
            initial_probabilities=probabilities(
                "initial_probabilities", initial_probabilities, (modes,)
            ),
            **initial_law(initial_mean, initial_covariance, size),
        )
        radius = plant.second_moment_radius()
        if radius >= 1.0 - 1e-9:
            raise ConfigurationError(
                f"transitions = {validation.display(matrices)} are not allowed: with this "
                "mode_transition "
                "the plant must be mean-square stable, and the spectral radius of its "
                f"second-moment operator is {radius:.4g}, which must be < 1"
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
