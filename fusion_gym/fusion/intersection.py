"""Covariance intersection and its inverse form, of two estimates and of several in turn.

In coordinates that make both covariances diagonal (:mod:`fusion_gym.fusion.diagonal`) the rules for
two estimates are scalar, and their trace is a convex sum with the minimum :func:`best_weight`.
:mod:`fusion_gym.fusion.several` joins more than two estimates at once.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.fusion.diagonal import DiagonalPair, diagonalise
from fusion_gym.fusion.rules import Active, Fused, SmallestTrace, own_covariances
from fusion_gym.namespace import at_runs, namespace, put_runs, repeat, runs_of
from fusion_gym.validation import refusal

_HALVINGS = 24  # bisections; the trace is then within 2^-25 of its optimum
_FLAT = 1e-12  # relative slope below which the weight makes no difference


@np.errstate(all="ignore")
def best_weight(numerator: Array, start: Array, end: Array) -> Array:
    """Return the ω in [0, 1] (N,) that minimises Σ_j g_j / ((1 - ω) s_j + ω e_j).

    Bisection on the sign of the slope of this convex function; ω is 1/2 where the sum is constant
    to rounding.

    Args:
        numerator: g > 0 (n, N).
        start: s > 0 (n, N).
        end: e > 0 (n, N).
    """
    change = end - start
    factor = numerator * change
    descent_start = linalg.dot(factor, 1.0 / (start * start))
    descent_end = linalg.dot(factor, 1.0 / (end * end))
    xp = namespace(numerator, start)

    def halve(state: tuple[Array, float]) -> tuple[bool, tuple[Array, float]]:
        weight, step = state
        divisor = change * weight
        divisor += start
        divisor *= divisor
        quotient = factor / divisor
        slope = quotient[0]
        for row in quotient[1:]:
            slope += row
        weight += xp.copysign(step, slope)
        return True, (weight, 0.5 * step)

    weight = repeat(halve, (xp.full(numerator.shape[-1], 0.5), 0.25), _HALVINGS)[0]
    weight = xp.where(descent_start <= 0.0, 0.0, weight)
    weight = xp.where(descent_end >= 0.0, 1.0, weight)
    steepest = xp.maximum(xp.abs(descent_start), xp.abs(descent_end))
    flat = steepest <= _FLAT * linalg.dot(numerator, 1.0 / start)
    return xp.where(flat, 0.5, weight)


def _join(
    mean_a: Array, mean_b: Array, pair: DiagonalPair, fused: Array, share: Array, weight: Array
) -> Fused:
    """Return P = V diag(fused) Vᵀ and the mean with L = V diag(share) V⁻¹."""
    xp = namespace(fused)
    scaled = pair.basis * xp.sqrt(fused)[:, None] * pair.uncertain
    second = linalg.matmul(linalg.transpose(pair.basis), pair.inverse * share[:, None])
    return Fused(
        mean_a + linalg.matvec(second, mean_b - mean_a),
        linalg.matmul(linalg.transpose(scaled), scaled),
        lambda: xp.stack((linalg.identity(len(share)) - second, second)),
        xp.stack((weight, 1.0 - weight)),
    )


def covariance_intersection(
    mean_a: Array,
    covariance_a: Array,
    mean_b: Array,
    covariance_b: Array,
    basis: Array | None = None,
) -> Fused:
    """Return the covariance intersection of two estimates with the smallest trace.

    P = (ω P_A⁻¹ + (1 - ω) P_B⁻¹)⁻¹, K = ω P P_A⁻¹ and L = (1 - ω) P P_B⁻¹. P bounds the fused
    error's covariance whatever the correlation of the two errors, provided that P_A and P_B bound
    theirs. Where ω is 0 or 1 one estimate is dropped; for equal covariances ω is 1/2.

    Args:
        mean_a: (n, N).
        covariance_a: P_A (n, n, N), symmetric positive semi-definite. A direction with zero
            variance in one estimate has zero variance in the result. A batch axis of length 1
            broadcasts.
        mean_b: (n, N).
        covariance_b: P_B (n, n, N), as P_A.
        basis: As in :meth:`~fusion_gym.fusion.rules.FusionRule.fuse`.

    Returns:
        The fused estimate with the gains K, L and the weights ω, 1 - ω. Its trace is within a
        relative 1e-6 of the optimum. A run with a NaN is NaN, except for the weights.

    Assumes: P_A and P_B bound their own error covariances; nothing of the correlation of the
    two.

    Source: adaptive_innovation, equations (37), (38) and (42); S. J. Julier and J. K. Uhlmann, "A
    non-divergent estimation algorithm in the presence of unknown correlations", 1997.
    """
    pair, weight, fused, share = _intersect(covariance_a, covariance_b, basis)
    return _join(mean_a, mean_b, pair, fused, share, weight)


def _intersect(
    covariance_a: Array, covariance_b: Array, basis: Array | None
) -> tuple[DiagonalPair, Array, Array, Array]:
    """Return the pair, the best ω, the variances p = a b / (ω b + (1 - ω) a) and b's shares."""
    pair = diagonalise(covariance_a, covariance_b, basis)
    both = pair.first * pair.second
    xp = namespace(both)
    start, end = xp.where(both > 0.0, xp.stack(pair[2:4]), 1.0)
    weight = best_weight(pair.power * both, start, end)
    total = weight * end + (1.0 - weight) * start
    share = xp.where(both > 0.0, (1.0 - weight) * start / total, pair.first)
    return pair, weight, both / total, share


def best_of_pair(
    covariances: Array, selected: NDArray[np.bool_], basis: Array | None
) -> tuple[Array, Array]:
    """Return weights (l, N) and covariance (n, n, N) of the covariance intersection of a pair.

    Args:
        covariances: (l, n, n, N).
        selected: (l, N), two estimates per run.
        basis: As in :meth:`~fusion_gym.fusion.rules.FusionRule.fuse`.
    """
    xp = namespace(covariances, selected)
    first = selected.argmax(0)
    second = len(selected) - 1 - selected[::-1].argmax(0)
    a, b = (
        xp.take_along_axis(covariances, which[None, None, None], 0)[0] for which in (first, second)
    )
    pair, weight, fused, _ = _intersect(a, b, basis)
    scaled = pair.basis * xp.sqrt(fused)[:, None]
    place = np.arange(len(selected))[:, None]
    weights = xp.where(place == first, weight, xp.where(place == second, 1.0 - weight, 0.0))
    return weights, linalg.matmul(linalg.transpose(scaled), scaled)


def information_fusion(
    mean_a: Array,
    covariance_a: Array,
    mean_b: Array,
    covariance_b: Array,
    basis: Array | None = None,
) -> Fused:
    """Fuse two estimates of independent errors: P = (P_A⁻¹ + P_B⁻¹)⁻¹."""
    pair = diagonalise(covariance_a, covariance_b)
    weight = namespace(pair.first).full(pair.first.shape[-1:], 0.5)
    return _join(mean_a, mean_b, pair, pair.first * pair.second, pair.first, weight)


def inverse_covariance_intersection(
    mean_a: Array,
    covariance_a: Array,
    mean_b: Array,
    covariance_b: Array,
    basis: Array | None = None,
) -> Fused:
    """Return the inverse covariance intersection of two estimates with the smallest trace.

    With X = (ω P_A + (1 - ω) P_B)⁻¹: P = (P_A⁻¹ + P_B⁻¹ - X)⁻¹, K = P (P_A⁻¹ - ω X) and L = P
    (P_B⁻¹ - (1 - ω) X). In the diagonal coordinates, with t = ω a² + (1 - ω) b², p = a b + (a b)² /
    t and L = ω a² / t. The trace never exceeds the trace of covariance intersection.

    **P is not a bound for every correlation.** It is a bound if both estimates contain the same
    information and share nothing else: P_A⁻¹ = A⁻¹ + G, P_B⁻¹ = B⁻¹ + G with
    independent errors of covariances A, B and G⁻¹ (A, B may be infinite), so that the errors'
    cross-covariance is P_A G P_B with G at most P_A⁻¹ and P_B⁻¹. Then P minus the actual
    covariance is ω (1 - ω) P X [P_A + P_B - P_A G P_B - P_B G P_A] X P, and since
    (P_A - P_B) G (P_A - P_B) is positive semi-definite the bracket is at least
    (P_A - P_A G P_A) + (P_B - P_B G P_B), which is positive semi-definite too. Common process
    noise is not of this form, and Theorem 5 of the paper, which claims a bound for it, fails.

    Args:
        mean_a: (n, N).
        covariance_a: P_A (n, n, N), symmetric positive semi-definite. A direction with zero
            variance in one estimate has zero variance in the result. A batch axis of length 1
            broadcasts.
        mean_b: (n, N).
        covariance_b: P_B (n, n, N), as P_A.
        basis: As in :meth:`~fusion_gym.fusion.rules.FusionRule.fuse`.

    Returns:
        The fused estimate with the gains K, L and the weights ω, 1 - ω. Its trace is within a
        relative 1e-6 of the optimum. A run with a NaN is NaN, except for the weights.

    Assumes: common information of the structure above; nothing else that both estimates share.

    Source: adaptive_innovation, equations (47) to (54), with a factor P added to the second terms
    of (49) and (50); B. Noack, J. Sijs, M. Reinhardt and U. D. Hanebeck, "Decentralized data
    fusion with inverse covariance intersection", Automatica 79, 2017.
    """
    pair = diagonalise(covariance_a, covariance_b, basis)
    both = pair.first * pair.second
    xp = namespace(both)
    end, start = xp.where(both > 0.0, xp.square(xp.stack(pair[2:4])), 1.0)
    weight = best_weight(pair.power * both * both, start, end)
    total = weight * end + (1.0 - weight) * start
    share = xp.where(both > 0.0, weight * end / total, pair.first)
    return _join(mean_a, mean_b, pair, both + both * both / total, share, weight)


@dataclass(frozen=True)
class SequentialIntersection(SmallestTrace):
    r"""Join the first estimate with each other one in turn, two at a time.

    In each run the first active estimate is the start of the sequence.

    Args:
        join: :func:`covariance_intersection`, a bound for every correlation, or
            :func:`inverse_covariance_intersection`, smaller, a bound for common information only.
        order: Order of arrival, a permutation of the estimates 0 to l - 1; ``None`` stands for
            0, 1, 2, ... The result depends on it.

    Raises:
        ConfigurationError: ``order`` is no permutation of the l estimates.

    Equation:
        With covariance intersection, for each estimate i in the order of arrival (``order``):

        $$
        P\leftarrow\left(\omega P^{-1}+(1-\omega)P_i^{-1}\right)^{-1},\qquad \hat x\leftarrow
        P\left(\omega P_{\mathrm{old}}^{-1}\hat x+(1-\omega)P_i^{-1}x_i\right)
        $$

        With inverse covariance intersection:

        $$
        X=\left(\omega P+(1-\omega)P_i\right)^{-1},\qquad
        P\leftarrow\left(P^{-1}+P_i^{-1}-X\right)^{-1}
        $$

        $$
        \hat x\leftarrow K\hat x+L\,x_i,\qquad K=P_{\mathrm{new}}\left(P^{-1}-\omega
        X\right),\qquad L=P_{\mathrm{new}}\left(P_i^{-1}-(1-\omega)X\right)
        $$

        Each ω minimises the trace, weighted by ``state_weights``; K + L = I.

    Assumes: the assumption of ``join`` at every step.

    Source: adaptive_innovation, equations (37) to (40) and (47) to (52), gains by (56) and (59);
    S. J. Julier and J. K. Uhlmann, "A non-divergent estimation algorithm in the presence of unknown
    correlations", 1997; B. Noack, J. Sijs, M. Reinhardt and U. D. Hanebeck, "Decentralized data
    fusion with inverse covariance intersection", Automatica 79, 2017.
    """

    join: Callable[[Array, Array, Array, Array, Array | None], Fused] = covariance_intersection
    order: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        self._check_order()

    def fuse(
        self, means: Array, covariance: Array, active: Active = None, *, basis: Array | None = None
    ) -> Fused:
        """Return the fused active estimates."""
        own = own_covariances(covariance)
        basis = self.metric(own, basis)
        count = len(means)
        self._check_order(count)
        selected = np.ones((count, own.shape[-1]), dtype=np.bool_) if active is None else active
        xp, known = namespace(means, own), namespace(selected) is np
        mean, fused = xp.full(means.shape[1:], np.nan), xp.full(own.shape[1:], np.nan)
        begun = np.zeros(selected.shape[-1], dtype=np.bool_)
        steps: list[_Step] = []
        for estimate in range(count) if self.order is None else self.order:
            if known and not selected[estimate].any():
                continue
            first, later = selected[estimate] & ~begun, selected[estimate] & begun
            mean = xp.where(first, means[estimate], mean)
            fused = xp.where(first, own[estimate], fused)
            begun = begun | first
            lanes = slice(None) if known and later.all() else runs_of(xp.asarray(later))
            pair = None
            if later.any() if known else steps:
                before = at_runs(mean, lanes), at_runs(fused, lanes)
                new = at_runs(means[estimate], lanes), at_runs(own[estimate], lanes)
                metric = None if basis is None else at_runs(basis, lanes)
                pair = self.join(*before, *new, metric)
                mean = put_runs(mean, lanes, pair.mean)
                fused = put_runs(fused, lanes, pair.covariance)
            steps.append(_Step(estimate, first, lanes, pair))
        return Fused(mean, fused, lambda: _chained(steps, own.shape, xp))

    def _check_order(self, count: int | None = None) -> None:
        value = self.order
        if value is None:
            return
        whole = isinstance(value, tuple) and all(
            isinstance(i, (int, np.integer)) and not isinstance(i, bool) for i in value
        )
        if not whole or not value or sorted(value) != list(range(count or len(value))):
            last = "l - 1" if count is None else f"{count - 1}"
            allowed = f"a tuple that holds each of the estimates 0 to {last} exactly once"
            raise refusal("order", value, allowed)


class _Step(NamedTuple):
    """An ``estimate``, the runs (N,) where it is ``first``, and its ``pair`` in other runs."""

    estimate: int
    first: NDArray[np.bool_]
    lanes: slice | NDArray[Any]
    pair: Fused | None


def _chained(steps: list[_Step], shape: tuple[int, ...], xp: Any) -> Array:
    """Return the gains (l, n, n, N) of all steps, each step's share times all later gains."""
    gains: dict[int, Array] = {}
    for estimate, first, lanes, pair in steps:
        own = linalg.identity(shape[1]) * first
        if pair is not None:
            stored, taken = pair.gains
            for earlier, gain in gains.items():
                gains[earlier] = put_runs(gain, lanes, linalg.matmul(stored, at_runs(gain, lanes)))
            own = put_runs(own, lanes, taken)
        gains[estimate] = own
    nothing = np.zeros(shape[1:])
    every = [gains.get(estimate, nothing) for estimate in range(shape[0])]
    return xp.stack(every)
