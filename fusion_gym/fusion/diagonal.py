"""Two covariances in shared diagonal coordinates, and the search for a weight between them."""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from fusion_gym import linalg
from fusion_gym.arrays import Array

_ORTHOGONAL = 1e-13  # cosine below which two rows count as orthogonal
_SWEEPS = 30  # cap of the rotations; sizes up to 6 need fewer than 10 sweeps
_HALVINGS = 24  # of the interval of weights; the trace is then within 2^-25 of its optimum
_FLAT = 1e-12  # relative slope below which the weight makes no difference


class DiagonalPair(NamedTuple):
    """Two covariances P_A = V Vᵀ and P_B = V diag(d) Vᵀ in the coordinates V⁻¹ x.

    ``basis`` Vᵀ (n, n, N) · ``inverse`` V⁻¹ (n, n, N) · ``ratio`` d (n, N), variances of b over
    those of a · ``power`` c (n, N), the squared norms of the columns of V, so that a covariance
    V diag(p) Vᵀ has the trace Σ c_j p_j.
    """

    basis: Array
    inverse: Array
    ratio: Array
    power: Array


def diagonalise(covariance_a: Array, covariance_b: Array) -> DiagonalPair:
    """Both covariances (n, n, N) in the coordinates in which they are diagonal.

    With P_A = C Cᵀ and the eigenvectors U of C⁻¹ P_B C⁻ᵀ, V is C U. Plane rotations make the rows
    of G = C⁻¹ chol(P_B) orthogonal (one-sided Jacobi method): their squared norms are d, each to
    its own relative accuracy. The same rotations turn Cᵀ into Vᵀ and C⁻¹ into V⁻¹. A lane whose
    rows are orthogonal is left untouched, so that its result does not depend on the others.
    """
    size = covariance_a.shape[0]
    factor = linalg.cholesky(np.ascontiguousarray(covariance_a))
    runs = max(covariance_a.shape[-1], covariance_b.shape[-1])
    rows = np.zeros((size, 3 * size, runs))  # [G, C⁻¹, Cᵀ], rotated together
    rows[:, :size] = linalg.cholesky(np.ascontiguousarray(covariance_b))
    rows[:, size : 2 * size] = linalg.identity(size)
    for k in range(size):
        rows[k, : 2 * size] /= factor[k, k]
        rows[k + 1 :, : 2 * size] -= factor[k + 1 :, k, None] * rows[k, : 2 * size]
    rows[:, 2 * size :] = linalg.transpose(factor)
    for _ in range(_SWEEPS):
        rotated = False
        for first, second in combinations(range(size), 2):
            rotated |= _rotate(rows[first], rows[second], size)
        if not rotated:
            break
    whitened, basis = rows[:, :size], rows[:, 2 * size :]
    return DiagonalPair(
        basis,
        rows[:, size : 2 * size],
        linalg.dot(whitened, whitened),
        linalg.dot(basis, basis),
    )


def _rotate(first: Array, second: Array, size: int) -> bool:
    """Make the leading parts of two rows (3 n, N) orthogonal; False where they all were."""
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


def best_weight(numerator: Array, start: Array, end: Array) -> Array:
    """The ω in [0, 1] (N,) at which Σ_j g_j / ((1 - ω) s_j + ω e_j) is smallest.

    ``numerator`` g, ``start`` s and ``end`` e are positive, (n, N). Bisection on the sign of the
    slope of this convex function; ω is 1/2 where the sum is constant to rounding.
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
        np.reciprocal(divisor, out=divisor)
        weight += np.copysign(step, linalg.dot(factor, divisor))
        step *= 0.5
    weight[descent_start <= 0.0] = 0.0
    weight[descent_end >= 0.0] = 1.0
    steepest = np.maximum(np.abs(descent_start), np.abs(descent_end))
    weight[steepest <= _FLAT * linalg.dot(numerator, 1.0 / start)] = 0.5
    return weight
