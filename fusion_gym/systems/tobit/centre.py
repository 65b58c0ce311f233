"""Nodes and fusion centre: from the centre's prediction and what arrived to the fused estimate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.fusion.rules import FusionRule
from fusion_gym.systems.tobit.filters import (
    Expectation,
    KalmanFilter,
    NodeFilter,
    Outcomes,
    Scalar,
)
from fusion_gym.systems.tobit.sensors import CensoredSensors
from fusion_gym.systems.tobit.tobit_filter import AssumedDensityFilter
from fusion_gym.validation import ConfigurationError


class CentrePrediction(NamedTuple):
    """What centre and nodes expect before anything is sent.

    ``expectation`` of the measurements and ``deviation`` (sensors, m, N) of the innovation. Where
    nodes have covariances of their own, ``root`` G (n, n, N) of the prediction x = x̂ + G z, and
    the nodes' ``outcomes`` z.
    """

    expectation: Expectation
    deviation: Array
    outcomes: Outcomes | None = None
    root: Array | None = None


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

    With shares of 1 every node gets the prediction as it is. Nothing keeps the common prior from
    being counted several times then but the fusion rule, which must be a form of covariance
    intersection. Two nodes with a common prior and independent measurements are just the
    structure for which the inverse form was derived, so "ici" keeps its bound here. With a single
    delivery every form returns the node that got it.

    Source: tobit_token_bucket, equation (51); round_robin_tobit, equation (28).
    """

    share: Array

    @classmethod
    def in_full(cls, sensors: int) -> Feedback:
        """Return the feedback that gives every node the whole prediction."""
        return cls(np.ones((sensors, 1)))

    @classmethod
    def in_shares(cls, share: ArrayLike | None, sensors: int) -> Feedback:
        """Shares w_m > 0 with sum 1; ``None`` stands for equal shares.

        Raises:
            ConfigurationError: a wrong shape, an entry <= 0, or a sum other than 1.
        """
        if share is None:
            return cls(np.full((sensors, 1), 1.0 / sensors))
        weights = validation.array("information_shares", share, (sensors,))
        if np.any(weights <= 0) or abs(weights.sum() - 1.0) > 1e-9:
            raise ConfigurationError(
                f"information_shares = {validation.display(weights)} is not allowed: they must be "
                f"> 0 with sum 1 (their sum is {weights.sum():.6g})"
            )
        return cls(weights[:, None])


@dataclass(frozen=True)
class FeedbackCentre(Centre):
    """A node filter for each sensor, fusion, and the result fed back to the nodes.

    Nodes and fusion work on z of x = x̂ + G z with G Gᵀ the covariance of the prediction, so that
    only regular covariances are inverted.

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
        return type(self.filter) is KalmanFilter and self.sensors.unlimited

    def predict(self, mean: Array, covariance: Array, held: Array, time: Array) -> CentrePrediction:
        """See :class:`Centre`."""
        expectation = self.filter.expect(mean)
        root = linalg.root(self.sensors.regular(covariance))
        observed = linalg.matmul(self.sensors.measurement_matrix, root)
        deviation = _deviation(self.sensors, expectation, (observed * observed).sum(-2))
        inflated = observed / np.sqrt(self.feedback.share)[:, None, None]
        outcomes = self.filter.outcomes(inflated, expectation, held, time)
        return CentrePrediction(expectation, deviation, outcomes, root)

    def update(
        self,
        mean: Array,
        covariance: Array,
        prediction: CentrePrediction,
        measurement: Array,
        granted: NDArray[np.bool_],
    ) -> Posterior:
        """Each node takes the planned outcome of the network's answer; the centre fuses."""
        outcomes, root = _planned(prediction)
        innovation = measurement - prediction.expectation.value
        delivered = linalg.matvec(linalg.transpose(outcomes.correction), innovation)
        local = np.where(granted[:, None], delivered, outcomes.silent_mean)
        grant = granted[:, None, None]
        own = np.where(grant, outcomes.delivered_covariance, outcomes.silent_covariance)
        share = self.feedback.share[:, None]
        local = local / np.sqrt(share)
        fused = self.fusion.fuse(local, own / share[:, None], basis=root)
        return Posterior(
            mean + linalg.matvec(root, fused.mean),
            linalg.gram(linalg.matmul(root, linalg.root(fused.covariance))),
            mean + linalg.matvec(root, local),
        )

    def variances(
        self, mean: Array, covariance: Array, prediction: CentrePrediction, weights: Array
    ) -> tuple[Array, Array]:
        """See :class:`Centre`; by the bound where the filter minimises one."""
        outcomes, root = _planned(prediction)
        share = self.feedback.share[:, None, None]
        covariances = outcomes.silent_covariance / share, outcomes.delivered_covariance / share
        silent, single = (
            linalg.weighted_trace(linalg.congruence(root, fused), weights)
            for fused in self.fusion.fuse_single(*covariances, basis=root)
        )
        return silent, silent - single


@dataclass(frozen=True)
class FederatedCentre(Centre):
    """Nodes with Kalman filters whose informations add up, by the same algebra at the centre.

    Nodes that share the prediction P in shares w_m with the sum 1 have Σ (w_m P⁻¹ + Cᵀ N⁻¹ C)
    together. That is the centre's own update by one delivered scalar after another, which
    inverts no covariance. A silent sensor of weight Z says that its innovation was zero, with the
    noise N + Z⁻¹; a delivery adds what is missing, N⁻¹ - (N + Z⁻¹)⁻¹ = (N + N Z N)⁻¹.

    Source: tobit_token_bucket, equations (20)-(23), (50), (51); round_robin_tobit, equations
    (18)-(28).
    """

    filter: KalmanFilter
    feedback: Feedback

    @property
    def sensors(self) -> CensoredSensors:
        """The sensors."""
        return self.filter.sensors

    @property
    def predictable(self) -> bool:
        """See :class:`Centre`: with Kalman filters, where nothing is censored."""
        return type(self.filter) is KalmanFilter and self.sensors.unlimited

    @property
    def separable(self) -> bool:
        """See :class:`Centre`."""
        return True

    def predict(self, mean: Array, covariance: Array, held: Array, time: Array) -> CentrePrediction:
        """See :class:`Centre`; ``held`` and ``time`` do not matter here."""
        expectation, matrix = self.filter.expect(mean), self.sensors.measurement_matrix
        spread = (matrix * linalg.matmul(matrix, covariance)).sum(-2)
        return CentrePrediction(expectation, _deviation(self.sensors, expectation, spread))

    def update(
        self,
        mean: Array,
        covariance: Array,
        prediction: CentrePrediction,
        measurement: Array,
        granted: NDArray[np.bool_],
    ) -> Posterior:
        """See :class:`Centre`."""
        local = mean + self._correction(covariance, prediction, measurement, granted)
        shift, root = np.zeros_like(mean), self._silent_root(covariance)
        for sensor in np.flatnonzero(granted.any(-1)):
            shift, root = self._deliver(
                sensor, shift, root, prediction.expectation, measurement, granted[sensor]
            )
        known = granted.any(0) | (self.filter.silence is not None)
        return Posterior(mean + shift, np.where(known, linalg.gram(root), covariance), local)

    def single(
        self, mean: Array, covariance: Array, prediction: CentrePrediction, measurement: Array
    ) -> tuple[Array, Array]:
        """See :class:`Centre`."""
        root, everyone = self._silent_root(covariance)[None], np.array([True])
        shift, root = self._deliver(
            slice(None), np.zeros_like(mean), root, prediction.expectation, measurement, everyone
        )
        return mean + shift, linalg.gram(root)

    def variances(
        self, mean: Array, covariance: Array, prediction: CentrePrediction, weights: Array
    ) -> tuple[Array, Array]:
        """See :class:`Centre`."""
        silent = linalg.weighted_trace(linalg.gram(self._silent_root(covariance)), weights)
        single = self.single(mean, covariance, prediction, prediction.expectation.value)[1]
        return silent, silent - linalg.weighted_trace(single, weights)

    def _silent_root(self, covariance: Array) -> Array:
        """Root of the centre's covariance if nobody transmits."""
        weight, sensors = self.filter.silence, self.sensors
        root = linalg.root(covariance)
        if weight is None:
            return root
        rows = np.sqrt(weight)[:, None, None] * sensors.measurement_matrix
        noises = 1.0 + weight[:, None] * sensors.variance
        for sensor, component in np.ndindex(sensors.count, sensors.size):
            place = (sensor, component)
            root = Scalar.of(root, rows[place], noises[place]).posterior(1.0)
        return root

    def _deliver(
        self,
        place: Any,
        shift: Array,
        root: Array,
        expectation: Expectation,
        measurement: Array,
        granted: NDArray[np.bool_],
    ) -> tuple[Array, Array]:
        """Shift (…, n, N) and root of the covariance after what the sensors at ``place`` deliver.

        One sensor, or each of some alone.
        """
        sensors, weight = self.sensors, self.filter.silence
        matrix, q = sensors.measurement_matrix[place], expectation.uncensored_probability[place]
        noises = sensors.variance[place] * expectation.truncated_variance[place]
        innovation = measurement[place] - expectation.value[place]
        if weight is not None:
            larger = 1.0 + weight[place][..., None, :] * noises
            noises, innovation = noises * larger, innovation * larger
        share = np.where(granted, 1.0, 0.0)
        for component in range(sensors.size):
            row = q[..., component, None, :] * matrix[..., component, :, :]
            scalar = Scalar.of(root, row, noises[..., component, :])
            residual = innovation[..., component, :] - linalg.dot(row, shift)
            shift = shift + scalar.cross * (share * residual / scalar.variance)[..., None, :]
            root = scalar.posterior(share)
        return shift, root

    def _correction(
        self,
        covariance: Array,
        prediction: CentrePrediction,
        measurement: Array,
        granted: NDArray[np.bool_],
    ) -> Array:
        """What each node adds to its own mean (sensors, n, N)."""
        expectation = prediction.expectation
        weighted = expectation.uncensored_probability[:, :, None] * self.sensors.measurement_matrix
        cross = linalg.matmul(weighted, covariance)
        noise = self.sensors.variance * expectation.truncated_variance
        total = linalg.matmul(cross, linalg.transpose(weighted))
        total = linalg.add_diagonal(total, self.feedback.share[:, None] * noise)
        solved = linalg.solve_vector(total, measurement - expectation.value)
        return np.where(granted[:, None], linalg.matvec(linalg.transpose(cross), solved), 0.0)


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
        return CentrePrediction(expectation, np.sqrt(expectation.noise_variance + floor))

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


def _deviation(sensors: CensoredSensors, expectation: Expectation, spread: Array) -> Array:
    """Standard deviation of the innovation from the variances ``spread`` of C x, all (l, m, N)."""
    q = expectation.uncensored_probability
    return np.sqrt(q * q * spread + expectation.noise_variance + 1e-3 * sensors.variance)


def _planned(prediction: CentrePrediction) -> tuple[Outcomes, Array]:
    """The nodes' outcomes, and the root of the prediction's covariance."""
    if prediction.outcomes is None or prediction.root is None:
        raise RuntimeError("the prediction has no outcomes: it was made by another centre")
    return prediction.outcomes, prediction.root
