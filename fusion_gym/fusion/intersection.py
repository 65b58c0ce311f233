"""Covariance intersection and its inverse form, of two estimates and of several in turn.

In coordinates that make both covariances diagonal (:func:`diagonalise`) the rules for two estimates
are scalar, and their trace is a convex sum with the minimum :func:`best_weight`.
:mod:`fusion_gym.fusion.several` joins more than two estimates at once.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.fusion.rules import Active, Fused, SmallestTrace, own_covariances
from fusion_gym.validation import refusal

_ORTHOGONAL = 1e-13  # cosine below which two rows count as orthogonal
_SWEEPS = 30  # largest number of sweeps; sizes up to 6 need fewer than 10
_HALVINGS = 24  # bisections; the trace is then within 2^-25 of its optimum
REGULAR = 1e-4  # least share of a state's variance that other states do not explain
_DEPENDENT = 1e-24  # share of a row's squared norm below which it counts as dependent
_FLAT = 1e-12  # relative slope below which the weight makes no difference


class DiagonalPair(NamedTuple):
    """Two covariances P_A = V diag(a) Vᵀ and P_B = V diag(b) Vᵀ with a + b = 1.

    Attributes:
        basis: Vᵀ (n, n, N), with rows of zeros where both variances are zero.
        inverse: V⁺ (n, n, N).
        first: a (n, N).
        second: b (n, N).
        power: Squared norms c (n, N) of the columns of V, so that V diag(p) Vᵀ has the trace Σ c_j
            p_j.
        uncertain: (n, N), whether both variances of a state are positive.
    """

    basis: Array
    inverse: Array
    first: Array
    second: Array
    power: Array
    uncertain: NDArray[np.bool_]


@np.errstate(all="ignore")
def orthonormalise(roots: Array) -> Array:
    """Return coordinates in which Σ F_i F_iᵀ is the identity.

    The Gram-Schmidt method takes the row with the largest remaining part next.

    Args:
        roots: F_i (l, n, n, N).

    Returns:
        Rows (n, (l + 2) n, N) of (W_1, …, W_l, T, Vᵀ) with F_i = V W_i and T V = I, zeros from the
        rank on.
    """
    count, size, _, runs = roots.shape
    width, lanes = count * size, np.arange(runs)
    rows = np.empty((size, width + size, runs))
    rows[:, :width] = roots.swapaxes(0, 1).reshape(size, width, runs)
    rows[:, width:] = linalg.identity(size)
    result = np.empty((size, width + 2 * size, runs))
    whole = linalg.dot(rows[:, :width], rows[:, :width])
    for k in range(size):
        square = linalg.dot(rows[:, :width], rows[:, :width])
        left = np.where(whole == 0.0, 0.0, square / whole)
        row = left.argmax(0)
        length = np.sqrt(square[row, lanes])
        taken = np.take_along_axis(rows, row[None, None], 0)[0] / length
        taken = np.where(left[row, lanes] <= _DEPENDENT, 0.0, taken)
        column = linalg.dot(rows[:, :width], taken[:width])
        rows -= column[:, None] * taken
        result[k] = np.concatenate((taken, column))
    return result


@np.errstate(all="ignore")
def diagonalise(
    covariance_a: Array, covariance_b: Array, metric: Array | None = None
) -> DiagonalPair:
    """Return two covariances in common diagonal coordinates.

    With P_A = C Cᵀ, rotations make the rows of G = C⁻¹ chol(P_B) orthogonal: their squared norms
    are b / a, each with a small relative error. The rotations turn Cᵀ into Vᵀ and C⁻¹ into V⁻¹.
    Where P_A or P_B is nearly singular, the rows of :func:`orthonormalise` replace G: first the
    rows of P_A are made orthogonal, then the rows of P_B, because the first do not resolve small b.

    Args:
        covariance_a: P_A (n, n, N), positive semi-definite.
        covariance_b: P_B (n, n, N), positive semi-definite.
        metric: G (n, n, N) of the trace of G P Gᵀ; the identity by default.
    """
    pair = np.stack(np.broadcast_arrays(covariance_a, covariance_b))
    size, factor = len(covariance_a), linalg.cholesky(pair)
    rows = np.zeros((size, 3 * size, pair.shape[-1]))  # [G, C⁻¹, Cᵀ], rotated together
    rows[:, :size] = factor[1]
    rows[:, size : 2 * size] = linalg.identity(size)
    for k in range(size):
        rows[k, : 2 * size] /= factor[0, k, k]
        rows[k + 1 :, : 2 * size] -= factor[0, k + 1 :, k, None] * rows[k, : 2 * size]
    rows[:, 2 * size :] = linalg.transpose(factor[0])
    _orthogonalise(rows)
    ratio = linalg.dot(rows[:, :size], rows[:, :size])
    unit = np.sqrt(1.0 + ratio)[:, None]
    inverse, basis = rows[:, size : 2 * size] / unit, rows[:, 2 * size :] * unit
    variances = np.stack((np.ones_like(ratio), ratio)) / (1.0 + ratio)
    regular = np.square(linalg.diagonal(factor)) > REGULAR * linalg.diagonal(pair)
    lanes = np.flatnonzero(~regular.all((0, 1)))
    if lanes.size:
        rows = orthonormalise(linalg.root(pair.take(lanes, axis=-1)))
        _orthogonalise(rows)
        rows[:, : 2 * size] = np.roll(rows[:, : 2 * size], size, 1)
        _orthogonalise(rows)
        other, own, inverse[..., lanes], basis[..., lanes] = np.split(rows, 4, 1)
        variances[..., lanes] = linalg.dot(own, own), linalg.dot(other, other)
    weighed = basis if metric is None else linalg.matmul(basis, linalg.transpose(metric))
    power = linalg.dot(weighed, weighed)
    uncertain = np.asarray((linalg.diagonal(pair) > 0.0).all(0))
    return DiagonalPair(basis, inverse, variances[0], variances[1], power, uncertain)


def _orthogonalise(rows: Array) -> None:
    """Rotate rows (n, m, N) until their first n entries are orthogonal (one-sided Jacobi method).

    Runs with orthogonal rows remain unchanged, so that a result does not depend on other runs.

    Args:
        rows: (n, m, N), changed in place.
    """
    size = len(rows)
    for _ in range(_SWEEPS):
        rotated = False
        for first, second in combinations(range(size), 2):
            rotated |= _rotate(rows[first], rows[second], size)
        if not rotated:
            break


def _rotate(first: Array, second: Array, size: int) -> bool:
    """Make the first n entries of two rows (m, N) orthogonal; return False if they all were."""
    product = linalg.dot(first[:size], second[:size])
    norm_first = linalg.dot(first[:size], first[:size])
    norm_second = linalg.dot(second[:size], second[:size])
    turned = product * product > _ORTHOGONAL**2 * norm_first * norm_second
    if not turned.any():
        return False
    product *= 2.0
    difference = norm_second - norm_first
    root = np.sqrt(difference * difference + product * product)
    tangent = np.zeros_like(product)
    np.divide(product, difference + np.copysign(root, difference), out=tangent, where=turned)
    cosine = 1.0 / np.sqrt(1.0 + tangent * tangent)
    sine = tangent * cosine
    old = first.copy()
    first *= cosine
    first -= sine * second
    second *= cosine
    second += sine * old
    return True


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
    weight = np.full(numerator.shape[-1], 0.5)
    step = 0.25
    for _ in range(_HALVINGS):
        divisor = change * weight
        divisor += start
        divisor *= divisor
        np.divide(factor, divisor, out=divisor)
        slope = divisor[0]
        for row in divisor[1:]:
            slope += row
        weight += np.copysign(step, slope)
        step *= 0.5
    weight[descent_start <= 0.0] = 0.0
    weight[descent_end >= 0.0] = 1.0
    steepest = np.maximum(np.abs(descent_start), np.abs(descent_end))
    weight[steepest <= _FLAT * linalg.dot(numerator, 1.0 / start)] = 0.5
    return weight


def _join(
    mean_a: Array, mean_b: Array, pair: DiagonalPair, fused: Array, share: Array, weight: Array
) -> Fused:
    """Return P = V diag(fused) Vᵀ and the mean with L = V diag(share) V⁻¹."""
    scaled = pair.basis * np.sqrt(fused)[:, None] * pair.uncertain
    second = linalg.matmul(linalg.transpose(pair.basis), pair.inverse * share[:, None])
    return Fused(
        mean_a + linalg.matvec(second, mean_b - mean_a),
        linalg.matmul(linalg.transpose(scaled), scaled),
        lambda: np.stack((linalg.identity(len(share)) - second, second)),
        np.stack((weight, 1.0 - weight)),
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
    start, end = np.where(both > 0.0, pair[2:4], 1.0)
    weight = best_weight(pair.power * both, start, end)
    total = weight * end + (1.0 - weight) * start
    share = np.where(both > 0.0, (1.0 - weight) * start / total, pair.first)
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
    first = selected.argmax(0)
    second = len(selected) - 1 - selected[::-1].argmax(0)
    a, b = (
        np.take_along_axis(covariances, which[None, None, None], 0)[0] for which in (first, second)
    )
    pair, weight, fused, _ = _intersect(a, b, basis)
    scaled = pair.basis * np.sqrt(fused)[:, None]
    weights = np.zeros(selected.shape)
    inside = np.arange(selected.shape[-1])
    weights[first, inside], weights[second, inside] = weight, 1.0 - weight
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
    weight = np.full(pair.first.shape[-1:], 0.5)
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
    end, start = np.where(both > 0.0, np.square(pair[2:4]), 1.0)
    weight = best_weight(pair.power * both * both, start, end)
    total = weight * end + (1.0 - weight) * start
    share = np.where(both > 0.0, weight * end / total, pair.first)
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
        mean, fused = np.full(means.shape[1:], np.nan), np.full(own.shape[1:], np.nan)
        begun = np.zeros(selected.shape[-1], dtype=np.bool_)
        steps: list[_Step] = []
        for estimate in range(count) if self.order is None else self.order:
            if not selected[estimate].any():
                continue
            first, later = selected[estimate] & ~begun, selected[estimate] & begun
            np.copyto(mean, means[estimate], where=first)
            np.copyto(fused, own[estimate], where=first)
            begun |= first
            lanes = slice(None) if later.all() else np.flatnonzero(later)
            pair = None
            if later.any():
                pair = self.join(
                    _lanes(mean, lanes),
                    _lanes(fused, lanes),
                    _lanes(means[estimate], lanes),
                    _lanes(own[estimate], lanes),
                    None if basis is None else _lanes(basis, lanes),
                )
                mean[:, lanes], fused[..., lanes] = pair.mean, pair.covariance
            steps.append(_Step(estimate, first, lanes, pair))
        return Fused(mean, fused, lambda: _chained(steps, own.shape))

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
    lanes: slice | NDArray[np.intp]
    pair: Fused | None


def _chained(steps: list[_Step], shape: tuple[int, ...]) -> Array:
    """Return the gains (l, n, n, N) of all steps, each step's share times all later gains."""
    gains = np.zeros(shape)
    joined: list[int] = []
    for estimate, first, lanes, pair in steps:
        gains[estimate] = linalg.identity(shape[1]) * first
        if pair is not None:
            stored, taken = pair.gains
            for earlier in joined:
                gain = gains[earlier]
                gain[..., lanes] = linalg.matmul(stored, _lanes(gain, lanes))
            gains[estimate][..., lanes] = taken
        joined.append(estimate)
    return gains


def _lanes(array: Array, lanes: slice | NDArray[np.intp]) -> Array:
    """Return these runs with a contiguous batch axis."""
    return array if isinstance(lanes, slice) else array.take(lanes, axis=-1)
