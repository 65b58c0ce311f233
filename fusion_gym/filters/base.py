"""What every node filter offers, so that a system can exchange one for another.

Before the network answers, a node already knows everything but whether its request is granted:
the delivered value would be the current measurement, the alternative is the held one. So a filter
plans both outcomes at once; a grant selects one of them. Neither covariance depends on the
current measurement, so a policy may look at both without looking at the measurement.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

from fusion_gym import linalg
from fusion_gym.sensors import CensoredSensors
from fusion_gym.validation import Array


class Expectation(NamedTuple):
    """What a node expects of its next measurement; every array has shape (sensors, m, N).

    ``latent``: C x̂, the expectation without censoring. ``value``: the expectation of the censored
    measurement. ``noise_variance``: variance of the censored measurement given the predicted
    state. ``uncensored_probability`` q, ``hazard`` λ and ``truncated_variance`` v of the
    standardised threshold (of 1, 0 and 1 where a filter ignores censoring).
    """

    latent: Array
    value: Array
    noise_variance: Array
    uncensored_probability: Array
    hazard: Array
    truncated_variance: Array


class Plan(NamedTuple):
    """Both outcomes at every node.

    ``correction`` (sensors, m, n, N): the transposed gain of a delivery, so that the delivered
    mean is prior + correctionᵀ innovation; ``delivered_covariance`` (sensors, n, n, N);
    ``silent_mean`` (sensors, n, N) and ``silent_covariance`` (sensors, n, n, N).
    """

    correction: Array
    delivered_covariance: Array
    silent_mean: Array
    silent_covariance: Array


class NodeFilter(Protocol):
    """A local filter for sensors of one kind, all nodes at once."""

    @property
    def sensors(self) -> CensoredSensors:
        """The sensors whose measurements the nodes filter."""
        ...

    def expect(self, mean: Array) -> Expectation:
        """Expectation of the measurements from the prior means (sensors, n, N)."""
        ...

    def plan(
        self, mean: Array, covariance: Array, expectation: Expectation, held: Array, time: Array
    ) -> Plan:
        """Both outcomes from the priors (sensors, n, N), (sensors, n, n, N).

        ``held`` (sensors, m, N) is the last delivered measurement, ``time`` (N,) the number of
        the step in its episode, counted from 1.
        """
        ...


def linear_update(
    covariance: Array, matrix: Array, innovation_covariance: Array
) -> tuple[Array, Array]:
    """Correction S⁻¹ C P (…, m, n, N) and posterior covariance P - P Cᵀ S⁻¹ C P (…, n, n, N).

    The minimum-variance update for ``matrix`` C (…, m, n, N) and innovation covariance S
    (…, m, m, N), S ⪰ C P Cᵀ.
    """
    cross = linalg.matmul(matrix, covariance)
    correction = linalg.solve(innovation_covariance, cross)
    reduction = linalg.matmul(linalg.transpose(cross), correction)
    return correction, linalg.symmetrise(covariance - reduction)
