"""Errors in units of an estimated covariance, whose mean square is at most 1 in every direction."""

import numpy as np

from fusion_gym import linalg
from fusion_gym.arrays import Array


def whitened_square(errors: Array, covariance: Array) -> Array:
    """Return z zᵀ (…, n, n, N) with z = L⁻¹ e of errors (…, n, N) and P = L Lᵀ (…, n, n, N)."""
    z = linalg.whiten(covariance, errors[..., None, :])[..., 0, :]
    return linalg.outer(z, z)


def leading_sample(squares: Array) -> Array:
    """Return the sample (…, E) along the leading eigenvector of the mean of (…, n, n, E)."""
    direction = np.linalg.eigh(squares.mean(-1))[1][..., -1]
    return np.einsum("...i,...ije,...j->...e", direction, squares, direction)
