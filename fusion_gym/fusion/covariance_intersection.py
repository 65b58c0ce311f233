"""Covariance intersection and inverse covariance intersection, batch axis last.

In the coordinates in which both covariances are diagonal (:func:`diagonalise`) the two-sensor
rules are scalar, and their trace is a convex sum whose minimum :func:`best_weight` finds. Several
estimates at once are joined by a Newton method over the weights, each step of which is a
two-sensor problem again.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.fusion.diagonal import DiagonalPair, best_weight, diagonalise
from fusion_gym.validation import Array

_GAP = 1e-6  # relative optimality gap at which the search over several weights ends
_STEPS = 100  # cap of its steps; up to six estimates need about ten
_RIDGE = 1e-10  # keeps its curvature invertible where estimates are alike


class Fused(NamedTuple):
    """Two estimates joined: x = K a + L b with K + L = I.

    ``mean`` (n, N) · ``covariance`` (n, n, N) · ``gain_first`` K (n, n, N) · ``gain_second`` L
    (n, n, N) · ``weight`` ω (N,), in [0, 1]. Means are in the state's units.
    """

    mean: Array
    covariance: Array
    gain_first: Array
    gain_second: Array
    weight: Array


def _join(
    mean_a: Array, mean_b: Array, pair: DiagonalPair, fused: Array, share: Array, weight: Array
) -> Fused:
    """Back from the diagonal coordinates: P = V diag(fused) Vᵀ and L = V diag(share) V⁻¹."""
    scaled = pair.basis * np.sqrt(fused)[:, None]
    second = linalg.matmul(linalg.transpose(pair.basis), pair.inverse * share[:, None])
    return Fused(
        mean_a + linalg.matvec(second, mean_b - mean_a),
        linalg.matmul(linalg.transpose(scaled), scaled),
        linalg.identity(len(share)) - second,
        second,
        weight,
    )


def covariance_intersection(
    mean_a: Array, covariance_a: Array, mean_b: Array, covariance_b: Array
) -> Fused:
    """Covariance intersection of two estimates, of the smallest trace.

    P = (ω P_A⁻¹ + (1 - ω) P_B⁻¹)⁻¹, K = ω P P_A⁻¹ and L = (1 - ω) P P_B⁻¹. P bounds the fused
    error's covariance whatever the correlation of the two errors, provided that P_A and P_B bound
    theirs. Where ω is 0 or 1 one estimate is dropped; for equal covariances ω is 1/2.

    Args:
        mean_a, mean_b: (n, N).
        covariance_a, covariance_b: (n, n, N), symmetric positive definite; only the lower
            triangles are read. A batch axis of length 1 broadcasts.

    Returns:
        The fused estimate. Its trace is within a relative 1e-6 of the optimum. A lane with a
        covariance that is not positive definite is NaN, except for the weight.

    Source: adaptive_innovation, equations (37), (38) and (42); S. J. Julier and J. K. Uhlmann, "A
    non-divergent estimation algorithm in the presence of unknown correlations", 1997.
    """
    pair = diagonalise(covariance_a, covariance_b)
    d = pair.ratio
    weight = best_weight(pair.power * d, np.ones_like(d), d)
    total = weight * d + (1.0 - weight)
    return _join(mean_a, mean_b, pair, d / total, (1.0 - weight) / total, weight)


def inverse_covariance_intersection(
    mean_a: Array, covariance_a: Array, mean_b: Array, covariance_b: Array
) -> Fused:
    """Inverse covariance intersection of two estimates, of the smallest trace.

    With X = (ω P_A + (1 - ω) P_B)⁻¹: P = (P_A⁻¹ + P_B⁻¹ - X)⁻¹, K = P (P_A⁻¹ - ω X) and
    L = P (P_B⁻¹ - (1 - ω) X). In the diagonal coordinates
    p = d (ω + (1 - ω) d) / (ω + (1 - ω) d²) and L = ω / (ω + (1 - ω) d²). Never above the trace
    of covariance intersection.

    **P is not a bound for every correlation.** It is one where both estimates contain the same
    piece of information and nothing else is common: P_A⁻¹ = A⁻¹ + G, P_B⁻¹ = B⁻¹ + G with
    independent errors of covariances A, B and G⁻¹ (A, B may be infinite), so that the errors'
    cross-covariance is P_A G P_B with G at most P_A⁻¹ and P_B⁻¹. Then P minus the actual
    covariance is ω (1 - ω) P X [P_A + P_B - P_A G P_B - P_B G P_A] X P, and since
    (P_A - P_B) G (P_A - P_B) is positive semi-definite the bracket is at least
    (P_A - P_A G P_A) + (P_B - P_B G P_B), which is positive semi-definite too. Common process
    noise is not of this form, and Theorem 5 of the paper, which claims a bound for it, fails.

    Args:
        mean_a, mean_b: (n, N).
        covariance_a, covariance_b: (n, n, N), symmetric positive definite; only the lower
            triangles are read. A batch axis of length 1 broadcasts.

    Returns:
        The fused estimate. Its trace is within a relative 1e-6 of the optimum. A lane with a
        covariance that is not positive definite is NaN, except for the weight.

    Source: adaptive_innovation, equations (47) to (54), with a factor P added to the second terms
    of (49) and (50); B. Noack, J. Sijs, M. Reinhardt and U. D. Hanebeck, "Decentralized data
    fusion with inverse covariance intersection", Automatica 79, 2017.
    """
    pair = diagonalise(covariance_a, covariance_b)
    d = pair.ratio
    square = d * d
    weight = best_weight(pair.power * square / (1.0 + d), square, np.ones_like(d))
    total = weight + (1.0 - weight) * square
    fused = d * (weight + (1.0 - weight) * d) / total
    return _join(mean_a, mean_b, pair, fused, weight / total, weight)


def covariance_intersection_many(
    means: Array, covariances: Array, active: NDArray[np.bool_] | None = None
) -> tuple[Array, Array, Array]:
    """Covariance intersection of l estimates at once, of the smallest trace.

    P = (Σ w_i P_i⁻¹)⁻¹ and x = P Σ w_i P_i⁻¹ x_i with w_i >= 0 and Σ w_i = 1: a bound for every
    correlation of the errors, as with two estimates. With Y_i = P_i⁻¹ the trace of P exceeds its
    minimum by at most the gap max_i tr(P Y_i P) - tr P.

    Args:
        means: (l, n, N).
        covariances: (l, n, n, N), symmetric positive definite where active.
        active: (l, N), the estimates that take part; all by default. Others are not read and get
            the weight 0.

    Returns:
        Mean (n, N), covariance (n, n, N) and weights (l, N). The search ends at a gap of a
        relative 1e-6, or after 100 steps of a lane (each lowers the trace). In a lane without
        active estimates, which is for the caller to avoid, and in one with a covariance that is
        not positive definite, mean and covariance are NaN.

    The multiplicative update w_i <- w_i sqrt(tr(P Y_i P)) has the same optimum, but where
    estimates are alike thousands of its steps do not reach it; ours need about ten.

    Source: the optimum is an A-optimal design, and the gap is J. Kiefer's, "General equivalence
    theory for optimum designs", Annals of Statistics 2, 1974.
    """
    chosen = np.ones(means.shape[::2], dtype=np.bool_) if active is None else active
    information = np.where(chosen[:, None, None], linalg.inverse(covariances), 0.0)
    weights = chosen / np.maximum(chosen.sum(0), 1)
    lanes = np.arange(weights.shape[-1])
    for _ in range(_STEPS):
        fused, gain = _gradient(information[..., lanes], weights[:, lanes])
        total = linalg.trace(fused)
        open_lanes = gain.max(0) - total > _GAP * total
        lanes = lanes[open_lanes]
        if not lanes.size:
            break
        weights[:, lanes] = _step(
            information[..., lanes], weights[:, lanes], fused[..., open_lanes], gain[:, open_lanes]
        )
    fused = linalg.inverse(_weighted(weights, information))
    known = np.where(chosen[:, None], means, 0.0)
    vector = (weights[:, None] * linalg.matvec(information, known)).sum(0)
    return linalg.matvec(fused, vector), fused, weights


def _weighted(weights: Array, information: Array) -> Array:
    """Σ w_i Y_i, (n, n, N)."""
    total: Array = (weights[:, None, None] * information).sum(0)
    return total


def _gradient(information: Array, weights: Array) -> tuple[Array, Array]:
    """P (n, n, N) and tr(P Y_i P) (l, N), by which its trace falls with each weight."""
    fused = linalg.inverse(_weighted(weights, information))
    return fused, linalg.trace(linalg.matmul(information, linalg.matmul(fused, fused)))


def _step(information: Array, weights: Array, fused: Array, gain: Array) -> Array:
    """Weights (l, N) of a smaller trace, from P and the tr(P Y_i P) at the given ones.

    The step goes along Newton's direction among the estimates of positive weight and the one of
    the largest gain, or, if that would make a weight of zero negative, from the smallest gain to
    the largest. The line is searched exactly, as far as the simplex reaches: it joins two sums of
    informations, so it is covariance intersection of two estimates.
    """
    direction = _newton_direction(information, fused, gain, (weights > 0.0) | (gain == gain.max(0)))
    sound = np.isfinite(direction).all(0) & ~((weights == 0.0) & (direction < 0.0)).any(0)
    each = np.arange(len(weights))[:, None]
    smallest = np.where(weights > 0.0, gain, np.inf).argmin(0)
    exchange = (each == gain.argmax(0)) * 1.0 - (each == smallest)
    direction = np.where(sound, direction, exchange)
    reach = np.full_like(direction, np.inf)
    np.divide(weights, -direction, out=reach, where=direction < 0.0)
    length = np.minimum(reach.min(0), 2.0)  # Newton's step has length 1
    end = np.where(reach <= length, 0.0, weights + length * direction)
    pair = diagonalise(fused, linalg.inverse(_weighted(end, information)))
    share = best_weight(pair.power * pair.ratio, np.ones_like(pair.ratio), pair.ratio)
    moved: Array = share * weights + (1.0 - share) * end
    moved /= moved.sum(0)
    return moved


def _newton_direction(
    information: Array, fused: Array, gain: Array, free: NDArray[np.bool_]
) -> Array:
    """Newton's direction (l, N) for the trace, of sum 0 and zero outside ``free`` (l, N).

    The trace's gradient is -``gain`` and its curvature 2 tr(P Y_i P Y_j P).
    """
    root = linalg.transpose(linalg.cholesky(fused))
    legs = linalg.matmul(root, linalg.matmul(information, fused))
    legs = np.where(free[:, None], legs.reshape(len(gain), -1, gain.shape[-1]), 0.0)
    curvature = 2.0 * linalg.matmul(legs, linalg.transpose(legs))
    ridge = np.where(free, _RIDGE * linalg.diagonal(curvature), 1.0)
    right = np.stack((np.where(free, gain, 0.0), free * 1.0), axis=1)
    solved = linalg.solve(linalg.add_diagonal(curvature, ridge), right)
    level = solved[:, 0].sum(0) / solved[:, 1].sum(0)
    direction: Array = solved[:, 0] - level * solved[:, 1]
    return direction
