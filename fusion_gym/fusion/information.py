"""Fusion of independent estimates in information form."""

from __future__ import annotations

from dataclasses import dataclass

from fusion_gym import linalg
from fusion_gym.arrays import Array


@dataclass(frozen=True)
class InformationFusion:
    """Sum of the informations of independent estimates: P = (Σ P_i⁻¹)⁻¹, x = P Σ P_i⁻¹ x_i.

    It has no parameters. The result is optimal for independent errors only. A prior that several
    estimates share is counted as often as they do, and P is then too small: take
    :func:`~fusion_gym.fusion.covariance_intersection.covariance_intersection_many` instead.

    Source: tobit_token_bucket, equation (50).
    """

    def fuse(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Fused mean (n, N) and covariance (n, n, N) of (l, n, N) and (l, n, n, N).

        A lane with a covariance that is not positive definite is NaN.
        """
        information = linalg.inverse(covariance)
        fused = linalg.inverse(information.sum(0))
        return linalg.matvec(fused, linalg.matvec(information, mean).sum(0)), fused
