"""Lattices of the value, in coordinates with diagonal noise and curvature."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.special import ndtr

from fusion_gym.arrays import Array

REACH = 8.5  # deviations of the noise up to a probability of 1e-17


@dataclass(frozen=True)
class Coordinates:
    """Coordinates e = ``basis`` z with unit curvature in every direction and independent noise.

    ``basis`` T (n, n) has Tᵀ S T = I and T⁻¹ Σ T⁻ᵀ = diag(``variance``) (n,); ``inverse`` is T⁻¹.
    """

    basis: Array
    inverse: Array
    variance: Array

    @classmethod
    def create(cls, curvature: Array, noise: Array) -> Coordinates:
        """Return the coordinates of a positive definite S and a positive semi-definite Σ (n, n)."""
        root = np.linalg.cholesky(curvature)
        values, vectors = np.linalg.eigh(root.T @ noise @ root)
        basis = np.linalg.solve(root.T, vectors)
        return cls(basis, vectors.T @ root.T, np.where(values > 1e-13 * values[-1], values, 0.0))


def extents(form: Array) -> Array:
    """Return half widths (..., n) of the boxes around {zᵀ F z <= 1}, F (..., n, n)."""
    return np.asarray(np.sqrt(np.diagonal(np.linalg.inv(form), axis1=-2, axis2=-1)))


def nodes(half: NDArray[np.int64], step: float) -> Array:
    """Return half of the lattice from -half to half (n,).

    The points have the shape (n, half[0] + 1, 2 half[1] + 1, …).

    Args:
        half: points on each side of the middle, by axis (n,).
        step: distance of the points.
    """
    axes = [step * np.arange(-count, count + 1) for count in half]
    axes[0] = axes[0][half[0] :]
    return np.stack(np.meshgrid(*axes, indexing="ij"))


def hat_weights(deviation: float, count: int) -> Array:
    """Return the weights of the points 0, 1, …: E max(1 - |X - k|, 0), X ~ N(0, deviation²).

    They result from linear interpolation between the integers: the mean stays, the variance grows.

    Args:
        deviation: standard deviation of X.
        count: last point.
    """
    if deviation == 0.0:
        return np.eye(1, count + 1)[0]
    place = np.arange(count + 2) / deviation
    density = np.exp(-0.5 * place**2) / np.sqrt(2.0 * np.pi)
    above = deviation * (density - place * ndtr(-place))  # E max(X - k, 0)
    first = 1.0 + 2.0 * (above[1] - above[0])
    return np.concatenate([[first], above[:-2] - 2.0 * above[1:-1] + above[2:]])


def margins(deviations: Array) -> NDArray[np.int64]:
    """Return the points (n,) that the noise adds on each side of a lattice."""
    return np.where(deviations == 0.0, 1, np.ceil(REACH * deviations).astype(np.int64) + 2)


def spread_values(
    values: Array, deviations: Array, reach: NDArray[np.int64]
) -> tuple[Array, float]:
    """Return Σ of the hat weights times ``values`` around the middle, and the added variance.

    Deviations and the added variance, a sum over the axes, are in units of the lattice's step.

    Args:
        values: values (points along each axis), 0 outside.
        deviations: standard deviations of the noise (n,).
        reach: points of the result on each side of the middle, by axis (n,).
    """
    added = 0.0
    for axis, (deviation, margin) in enumerate(zip(deviations, margins(deviations), strict=True)):
        if deviation == 0.0:
            weights = np.array([1.0, 0.0])
        else:
            weights = hat_weights(deviation, margin)
            added += float(2.0 * weights @ np.arange(margin + 1) ** 2) - deviation**2
        count = values.shape[axis]
        middle = (count - 1) // 2
        gap = np.abs(
            np.arange(middle - reach[axis], middle + reach[axis] + 1)[:, None] - np.arange(count)
        )
        matrix = np.where(gap <= margin, weights[np.minimum(gap, margin)], 0.0)
        values = np.moveaxis(np.tensordot(matrix, values, (1, axis)), 0, axis)
    return values, added


def interpolated(values: Array, places: Array) -> tuple[Array, Array]:
    """Return the multilinear interpolation of ``values`` at ``places``, and Σᵢ xᵢ (1 - xᵢ) (M,).

    x is the fractional part of a place. All places are inside the lattice.

    Args:
        values: values (points along each axis).
        places: places (n, M), in steps from the middle of the lattice.
    """
    middle = (np.array(values.shape) - 1) // 2
    part = places - np.floor(places)
    result = map_coordinates(values, places + middle[:, None], order=1, mode="nearest")
    return result, (part * (1.0 - part)).sum(0)
