"""Covariance intersection and inverse covariance intersection, batch axis last.

In the coordinates in which both covariances are diagonal (:func:`diagonalise`) the two-sensor
rules are scalar, and their trace is a convex sum whose minimum :func:`best_weight` finds. More
than two at once: :mod:`fusion_gym.fusion.several`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.fusion.diagonal import DiagonalPair, best_weight, diagonalise
from fusion_gym.fusion.several import covariance_intersection_many

__all__ = [
    "Fused",
    "covariance_intersection",
    "covariance_intersection_many",
    "inverse_covariance_intersection",
]


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
