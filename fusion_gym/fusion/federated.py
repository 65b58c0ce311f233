"""Federated fusion with information sharing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.fusion.information import InformationFusion
from fusion_gym.validation import ConfigurationError


@dataclass(frozen=True)
class FederatedFusion:
    """Information-weighted sum of the nodes' estimates, fed back in shares w_m that add up to 1.

    Shape: ``share`` (sensors, 1). The centre predicts, and node m gets the centre's prediction
    with the covariance inflated by 1/w_m. That is the paper's feedback (51) and local prediction
    (29) in one: both the fused covariance and the process covariance are inflated, and it is the
    inflation of both that keeps information from being counted twice.

    Source: tobit_token_bucket, equations (50) and (51).
    """

    share: Array

    @classmethod
    def create(cls, share: ArrayLike | None, sensors: int) -> FederatedFusion:
        """Shares w_m > 0 with sum 1; ``None`` stands for equal shares.

        Raises:
            ConfigurationError: a wrong shape, an entry <= 0, or a sum other than 1.
        """
        if share is None:
            return cls(np.full((sensors, 1), 1.0 / sensors))
        weights = validation.array("information_shares", share, (sensors,))
        if np.any(weights <= 0) or abs(weights.sum() - 1.0) > 1e-9:
            raise ConfigurationError(
                f"information_shares = {weights.tolist()} is not allowed: they must be > 0 "
                f"with sum 1 (their sum is {weights.sum():.6g})"
            )
        return cls(weights[:, None])

    def distribute(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """The nodes' priors from the centre's prediction.

        From (n, N) and (n, n, N) to (sensors, n, N) (a read-only view) and (sensors, n, n, N).
        """
        nodes = np.broadcast_to(mean, (len(self.share), *mean.shape))
        return nodes, covariance / self.share[:, None, None]

    def fuse(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Fused mean (n, N) and covariance (n, n, N) of (sensors, n, N) and (sensors, n, n, N).

        Source: tobit_token_bucket, equation (50).
        """
        return InformationFusion().fuse(mean, covariance)

    def fuse_alone(self, silent: Array, delivered: Array) -> tuple[Array, Array]:
        """See :class:`fusion_gym.fusion.feedback.FeedbackFusion`: informations are sums."""
        information = linalg.inverse(silent)
        total = information.sum(0)
        gained = linalg.inverse(delivered) - information
        return linalg.inverse(total), linalg.inverse(linalg.symmetrise(total + gained))
