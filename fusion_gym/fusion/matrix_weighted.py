"""Matrix-weighted fusion, optimal for estimates whose joint error covariance is known.

Source: markov_jump (event-triggered distributed fusion estimation for asynchronous Markov jump
systems with correlated noises and fading measurements).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.fusion.covariance_intersection import (
    covariance_intersection_many,
)
from fusion_gym.fusion.sequential import SequentialFusion

# Relative. Above the rounding of Σ, so that weights stay below 1e6 and their covariance honest to
# 1e-4 in the worst case (1e-9 in the usual one); below any difference of estimates that matters.
_RIDGE = 1e-12


@dataclass(frozen=True)
class MatrixWeightedFusion:
    """x = Σ A_i x_i with Σ A_i = I and the smallest error variance of all such sums.

    The weights of (56), (eᵀ Σ⁻¹ e)⁻¹ eᵀ Σ⁻¹ with e a column of identities, are those of the best
    linear correction of the first estimate by the differences D_i = x_i - x_1 of the others,
    x = x_1 - Cov(x_1, D) Cov(D)⁻¹ D. In this form the weights add up to I exactly, and Σ itself may
    be singular: it is whenever two estimates are the same. Then Cov(D) is singular too, and a
    relative ridge of 1e-12 on it stands for its pseudo-inverse. The result is that of
    (eᵀ T⁺ e)⁺ eᵀ T⁺ with T = Σ + e eᵀ. The covariance is weights · Σ · weightsᵀ of the given Σ, the
    true one for these weights.

    Source: markov_jump, equations (55)-(57); the printed (57), (eᵀ Σ⁻¹ e)⁻¹, needs a regular Σ.
    """

    def weights(self, joint: Array) -> Array:
        """Weights A (l, n, n, N) for a joint covariance (l, l, n, n, N)."""
        count, n, runs = len(joint), joint.shape[2], joint.shape[-1]
        weights = np.zeros((count, n, n, runs))
        for state in range(n):
            weights[0, state, state] = 1.0
        if count == 1:
            return weights
        toward = joint[1:, 0] - joint[0, 0]  # Cov(D_i, x_1)
        spread = joint[1:, 1:] - joint[0, 1:] - toward[:, None]
        ridge = _RIDGE * (linalg.diagonal(joint[0, 0]) + _own_variances(joint)[1:])
        for i in range(count - 1):
            for state in range(n):
                spread[i, i, state, state] += ridge[i, state]
        size = (count - 1) * n
        solved = linalg.solve(
            spread.swapaxes(1, 2).reshape(size, size, runs), toward.reshape(size, n, runs)
        )
        weights[1:] = -linalg.transpose(solved.reshape(toward.shape))
        weights[0] -= weights[1:].sum(0)
        return weights

    def fuse(self, means: Array, joint: Array) -> tuple[Array, Array]:
        """Fused mean (n, N) and covariance (n, n, N).

        Args:
            means: (l, n, N).
            joint: (l, l, n, n, N), covariance of the estimates' errors, positive semi-definite
                with a positive diagonal.
        """
        count, n, runs = means.shape
        row = self.weights(joint).swapaxes(0, 1).reshape(n, count * n, runs)
        sigma = joint.swapaxes(1, 2).reshape(count * n, count * n, runs)
        return linalg.matvec(row, means.reshape(count * n, runs)), linalg.congruence(row, sigma)


@dataclass(frozen=True)
class IntersectionOfCopies:
    """Covariance intersection of the estimates, as if their correlations were not known.

    ``sequential`` None joins all at once; otherwise the rule joins them two at a time, from the
    first on.
    """

    sequential: SequentialFusion | None = None

    def fuse(self, means: Array, joint: Array) -> tuple[Array, Array]:
        """The same as :meth:`MatrixWeightedFusion.fuse`; only diagonal blocks are read."""
        own = np.stack([joint[i, i] for i in range(len(joint))])
        if self.sequential is None:
            mean, covariance, _ = covariance_intersection_many(means, own)
            return mean, covariance
        everyone = np.ones((len(means) - 1, means.shape[-1]), dtype=np.bool_)
        result = self.sequential.fuse(means[0], own[0], means[1:], own[1:], everyone)
        return result.mean, result.covariance


def _own_variances(joint: Array) -> Array:
    """Variances (l, n, N) of each estimate's errors."""
    return np.stack([linalg.diagonal(joint[i, i]) for i in range(len(joint))])
