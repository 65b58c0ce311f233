"""What a centre with feedback asks of a fusion rule, and covariance intersection there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.fusion.covariance_intersection import (
    covariance_intersection_many,
    inverse_covariance_intersection,
)
from fusion_gym.fusion.sequential import SequentialFusion
from fusion_gym.validation import ConfigurationError

INTERSECTION_RULES = ("ci", "ici", "sci", "sici")


class FeedbackFusion(Protocol):
    """Gives every node its prior and joins what the nodes make of it."""

    def distribute(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """The nodes' priors (sensors, n, N), (sensors, n, n, N) from the centre's prediction."""
        ...

    def fuse(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Fused mean (n, N) and covariance (n, n, N) of (sensors, n, N), (sensors, n, n, N)."""
        ...

    def fuse_alone(self, silent: Array, delivered: Array) -> tuple[Array, Array]:
        """Fused covariances if nobody delivers (n, n, N), and if each alone does.

        From the nodes' covariances without and with a delivery, both (sensors, n, n, N); the
        second result is (sensors, n, n, N).
        """
        ...


@dataclass(frozen=True)
class IntersectionFusion:
    """Every node starts from the centre's prediction as it is; the results are intersected.

    Nothing keeps the common prior from being counted several times but the rule, which is why it
    must be a form of covariance intersection: ``"ci"`` of all nodes at once, ``"sci"`` of one node
    after another in ``order`` (node 0 first by default), their inverse forms ``"ici"`` (two nodes)
    and ``"sici"``. Two nodes with a common prior and independent measurements are just the
    structure for which inverse covariance intersection was derived, so ``"ici"`` keeps its
    bound here. With a single delivery every rule returns the node that got it.

    Source: adaptive_innovation, equations (37) to (42) and (47) to (54); the feedback is that of
    tobit_token_bucket, equation (51), without its inflation.
    """

    rule: str
    sensors: int
    order: tuple[int, ...]

    @classmethod
    def create(
        cls, rule: str, sensors: int, order: tuple[int, ...] | None = None
    ) -> IntersectionFusion:
        """Check the rule and the order of arrival, a permutation of the sensors 0 to l - 1.

        Raises:
            ConfigurationError: an unknown rule, "ici" for other than two sensors, or an order
                that is no permutation or that the rule does not have.
        """
        validation.choice("fusion", rule, INTERSECTION_RULES)
        if rule == "ici" and sensors != 2:
            raise ConfigurationError(
                f"fusion = 'ici' is not allowed with {sensors} sensors: it joins two estimates; "
                "it must be 'sici' (two at a time) for more"
            )
        if order is not None and rule not in ("sci", "sici"):
            raise ConfigurationError(
                f"order = {order!r} is not allowed with fusion={rule!r}: it belongs to the "
                "sequential rules 'sci' and 'sici'"
            )
        SequentialFusion("ci", order).check_order(sensors)
        return cls(rule, sensors, tuple(range(sensors)) if order is None else order)

    def distribute(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """The prediction itself for every node, as read-only views."""
        return (
            np.broadcast_to(mean, (self.sensors, *mean.shape)),
            np.broadcast_to(covariance, (self.sensors, *covariance.shape)),
        )

    def fuse(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """See :class:`FeedbackFusion`."""
        if self.rule == "ci":
            fused_mean, fused, _ = covariance_intersection_many(mean, covariance)
            return fused_mean, fused
        if self.rule == "ici":
            joined = inverse_covariance_intersection(mean[0], covariance[0], mean[1], covariance[1])
            return joined.mean, joined.covariance
        first, later = self.order[0], list(self.order[1:])
        every = np.ones((len(later), mean.shape[-1]), dtype=np.bool_)
        sequence = SequentialFusion("ci" if self.rule == "sci" else "ici")
        result = sequence.fuse(
            mean[first], covariance[first], mean[later], covariance[later], every
        )
        return result.mean, result.covariance

    def fuse_alone(self, silent: Array, delivered: Array) -> tuple[Array, Array]:
        """See :class:`FeedbackFusion`."""
        nowhere = np.zeros(silent.shape[:2] + silent.shape[-1:])
        alone = np.empty(silent.shape)
        for sensor in range(self.sensors):
            covariances = silent.copy()
            covariances[sensor] = delivered[sensor]
            alone[sensor] = self.fuse(nowhere, covariances)[1]
        return self.fuse(nowhere, silent)[1], alone
