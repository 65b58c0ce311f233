"""Points at which the value is known, in coordinates in which noise and curvature are diagonal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.special import ndtr

from fusion_gym.arrays import Array

REACH = 8.5  # deviations of the noise beyond which nothing arrives: 1e-17 of it


@dataclass(frozen=True)
class Coordinates:
    """e = ``basis`` z with Sᵀ-weighted length 1 in every direction and independent noise.

    ``basis`` T (n, n) has Tᵀ S T = I and T⁻¹ Σ T⁻ᵀ = diag(``variance``) (n,); ``inverse`` is T⁻¹.
    """

    basis: Array
    inverse: Array
    variance: Array

    @classmethod
    def create(cls, curvature: Array, noise: Array) -> Coordinates:
        """The coordinates of a positive definite S and a positive semi-definite Σ, both (n, n)."""
        root = np.linalg.cholesky(curvature)
        values, vectors = np.linalg.eigh(root.T @ noise @ root)
        basis = np.linalg.solve(root.T, vectors)
        return cls(basis, vectors.T @ root.T, np.where(values > 1e-13 * values[-1], values, 0.0))


def extents(form: Array) -> Array:
    """Half widths (..., n) of the boxes around {zᵀ F z <= 1}, F (..., n, n)."""
    return np.asarray(np.sqrt(np.diagonal(np.linalg.inv(form), axis1=-2, axis2=-1)))


def nodes(half: NDArray[np.int64], step: float) -> Array:
    """Half of the lattice from -half to half (n,): points (n, half[0] + 1, 2 half[1] + 1, …)."""
    axes = [step * np.arange(-count, count + 1) for count in half]
    axes[0] = axes[0][half[0] :]
    return np.stack(np.meshgrid(*axes, indexing="ij"))


def hat_weights(deviation: float, count: int) -> Array:
    """Weights (count + 1,) of the points 0, 1, …: E max(1 - |X - k|, 0), X ~ N(0, deviation²).

    They are what linear interpolation between the whole numbers makes of X: the mean stays, the
    variance grows.
    """
    if deviation == 0.0:
        return np.eye(1, count + 1)[0]
    place = np.arange(count + 2) / deviation
    density = np.exp(-0.5 * place**2) / np.sqrt(2.0 * np.pi)
    above = deviation * (density - place * ndtr(-place))  # E max(X - k, 0)
    first = 1.0 + 2.0 * (above[1] - above[0])
    return np.concatenate([[first], above[:-2] - 2.0 * above[1:-1] + above[2:]])


def spread_values(values: Array, deviations: Array) -> tuple[Array, float]:
    """Σ of the hat weights times ``values``, on a larger lattice, and the variance that they add.

    ``values`` (points along each axis) are 0 outside; ``deviations`` (n,) and the variance, which
    is summed over the axes, in units of the lattice's step.
    """
    added = 0.0
    for axis, deviation in enumerate(deviations.tolist()):
        if deviation == 0.0:
            margin, weights = 1, np.array([1.0, 0.0])
        else:
            margin = int(np.ceil(REACH * deviation)) + 2
            weights = hat_weights(deviation, margin)
            added += float(2.0 * weights @ np.arange(margin + 1) ** 2) - deviation**2
        count = values.shape[axis]
        gap = np.abs(np.arange(-margin, count + margin)[:, None] - np.arange(count))
        matrix = np.where(gap <= margin, weights[np.minimum(gap, margin)], 0.0)
        values = np.moveaxis(np.tensordot(matrix, values, (1, axis)), 0, axis)
    return values, added


def interpolated(values: Array, places: Array) -> tuple[Array, Array]:
    """Multilinear interpolation of ``values`` at ``places`` (n, M), and Σᵢ xᵢ (1 - xᵢ) (M,).

    Both places and x, the parts of a step by which they lie beyond a point, in steps from the
    middle of the lattice; every place is inside.
    """
    middle = (np.array(values.shape) - 1) // 2
    part = places - np.floor(places)
    result = map_coordinates(values, places + middle[:, None], order=1, mode="nearest")
    return result, (part * (1.0 - part)).sum(0)
