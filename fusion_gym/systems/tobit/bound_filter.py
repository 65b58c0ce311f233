"""The paper's Tobit Kalman filter: it minimises a bound of its error covariance.

Source: tobit_token_bucket, Theorems 1 and 2. Simulation confirms four corrections, which
docs/tobit_oscillator.md describes: (29) starts from the previous posterior; K_{t+1} in (30) is K_t;
C{Υ∘Ω}Cᵀ is Υ∘(C Ω Cᵀ); without a delivery the filter updates with the held value.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.namespace import namespace
from fusion_gym.systems.tobit.filters import Expectation, Outcomes, linear_update
from fusion_gym.systems.tobit.sensors import CensoredSensors
from fusion_gym.systems.tobit.tobit_filter import expect_censored

# Below this probability of an uncensored value, q counts as this: q enters only in ratios whose
# limits are reached long before, and 1/q must stay finite.
_SMALLEST_PROBABILITY = 1e-290
# The same where a held value is divided by q, and the ratio is squared.
_SMALLEST_DIVISOR = 1e-140
_RIDGE = 1e-14  # relative: just above the rounding of a sum
_LEAST = 1e-290  # a variance below it has no inverse


@dataclass(frozen=True)
class BoundConstants:
    """The constants κ₁..κ₈ of the bound and (1 + ε₁₄, 1 + 1/ε₁₄), from ε₁..ε₁₄ > 0.

    Source: tobit_token_bucket, below equation (30).
    """

    kappa: tuple[float, ...]
    second_moment: tuple[float, float]

    @classmethod
    def create(cls, epsilon: ArrayLike) -> BoundConstants:
        """Return the constants of the 14 scalars.

        Args:
            epsilon: ε₁..ε₁₄, each > 0.

        Raises:
            ConfigurationError: another number of entries, or an entry <= 0.
        """
        e = validation.positive(
            "bound_epsilon", validation.array("bound_epsilon", epsilon, (14,)), (14,)
        )
        kappa = (
            1 + e[0] + e[1] + e[2] + e[3] + e[4],
            1 + 1 / e[0] + 1 / e[6] + 1 / e[9] + 1 / e[11] + 1 / e[12],
            1 + e[5],
            1 + e[6] + e[7] + e[8] + 1 / e[1],
            1 + 1 / e[2] + 1 / e[7] + e[9] + e[10],
            1 + 1 / e[3] + e[11],
            1 + 1 / e[4] + 1 / e[8] + 1 / e[10] + e[12],
            1 + 1 / e[5],
        )
        return cls(tuple(float(k) for k in kappa), (float(1 + e[13]), float(1 + 1 / e[13])))


@dataclass(frozen=True)
class EventError:
    """The bound Ξ of the event error that the paper adds to a delivered measurement.

    Ξ(G) = ``growth`` G + ``offset``, G' = Ξ(G), G₀ = ``initial``; each of shape (sensors, 1), in
    squared units of the measurement. It belongs to the dynamic event trigger: a delivered
    measurement is the current one and has no event error, under any policy.

    Source: tobit_token_bucket, equations (33), (34) and below (30).
    """

    growth: Array
    offset: Array
    initial: Array

    def at(self, time: Array) -> Array:
        """Return Ξ(G_{t-1}) (sensors, N) at the steps t = ``time`` (N,), counted from 1."""
        xp, (rate, logarithm) = namespace(time), self._growth_rate
        ramp = xp.expm1(logarithm * time) / np.where(rate, rate, 1.0)
        ramp = xp.where(rate == 0.0, time, ramp)
        return self.initial * xp.exp(logarithm * time) + self.offset * ramp

    @functools.cached_property
    def _growth_rate(self) -> tuple[Array, Array]:
        """Growth - 1 and the growth's logarithm, exact also where the growth is nearly 1."""
        rate = self.growth - 1.0
        return rate, np.log1p(rate)

    @classmethod
    def create(
        cls,
        threshold: ArrayLike,
        decay: ArrayLike,
        divisor: ArrayLike,
        initial: ArrayLike,
        young: tuple[float, float],
        sensors: int,
    ) -> EventError:
        """Return the bound of a dynamic event trigger.

        Args:
            threshold: σ of each sensor, >= 0.
            decay: λ of each sensor, >= 0.
            divisor: χ of each sensor, > 0.
            initial: η₀ of each sensor, >= 0.
            young: the factors (d, e) of Young's inequality, > 0.
            sensors: number of sensors.

        Raises:
            ConfigurationError: a wrong shape, or a number outside these limits.
        """
        shape = (sensors,)
        sigma = validation.not_negative("trigger_threshold", threshold, shape)
        lam = validation.not_negative("trigger_decay", decay, shape)
        chi = validation.positive("trigger_divisor", divisor, shape)
        eta = validation.not_negative("trigger_initial", initial, shape)
        d, e = validation.positive("bound_young", young, (2,))
        growth = (1 + d) * (1 + e) * lam**2 + (1 + chi) * (1 + 1 / d) / chi**2
        offset = ((1 + d) * (1 + 1 / e) + (1 + 1 / d) * (1 + 1 / chi)) * sigma**2
        return cls(growth[:, None], offset[:, None], (eta**2)[:, None])


@dataclass(frozen=True)
class BoundTobitFilter:
    r"""Tobit Kalman filter whose gain minimises the trace of the paper's bound.

    ``event_error`` (or None) is the κ₆ Ξ term of a delivery; ``hold`` says what happens without
    one: True updates with the held value as the paper does, False predicts.

    Equation:
        $$
        \tilde C=q\,C,\quad a=q\lambda\sqrt R,\quad u=(1-q)\tau,\quad
        \Omega=(1+\epsilon_{14})P+(1+1/\epsilon_{14})\,\hat x\hat x^{\mathsf T}
        $$

        $$
        S_{\mathrm{delivered}}=\kappa_2\,a a^{\mathsf
        T}+\mathrm{diag}\left(qR+q(1-q)\left(\kappa_3\,C\Omega C^{\mathsf
        T}+\kappa_8\tau^2\right)\right)+\kappa_6\,\Xi\,I
        $$

        $$
        S_{\mathrm{held}}=\kappa_2\,a a^{\mathsf T}+\kappa_4\,\tilde C\Omega\tilde C^{\mathsf
        T}+\kappa_5\,\bar y\bar y^{\mathsf T}+\kappa_7\,u u^{\mathsf T}
        $$

        $$
        K=\kappa_1 P\tilde C^{\mathsf T}\left(\kappa_1\tilde C P\tilde C^{\mathsf
        T}+S\right)^{-1},\qquad P^{+}=\kappa_1(I-K\tilde C)P(I-K\tilde C)^{\mathsf T}+K S
        K^{\mathsf T}
        $$

        q, λ and ŷ as in the :class:`~fusion_gym.systems.tobit.tobit_filter.TobitKalmanFilter`, x̂⁺
        = x̂ + K (ȳ − ŷ) with ȳ the value that is held, which is the new one after a delivery. Of C
        Ω Cᵀ in the diagonal only the diagonal counts. κ₁ to κ₈ come of the 14 numbers ε of
        ``bound_epsilon``; Ξ bounds the trigger's event error (``event_error``).

    Assumes: the paper's dynamic event trigger, for Ξ; and that censoring is independent of the
    noise, which it is not, so that the bound is not proven.

    Source: tobit_token_bucket, equations (20)-(37), Theorems 1 and 2.
    """

    sensors: CensoredSensors
    constants: BoundConstants
    event_error: EventError | None
    hold: bool

    def __post_init__(self) -> None:
        matrices = self.sensors.measurement_matrix[..., 0]
        ranks = np.linalg.matrix_rank(matrices)
        if self.hold and np.any(ranks < self.sensors.size):
            raise validation.ConfigurationError(
                f"measurement_matrices with row ranks {ranks.tolist()} are not allowed with "
                f"filter='paper', silent='hold': each must have its {self.sensors.size} rows "
                "independent, because the held update (37) has no noise term"
            )

    def expect(self, mean: Array) -> Expectation:
        """See :class:`fusion_gym.systems.tobit.filters.NodeFilter`."""
        return expect_censored(self.sensors, mean)

    def outcomes(
        self, matrix: Array, expectation: Expectation, held: Array, time: Array
    ) -> Outcomes:
        """See :class:`fusion_gym.systems.tobit.filters.NodeFilter`.

        Source: tobit_token_bucket, equations (30) and (37). At the optimal gain (30) is
        κ₁ P - κ₁ P C̃ᵀ Φ⁻¹ C̃ P κ₁, with Φ = κ₁ C̃ P C̃ᵀ + S and C̃ = q C; here P = I.
        """
        latent = expectation.latent
        spread = linalg.gram(matrix)
        grow, shift = self.constants.second_moment
        moment = grow * spread + shift * linalg.outer(latent, latent)
        correction, delivered = self._delivered(matrix, linalg.diagonal(moment), expectation, time)
        if self.hold:
            silent = self._held(matrix, spread, moment, expectation, held)
        else:
            prior = np.broadcast_to(linalg.identity(matrix.shape[2]), delivered.shape)
            silent = np.zeros(delivered[:, 0].shape), prior
        return Outcomes(correction, delivered, *silent)

    def _delivered(
        self, matrix: Array, moments: Array, expectation: Expectation, time: Array
    ) -> tuple[Array, Array]:
        """Return correction and bound after a delivery, θ = 0."""
        k1, k2, k3, _, _, k6, _, k8 = self.constants.kappa
        variance, threshold = self.sensors.variance, self.sensors.finite_threshold
        xp = namespace(matrix)
        q = xp.maximum(expectation.uncensored_probability, _SMALLEST_PROBABILITY)
        a = q * expectation.hazard * self.sensors.deviation
        noise = q * variance + q * (1.0 - q) * (k3 * moments + k8 * threshold**2)
        if self.event_error is not None:
            noise = noise + k6 * self.event_error.at(time)[:, None]
        weighted = np.sqrt(k1) * q[:, :, None] * matrix
        correction, bound = linear_update(weighted, noise, np.sqrt(k2) * a)
        return np.sqrt(k1) * correction, k1 * bound

    def _held(
        self, matrix: Array, spread: Array, moment: Array, expectation: Expectation, held: Array
    ) -> tuple[Array, Array]:
        """θ = 1: mean and bound after the update with the held value ȳ.

        Every term of Φ but two is scaled by q on both sides, so the update is written in units of
        q: Φ = q (N + F Fᵀ) q with F = [√κ₅ ȳ, √κ₇ (1 - q) τ]/q, whose rows may be huge and of very
        different size. :func:`_pinned_solve` takes them in without loss of digits, and the gain
        itself, which grows as 1/q, is never formed. N is singular where a row of the prediction is
        known; a ridge of its rounding counts as noise, so that the bound stays one.
        """
        k1, k2, _, k4, k5, _, k7, _ = self.constants.kappa
        threshold = self.sensors.finite_threshold
        xp = namespace(matrix)
        q = xp.maximum(expectation.uncensored_probability, _SMALLEST_PROBABILITY)
        bias = expectation.hazard * self.sensors.deviation
        core = k1 * spread + k4 * moment + k2 * linalg.outer(bias, bias)
        ridge = linalg.diagonal(core)
        core = linalg.add_diagonal(core, xp.where(ridge > _LEAST, _RIDGE * ridge, 1.0))
        columns = _pinned_columns(held, threshold, q, np.sqrt(k5), np.sqrt(k7))
        whitened, pull = _pinned_solve(core, matrix, columns)
        across = linalg.transpose(matrix)
        uncensored = expectation.latent + bias
        step = linalg.matvec(across, pull) - linalg.matvec(linalg.transpose(whitened), uncensored)
        reduction = linalg.symmetrise(linalg.matmul(across, whitened))
        return k1 * step, k1 * linalg.identity(matrix.shape[2]) - k1**2 * reduction


def _pinned_columns(
    held: Array, threshold: Array, q: Array, a: float, b: float
) -> list[tuple[Array, Array]]:
    """Columns of F and factors c with F c = (ȳ - u)/q and F Fᵀ = (a² ȳ ȳᵀ + b² u uᵀ)/q².

    ``held`` ȳ and ``q`` are (…, m, N), ``threshold`` τ broadcasts to them, u = (1 - q) τ; a factor
    is (…, 1, N). The columns a ȳ and b u are rotated into each other so that the second is zero
    in the row p where the first is largest. Its other rows are a b/r times
    ȳ_p u - u_p ȳ = (e_p τ - τ_p e) - q ȳ_p τ + q_p τ_p ȳ with e = ȳ - τ, which loses no digits
    where ȳ lies at the threshold and q is tiny.
    """
    xp = namespace(held, q)
    floored = xp.maximum(q, _SMALLEST_DIVISOR)
    if not np.any(threshold):
        return [(a * held / floored, np.full(held[..., :1, :].shape, 1.0 / a))]
    u = (1.0 - q) * threshold
    size = xp.hypot(a * held, b * u)
    row = xp.argmax(size / floored, axis=-2)[..., None, :]

    def at_row(values: Array) -> Array:
        return xp.take_along_axis(xp.broadcast_to(values, size.shape), row, axis=-2)

    radius = at_row(size)
    radius = xp.where(radius > 0.0, radius, 1.0)
    held_p, u_p, q_p, threshold_p = at_row(held), at_row(u), at_row(q), at_row(threshold)
    above = held - threshold
    above_p = at_row(above)
    crossed = (above_p * threshold - threshold_p * above) / floored
    crossed += q_p / q * threshold_p * held - held_p * threshold
    crossed *= a * b / radius
    crossed = xp.where(np.arange(size.shape[-2])[:, None] == row, 0.0, crossed)
    first = (a * a * held_p * held + b * b * u_p * u) / (radius * floored)
    return [
        (first, (above_p + q_p * threshold_p) / radius),
        (crossed, -(a / b * held_p + b / a * u_p) / radius),
    ]


def _pinned_solve(
    core: Array, right: Array, columns: list[tuple[Array, Array]]
) -> tuple[Array, Array]:
    """(N + F Fᵀ)⁻¹ B and (N + F Fᵀ)⁻¹ F c, one column of F after another.

    ``core`` N (…, m, m, N) is positive definite, ``right`` B (…, m, n, N); ``columns`` are those
    of :func:`_pinned_columns`. Each step is the Sherman-Morrison formula: with h = M⁻¹ f,
    (M + f fᵀ)⁻¹ = M⁻¹ - h hᵀ/(1 + fᵀ h), and (M + f fᵀ)⁻¹ f = h/(1 + fᵀ h). It is written with f of
    unit size, for fᵀ h may overflow.
    """
    xp, n = namespace(core, right), right.shape[-2]
    # Powers of two, which no rounding depends on.
    exponents = [xp.frexp(xp.abs(f).max())[1] for f, _ in columns]
    sizes = [xp.ldexp(1.0, xp.maximum(exponent, -400)) for exponent in exponents]
    units = [f / size for (f, _), size in zip(columns, sizes, strict=True)]
    stacked = xp.concatenate([right, *(unit[..., None, :] for unit in units)], axis=-2)
    solved = linalg.solve(core, stacked)
    shift = xp.zeros_like(units[0])
    for place, (unit, size, (_, factor)) in enumerate(zip(units, sizes, columns, strict=True)):
        h = solved[..., n + place, :]
        weight = h / (size**-2.0 + linalg.dot(unit, h))[..., None, :]
        shift = shift + weight * (factor / size - linalg.dot(unit, shift)[..., None, :])
        projected = linalg.matvec(linalg.transpose(solved), unit)
        solved = solved - linalg.outer(weight, projected)
    return solved[..., :n, :], shift
