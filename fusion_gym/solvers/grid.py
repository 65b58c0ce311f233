"""The error of one source on a grid, with its transition as a matrix."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_gym.arrays import Array

_MOST_POINTS = 1500


@dataclass(frozen=True)
class ErrorGrid:
    """Absolute errors 0, h, 2h, … and the matrix of E[V(a e + w)] for even functions V.

    The Gaussian density is sampled at the grid's points. By Poisson's summation formula a row then
    has the sum 1 and the mean and variance of the Gaussian, up to 2 exp(-2π² σ²/h²). The remaining
    error is due to the kinks of V, of order h². The last point has the probability beyond it, so
    ``kernel`` is a stochastic matrix.

    Shapes: ``points`` (M,), ``kernel`` (M, M) from the error after a delivery (row) to the next.
    """

    points: Array
    kernel: Array

    @classmethod
    def create(cls, coefficient: float, deviation: float, reach: float, step: float) -> ErrorGrid:
        """Return errors up to ``reach`` in steps of ``step``, from 3 to 1,500 points."""
        count = min(max(int(np.ceil(reach / step)) + 1, 3), _MOST_POINTS)
        points: Array = np.arange(count, dtype=np.float64) * float(step)
        return cls(points, gaussian_rows(coefficient * points, deviation, points))


def gaussian_rows(mean: Array, deviation: float, points: Array) -> Array:
    """Return the weights (R, M) of the points of |X|, X ~ N(mean, deviation²); rows sum to 1."""
    step = points[1]
    scale = step / (deviation * np.sqrt(2.0 * np.pi))
    rows = np.exp(-0.5 * ((points - mean[:, None]) / deviation) ** 2)
    rows[:, 1:] += np.exp(-0.5 * ((points[1:] + mean[:, None]) / deviation) ** 2)
    rows *= scale
    rows[:, -1] += np.maximum(1.0 - rows.sum(1), 0.0)
    return rows / rows.sum(1, keepdims=True)
