"""Nodes and fusion centre: from the centre's prediction and what arrived to the fused estimate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.fusion.rules import Fused, FusionRule, InformationFusion
from fusion_gym.systems.tobit.filters import (
    Expectation,
    KalmanFilter,
    NodeFilter,
    Outcomes,
)
from fusion_gym.systems.tobit.sensors import CensoredSensors
from fusion_gym.systems.tobit.tobit_filter import AssumedDensityFilter
from fusion_gym.validation import ConfigurationError


class CentrePrediction(NamedTuple):
    """What centre and nodes expect before anything is sent.

    ``expectation`` of the measurements, ``deviation`` (sensors, m, N) of the innovation, and the
    nodes' ``outcomes`` where there are nodes.
    """

    expectation: Expectation
    deviation: Array
    outcomes: Outcomes | None


class Posterior(NamedTuple):
    """``mean`` (n, N) and ``covariance`` (n, n, N) of the centre, ``local_mean`` (sensors, n, N)
    of the nodes before any feedback (the centre's own where it filters by itself)."""

    mean: Array
    covariance: Array
    local_mean: Array


class Centre(Protocol):
    """Nodes and centre behind one interface."""

    @property
    def sensors(self) -> CensoredSensors:
        """The sensors."""
        ...

    @property
    def predictable(self) -> bool:
        """Whether its covariances follow from the deliveries alone, whatever is measured."""
        return False

    @property
    def separable(self) -> bool:
        """Whether :meth:`single` is there, and costs less than one update after another."""
        return False

    def predict(self, mean: Array, covariance: Array, held: Array, time: Array) -> CentrePrediction:
        """Expectations under the centre's prediction (n, N), (n, n, N)."""
        ...

    def update(
        self,
        mean: Array,
        covariance: Array,
        prediction: CentrePrediction,
        measurement: Array,
        granted: NDArray[np.bool_],
    ) -> Posterior:
        """The posterior after the granted (sensors, N) of the measurements (sensors, m, N)."""
        ...

    def single(
        self, mean: Array, covariance: Array, prediction: CentrePrediction, measurement: Array
    ) -> tuple[Array, Array]:
        """Posterior means (sensors, n, N) and covariances (sensors, n, n, N), one sensor granted.

        Those of as many calls of :meth:`update`.

        Raises:
            RuntimeError: a centre that is not :attr:`separable`.
        """
        raise RuntimeError(f"{type(self).__name__} is not separable")

    def variances(
        self, mean: Array, covariance: Array, prediction: CentrePrediction, weights: Array
    ) -> tuple[Array, Array]:
        """Weighted fused trace (N,) if nobody transmits, its reduction (sensors, N) by each alone.

        ``weights`` (n,) weigh the entries of the trace.
        """
        ...


@dataclass(frozen=True)
class Feedback:
    """How the nodes get the centre's prediction as their prior.

    With shares w_m that add up to 1, ``share`` (sensors, 1), node m gets it with the covariance
    inflated by 1/w_m. That is the paper's feedback (51) and local prediction (29) in one: both
    the fused covariance and the process covariance are inflated, and it is the inflation of both
    that keeps information from being counted twice when the nodes' informations are added up.

    Without shares every node gets the prediction as it is. Nothing keeps the common prior from
    being counted several times then but the fusion rule, which must be a form of covariance
    intersection. Two nodes with a common prior and independent measurements are just the
    structure for which the inverse form was derived, so "ici" keeps its bound here. With a single
    delivery every form returns the node that got it.

    Source: tobit_token_bucket, equation (51); round_robin_tobit, equation (28).
    """

    sensors: int
    share: Array | None = None

    @classmethod
    def in_shares(cls, share: ArrayLike | None, sensors: int) -> Feedback:
        """Shares w_m > 0 with sum 1; ``None`` stands for equal shares.

        Raises:
            ConfigurationError: a wrong shape, an entry <= 0, or a sum other than 1.
        """
        if share is None:
            return cls(sensors, np.full((sensors, 1), 1.0 / sensors))
        weights = validation.array("information_shares", share, (sensors,))
        if np.any(weights <= 0) or abs(weights.sum() - 1.0) > 1e-9:
            raise ConfigurationError(
                f"information_shares = {validation.display(weights)} is not allowed: they must be "
                f"> 0 with sum 1 (their sum is {weights.sum():.6g})"
            )
        return cls(sensors, weights[:, None])

    def distribute(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """The nodes' priors from the centre's prediction.

        From (n, N) and (n, n, N) to (sensors, n, N) and (sensors, n, n, N), read-only views where
        the entries are the same for every node.
        """
        means = np.broadcast_to(mean, (self.sensors, *mean.shape))
        if self.share is None:
            return means, np.broadcast_to(covariance, (self.sensors, *covariance.shape))
        share = self.share[:, None, None]
        if (self.share == self.share[0]).all():
            return means, np.broadcast_to(covariance / share[0], (self.sensors, *covariance.shape))
        return means, covariance / share


@dataclass(frozen=True)
class FeedbackCentre(Centre):
    """A node filter for each sensor, fusion, and the result fed back to the nodes.

    Source: tobit_token_bucket, equations (20)-(23), (29)-(37), (50), (51); round_robin_tobit,
    equations (18)-(28).
    """

    filter: NodeFilter
    fusion: FusionRule
    feedback: Feedback

    @property
    def sensors(self) -> CensoredSensors:
        """The sensors."""
        return self.filter.sensors

    @property
    def predictable(self) -> bool:
        """See :class:`Centre`: with Kalman filters, where nothing is censored."""
        return isinstance(self.filter, KalmanFilter) and self.sensors.unlimited

    @property
    def separable(self) -> bool:
        """See :class:`Centre`: where informations add up."""
        return isinstance(self.fusion, InformationFusion)

    def predict(self, mean: Array, covariance: Array, held: Array, time: Array) -> CentrePrediction:
        """See :class:`Centre`."""
        nodes = self.feedback.distribute(mean, covariance)
        expectation = self.filter.expect(nodes[0])
        matrix = self.sensors.measurement_matrix
        spread = (matrix * linalg.matmul(matrix, covariance)).sum(-2)
        q = expectation.uncensored_probability
        floor = 1e-3 * self.sensors.variance
        deviation = np.sqrt(q * q * spread + expectation.noise_variance + floor)
        return CentrePrediction(
            expectation, deviation, self.filter.outcomes(*nodes, expectation, held, time)
        )

    def update(
        self,
        mean: Array,
        covariance: Array,
        prediction: CentrePrediction,
        measurement: Array,
        granted: NDArray[np.bool_],
    ) -> Posterior:
        """Each node takes the planned outcome of the network's answer; the centre fuses."""
        outcomes = _outcomes(prediction)
        delivered = mean + _correction(outcomes, prediction, measurement)
        local_mean = np.where(granted[:, None], delivered, outcomes.silent_mean)
        fused = self._fused(local_mean, outcomes, granted)
        return Posterior(fused.mean, fused.covariance, local_mean)

    def _fused(self, means: Array, outcomes: Outcomes, granted: NDArray[np.bool_]) -> Fused:
        """The nodes' estimates joined; bitwise the same by informations where that is cheaper."""
        if isinstance(self.fusion, InformationFusion) and outcomes.informed:
            return self.fusion.fuse_information(means, outcomes.information(granted))
        grant = granted[:, None, None]
        local = np.where(grant, outcomes.delivered_covariance, outcomes.silent_covariance)
        return self.fusion.fuse(means, local)

    def single(
        self, mean: Array, covariance: Array, prediction: CentrePrediction, measurement: Array
    ) -> tuple[Array, Array]:
        """See :class:`Centre`: informations of all nodes but one stay what they are in silence."""
        outcomes = _outcomes(prediction)
        assert isinstance(self.fusion, InformationFusion)
        return self.fusion.fuse_each(
            outcomes.silent_mean,
            outcomes.silent_information,
            mean + _correction(outcomes, prediction, measurement),
            outcomes.delivered_information,
        )

    def variances(
        self, mean: Array, covariance: Array, prediction: CentrePrediction, weights: Array
    ) -> tuple[Array, Array]:
        """See :class:`Centre`; by the bound where the filter minimises one."""
        outcomes = _outcomes(prediction)
        fused = self.fusion.fuse_single(outcomes.silent_covariance, outcomes.delivered_covariance)
        silent, single = (linalg.weighted_trace(covariance, weights) for covariance in fused)
        return silent, silent - single


@dataclass(frozen=True)
class SequentialCentre(Centre):
    """The centre itself takes the delivered measurements one after another; there are no nodes."""

    filter: AssumedDensityFilter

    @property
    def sensors(self) -> CensoredSensors:
        """The sensors."""
        return self.filter.sensors

    def predict(self, mean: Array, covariance: Array, held: Array, time: Array) -> CentrePrediction:
        """See :class:`Centre`; ``held`` and ``time`` do not matter here."""
        expectation = self.filter.expect(mean, covariance)
        floor = 1e-3 * self.sensors.variance
        return CentrePrediction(expectation, np.sqrt(expectation.noise_variance + floor), None)

    def update(
        self,
        mean: Array,
        covariance: Array,
        prediction: CentrePrediction,
        measurement: Array,
        granted: NDArray[np.bool_],
    ) -> Posterior:
        """See :class:`Centre`."""
        mean, covariance = self.filter.update(mean, covariance, measurement, granted)
        local = np.broadcast_to(mean, (self.sensors.count, *mean.shape))
        return Posterior(mean, covariance, local)

    def variances(
        self, mean: Array, covariance: Array, prediction: CentrePrediction, weights: Array
    ) -> tuple[Array, Array]:
        """See :class:`Centre`; the reduction is the expected one."""
        silent = linalg.weighted_trace(covariance, weights)
        expected = self.filter.expected_covariance(mean, covariance)
        return silent, silent - linalg.weighted_trace(expected, weights)


def _correction(outcomes: Outcomes, prediction: CentrePrediction, measurement: Array) -> Array:
    """What a delivery would add to each node's mean (sensors, n, N)."""
    innovation = measurement - prediction.expectation.value
    return linalg.matvec(linalg.transpose(outcomes.correction), innovation)


def _outcomes(prediction: CentrePrediction) -> Outcomes:
    if prediction.outcomes is None:
        raise RuntimeError("the prediction has no outcomes: it was made by another centre")
    return prediction.outcomes
