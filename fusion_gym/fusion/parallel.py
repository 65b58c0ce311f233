"""Parallel fusion: the centre's prediction and all estimates at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.fusion.covariance_intersection import (
    covariance_intersection_many,
)
from fusion_gym.fusion.sequential import SequentialResult


@dataclass(frozen=True)
class ParallelFusion:
    """Covariance intersection of the prediction and all active nodes at once.

    P = (Σ ω_j P_j⁻¹)⁻¹ with Σ ω_j = 1, the weights of the smallest trace. Like its sequential
    form it bounds the actual covariance for every correlation of the estimates' errors.
    """

    def fuse(
        self,
        mean: Array,
        covariance: Array,
        means: Array,
        covariances: Array,
        active: NDArray[np.bool_],
    ) -> SequentialResult:
        """The same as :meth:`fusion_gym.fusion.sequential.SequentialFusion.fuse`."""
        estimates = np.concatenate((mean[None], means))
        every = np.concatenate((covariance[None], covariances))
        gains = np.zeros_like(every)
        gains[0] = linalg.identity(len(mean))
        result = SequentialResult(mean.copy(), covariance.copy(), gains)
        lanes = np.flatnonzero(active.any(0))
        if lanes.size:
            every = every.take(lanes, axis=-1)
            everywhere = np.ones((1, lanes.size), dtype=np.bool_)
            chosen = np.concatenate((everywhere, active.take(lanes, axis=-1)))
            fused_mean, fused, weights = covariance_intersection_many(
                estimates.take(lanes, axis=-1), every, chosen
            )
            result.mean[:, lanes], result.covariance[..., lanes] = fused_mean, fused
            shares = weights[:, None, None] * linalg.inverse(every)
            gains[..., lanes] = linalg.matmul(fused, shares)
        return result
