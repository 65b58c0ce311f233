"""Coordinates in which two covariances are diagonal, batch axis last."""

from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.namespace import in_runs, namespace, repeat, set_at, update_at

_ORTHOGONAL = 1e-13  # cosine below which two rows count as orthogonal
_SWEEPS = 30  # largest number of sweeps; sizes up to 6 need fewer than 10
REGULAR = 1e-4  # least share of a state's variance that other states do not explain
_ALL = slice(None)
_DEPENDENT = 1e-24  # share of a row's squared norm below which it counts as dependent


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
    xp, width, result = namespace(roots), count * size, []
    unit = xp.zeros((size, size, runs)) + linalg.identity(size)
    rows = xp.concatenate((roots.swapaxes(0, 1).reshape(size, width, runs), unit), axis=1)
    whole = linalg.dot(rows[:, :width], rows[:, :width])
    for _ in range(size):
        square = linalg.dot(rows[:, :width], rows[:, :width])
        left = xp.where(whole == 0.0, 0.0, square / whole)
        row = left.argmax(0)[None]
        length = xp.sqrt(xp.take_along_axis(square, row, 0)[0])
        taken = xp.take_along_axis(rows, row[None], 0)[0] / length
        taken = xp.where(xp.take_along_axis(left, row, 0)[0] <= _DEPENDENT, 0.0, taken)
        column = linalg.dot(rows[:, :width], taken[:width])
        rows -= column[:, None] * taken
        result.append(xp.concatenate((taken, column)))
    return xp.stack(result)


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
    xp = namespace(covariance_a, covariance_b)
    pair = xp.stack(xp.broadcast_arrays(covariance_a, covariance_b))
    size, factor = len(covariance_a), linalg.cholesky(pair)
    parts = [slice(k * size, (k + 1) * size) for k in range(3)]
    rows = xp.zeros((size, 3 * size, pair.shape[-1]))  # [G, C⁻¹, Cᵀ], rotated together
    rows = set_at(rows, (..., parts[0], _ALL), factor[1])
    rows = set_at(rows, (..., parts[1], _ALL), linalg.identity(size))
    left = slice(2 * size)
    for k in range(size):
        rows = update_at(np.divide, rows, (..., k, left, _ALL), factor[0, k, k])
        product = factor[0, k + 1 :, k, None] * rows[k, left]
        rows = update_at(np.subtract, rows, (..., slice(k + 1, None), left, _ALL), product)
    rows = _orthogonalise(set_at(rows, (..., parts[2], _ALL), linalg.transpose(factor[0])))
    other, inverse, basis = (rows[:, part] for part in parts)
    ratio = linalg.dot(other, other)
    length = xp.sqrt(1.0 + ratio)[:, None]
    inverse, basis = inverse / length, basis * length
    variances = xp.stack((xp.ones_like(ratio), ratio)) / (1.0 + ratio)
    regular = xp.square(linalg.diagonal(factor)) > REGULAR * linalg.diagonal(pair)
    basis, inverse, variances = in_runs(
        ~regular, _diagonalise_singular, (pair,), (basis, inverse, variances)
    )
    weighed = basis if metric is None else linalg.matmul(basis, linalg.transpose(metric))
    power = linalg.dot(weighed, weighed)
    uncertain: NDArray[np.bool_] = xp.all(linalg.diagonal(pair) > 0.0, 0)
    return DiagonalPair(basis, inverse, variances[0], variances[1], power, uncertain)


def _diagonalise_singular(pair: Array) -> tuple[Array, Array, Array]:
    """Return Vᵀ, V⁺ (n, n, N) and the variances (2, n, N) of nearly singular P_A and P_B."""
    xp, rows = namespace(pair), _orthogonalise(orthonormalise(linalg.root(pair)))
    first, second, inverse, basis = xp.split(rows, 4, 1)
    rows = _orthogonalise(xp.concatenate((second, first, inverse, basis), axis=1))
    other, own, inverse, basis = xp.split(rows, 4, 1)
    return basis, inverse, xp.stack((linalg.dot(own, own), linalg.dot(other, other)))


def _orthogonalise(rows: Array) -> Array:
    """Rotate rows (n, m, N) until their first n entries are orthogonal (one-sided Jacobi method).

    Runs with orthogonal rows remain unchanged, so that a result does not depend on other runs.

    Args:
        rows: (n, m, N); NumPy's are changed in place.
    """
    xp, size = namespace(rows), len(rows)
    pairs = list(combinations(range(size), 2))

    def sweep(state: tuple[Array, ...]) -> tuple[Any, tuple[Array, ...]]:
        rotated: Any = False
        turned = [*state]
        for i, k in pairs:
            again, turned[i], turned[k] = _rotate(turned[i], turned[k], size)
            rotated |= again
        return rotated, tuple(turned)

    turned = repeat(sweep, tuple(rows), _SWEEPS)
    return rows if xp is np else xp.stack(turned)


def _rotate(first: Array, second: Array, size: int) -> tuple[Any, Array, Array]:
    """Make the first n entries of two rows (m, N) orthogonal; return whether any were not."""
    xp, product = namespace(first), linalg.dot(first[:size], second[:size])
    norm_first = linalg.dot(first[:size], first[:size])
    norm_second = linalg.dot(second[:size], second[:size])
    turned = product * product > _ORTHOGONAL**2 * norm_first * norm_second
    rotated = turned.any()
    if xp is np and not rotated:
        return False, first, second
    product *= 2.0
    difference = norm_second - norm_first
    root = xp.sqrt(difference * difference + product * product)
    tangent = xp.where(turned, product / (difference + xp.copysign(root, difference)), 0.0)
    cosine = 1.0 / xp.sqrt(1.0 + tangent * tangent)
    sine = tangent * cosine
    old = first.copy()
    first *= cosine
    first -= sine * second
    second *= cosine
    second += sine * old
    return rotated, first, second
