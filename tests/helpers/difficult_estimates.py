"""Estimates to fuse, of several kinds of difficulty, and what a fusion says of them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.fusion.rules import Fused
from fusion_gym.fusion.several import covariance_intersection_many

Array = NDArray[np.float64]
KINDS = ("alike", "crossed", "dominated", "scaled")


def parts(fused: Fused) -> tuple[Array, Array, Array, Array]:
    """Mean, covariance, weights and gains."""
    assert fused.weights is not None
    return fused.mean, fused.covariance, fused.weights, fused.gains


def many(means: Array, covariances: Array, active: Any = None) -> tuple[Array, Array, Array]:
    """Mean, covariance and weights of covariance intersection of several at once."""
    return parts(covariance_intersection_many(means, covariances, active))[:3]


def estimates(kind: str, count: int, size: int, runs: int, seed: int = 0) -> tuple[Array, Array]:
    """Means (count, n, N) and covariances (count, n, n, N) of one kind of difficulty."""
    generator = np.random.default_rng([seed, count, size])
    factor = generator.normal(size=(count, size, size + 1, runs))
    if kind == "crossed":  # each is good at something else
        factor *= 10.0 ** generator.uniform(-2, 2, size=(count, size, 1, runs))
    covariance = np.einsum("sikN,sjkN->sijN", factor, factor)
    if kind == "dominated":  # the last one is worse in every direction
        covariance[-1] += 5 * np.einsum("sijN->ijN", covariance)
    if kind == "scaled":  # entries from 1e-8 to 1e8
        unit = 10.0 ** np.linspace(-4, 4, size)
        covariance *= (unit[:, None] * unit)[:, :, None]
    return generator.normal(size=(count, size, runs)), covariance
