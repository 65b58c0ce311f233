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
    joint_update,
)
from fusion_gym.systems.tobit.sensors import CensoredSensors
from fusion_gym.systems.tobit.tobit_filter import AssumedDensityFilter
from fusion_gym.validation import ConfigurationError


class CentrePrediction(NamedTuple):
    """What centre and nodes expect before anything is sent.

    ``expectation`` of the measurements, ``deviation`` (sensors, m, N) of the innovation, ``root`` G
    (n, n, N) of the covariance if nobody transmits, and where nodes have covariances of their own,
    their ``outcomes`` z of x = x̂ + G z.
    """

    expectation: Expectation
    deviation: Array
    root: Array
    outcomes: Outcomes | None = None


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
    ) -> tuple[Array, Array]:
        """Posterior mean (n, N) and covariance (n, n, N).

        It takes the ``granted`` (sensors, N) of the measurements (sensors, m, N).
        """
        ...

    def local_means(
        self,
        mean: Array,
        covariance: Array,
        prediction: CentrePrediction,
        measurement: Array,
        granted: NDArray[np.bool_],
    ) -> Array:
        """Means (sensors, n, N) of the nodes before any feedback, of a centre alone its own."""
        own = self.update(mean, covariance, prediction, measurement, granted)[0]
        return np.broadcast_to(own, (len(granted), *own.shape))

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
class NodeCentre(Centre):
    """A centre with a node filter for each sensor, which gets the result back."""

    filter: NodeFilter
    feedback: Feedback

    @property
    def sensors(self) -> CensoredSensors:
        """The sensors."""
        return self.filter.sensors

    @property
    def predictable(self) -> bool:
        """See :class:`Centre`: with Kalman filters, where nothing is censored."""
        return type(self.filter) is KalmanFilter and self.sensors.unlimited


@dataclass(frozen=True)
class FeedbackCentre(NodeCentre):
    """A node filter for each sensor, fusion, and the result fed back to the nodes.

    Nodes and fusion work on z of x = x̂ + G z with G Gᵀ the covariance of the prediction, so that
    only regular covariances are inverted.

    Source: tobit_token_bucket, equations (20)-(23), (29)-(37), (50), (51); round_robin_tobit,
    equations (18)-(28).
    """

    fusion: FusionRule

    def predict(self, mean: Array, covariance: Array, held: Array, time: Array) -> CentrePrediction:
        """See :class:`Centre`."""
        expectation = self.filter.expect(mean)
        root = linalg.root(self.sensors.regular(covariance))
        observed = linalg.matmul(self.sensors.measurement_matrix, root)
        deviation = _deviation(self.sensors, expectation, (observed * observed).sum(-2))
        inflated = observed / np.sqrt(self.feedback.share)[:, None, None]
        outcomes = self.filter.outcomes(inflated, expectation, held, time)
        return CentrePrediction(expectation, deviation, root, outcomes)

    def update(
        self,
        mean: Array,
        covariance: Array,
        prediction: CentrePrediction,
        measurement: Array,
        granted: NDArray[np.bool_],
    ) -> tuple[Array, Array]:
        """Each node takes the planned outcome of the network's answer; the centre fuses."""
        outcomes, root, share = _outcomes(prediction), prediction.root, self.feedback.share[:, None]
        grant = granted[:, None, None]
        own = np.where(grant, outcomes.delivered_covariance, outcomes.silent_covariance)
        local = self._shift(prediction, measurement, granted)
        fused = self.fusion.fuse(local, own / share[:, None], basis=root)
        return mean + linalg.matvec(root, fused.mean), linalg.congruence(root, fused.covariance)

    def local_means(
        self,
        mean: Array,
        covariance: Array,
        prediction: CentrePrediction,
        measurement: Array,
        granted: NDArray[np.bool_],
    ) -> Array:
        """See :class:`Centre`."""
        local = self._shift(prediction, measurement, granted)
        return mean + linalg.matvec(prediction.root, local)

    def _shift(
        self, prediction: CentrePrediction, measurement: Array, granted: NDArray[np.bool_]
    ) -> Array:
        """The nodes' means (sensors, n, N) of z."""
        outcomes = _outcomes(prediction)
        innovation = measurement - prediction.expectation.value
        delivered = linalg.matvec(linalg.transpose(outcomes.correction), innovation)
        local = np.where(granted[:, None], delivered, outcomes.silent_mean)
        return local / np.sqrt(self.feedback.share[:, None])

    def variances(
        self, mean: Array, covariance: Array, prediction: CentrePrediction, weights: Array
    ) -> tuple[Array, Array]:
        """See :class:`Centre`; by the bound where the filter minimises one."""
        outcomes, root = _outcomes(prediction), prediction.root
        share = self.feedback.share[:, None, None]
        covariances = outcomes.silent_covariance / share, outcomes.delivered_covariance / share
        silent, single = (
            linalg.weighted_trace(linalg.congruence(root, fused), weights)
            for fused in self.fusion.fuse_single(*covariances, basis=root)
        )
        return silent, silent - single


@dataclass(frozen=True)
class FederatedCentre(NodeCentre):
    """Nodes with Kalman filters whose informations add up, by the same algebra at the centre.

    Nodes that share the prediction P in shares w_m with the sum 1 have Σ (w_m P⁻¹ + Cᵀ N⁻¹ C)
    together. That is the centre's own update by one delivered scalar after another, which
    inverts no covariance. A silent sensor of weight Z says that its innovation was zero, with the
    noise N + Z⁻¹; a delivery adds what is missing, N⁻¹ - (N + Z⁻¹)⁻¹ = (N + N Z N)⁻¹.

    Source: tobit_token_bucket, equations (20)-(23), (50), (51); round_robin_tobit, equations
    (18)-(28).
    """

    filter: KalmanFilter

    @property
    def separable(self) -> bool:
        """See :class:`Centre`."""
        return True

    def predict(self, mean: Array, covariance: Array, held: Array, time: Array) -> CentrePrediction:
        """See :class:`Centre`; ``held`` and ``time`` do not matter here."""
        sensors, weight = self.sensors, self.filter.silence
        expectation, root = self.filter.expect(mean), linalg.root(covariance)
        observed = linalg.matmul(sensors.measurement_matrix, root)
        deviation = _deviation(sensors, expectation, (observed * observed).sum(-2))
        if weight is not None:
            # Both sides times √Z, so that weight 0 is no exception.
            scale = np.sqrt(weight / (1.0 + weight * sensors.variance[..., 0]))[..., None, None]
            nothing = np.zeros_like(expectation.value)
            _, silent = joint_update(_stack(scale * observed), _stack(nothing))
            root = linalg.matmul(root, linalg.root(silent))
        return CentrePrediction(expectation, deviation, root)

    def update(
        self,
        mean: Array,
        covariance: Array,
        prediction: CentrePrediction,
        measurement: Array,
        granted: NDArray[np.bool_],
    ) -> tuple[Array, Array]:
        """See :class:`Centre`."""
        places = np.flatnonzero(granted.any(-1))
        silent = covariance if self.filter.silence is None else linalg.gram(prediction.root)
        if not places.size:
            return mean, silent
        matrix, value = self._whitened(prediction, measurement, places)
        matrix = np.where(granted[places, None, None], matrix, 0.0)
        mean, posterior = _shifted(mean, prediction, _stack(matrix), _stack(value))
        return mean, np.where(granted.any(0), posterior, silent)

    def local_means(
        self,
        mean: Array,
        covariance: Array,
        prediction: CentrePrediction,
        measurement: Array,
        granted: NDArray[np.bool_],
    ) -> Array:
        """See :class:`Centre`."""
        sensors, expectation = self.sensors, prediction.expectation
        weighted = expectation.uncensored_probability[:, :, None] * sensors.measurement_matrix
        cross = linalg.matmul(weighted, covariance)
        total = linalg.matmul(cross, linalg.transpose(weighted))
        noise = sensors.variance * expectation.truncated_variance
        total = linalg.add_diagonal(total, self.feedback.share[:, None] * noise)
        innovation = np.where(granted[:, None], measurement - expectation.value, 0.0)
        shift = linalg.matvec(linalg.transpose(cross), linalg.solve_vector(total, innovation))
        return mean + shift

    def single(
        self, mean: Array, covariance: Array, prediction: CentrePrediction, measurement: Array
    ) -> tuple[Array, Array]:
        """See :class:`Centre`."""
        return _shifted(mean, prediction, *self._whitened(prediction, measurement, slice(None)))

    def variances(
        self, mean: Array, covariance: Array, prediction: CentrePrediction, weights: Array
    ) -> tuple[Array, Array]:
        """See :class:`Centre`."""
        silent = linalg.weighted_trace(linalg.gram(prediction.root), weights)
        single = self.single(mean, covariance, prediction, prediction.expectation.value)[1]
        return silent, silent - linalg.weighted_trace(single, weights)

    def _whitened(
        self, prediction: CentrePrediction, measurement: Array, places: Any
    ) -> tuple[Array, Array]:
        """What sensors would deliver, of unit noise: N^-½ q C G (…, m, n, N) and N^-½ (y - ŷ)."""
        sensors, expectation, weight = self.sensors, prediction.expectation, self.filter.silence
        noise = sensors.variance[places] * expectation.truncated_variance[places]
        innovation = measurement[places] - expectation.value[places]
        if weight is not None:
            larger = 1.0 + weight[places, None] * noise
            noise, innovation = noise * larger, innovation * larger
        scale = 1.0 / np.sqrt(noise)
        matrix = linalg.matmul(sensors.measurement_matrix[places], prediction.root)
        scaled = scale * expectation.uncensored_probability[places]
        return scaled[..., None, :] * matrix, scale * innovation


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
        root = linalg.root(covariance)
        expectation = self.filter.expect(mean, root)
        floor = 1e-3 * self.sensors.variance
        return CentrePrediction(expectation, np.sqrt(expectation.noise_variance + floor), root)

    def update(
        self,
        mean: Array,
        covariance: Array,
        prediction: CentrePrediction,
        measurement: Array,
        granted: NDArray[np.bool_],
    ) -> tuple[Array, Array]:
        """See :class:`Centre`."""
        mean, root = self.filter.update(mean, prediction.root, measurement, granted)
        return mean, np.where(granted.any(0), linalg.gram(root), covariance)

    def variances(
        self, mean: Array, covariance: Array, prediction: CentrePrediction, weights: Array
    ) -> tuple[Array, Array]:
        """See :class:`Centre`; the reduction is the expected one."""
        silent = linalg.weighted_trace(covariance, weights)
        expected = self.filter.expected_covariance(mean, prediction.root)
        return silent, silent - linalg.weighted_trace(expected, weights)


def _deviation(sensors: CensoredSensors, expectation: Expectation, spread: Array) -> Array:
    """Standard deviation of the innovation from the variances ``spread`` of C x, all (l, m, N)."""
    q = expectation.uncensored_probability
    return np.sqrt(q * q * spread + expectation.noise_variance + 1e-3 * sensors.variance)


def _stack(values: Array) -> Array:
    """The channels of all sensors one after another, (sensors · m, …), of (sensors, m, …)."""
    return values.reshape(-1, *values.shape[2:])


def _shifted(
    mean: Array, prediction: CentrePrediction, matrix: Array, value: Array
) -> tuple[Array, Array]:
    """Mean and covariance of x = x̂ + G z after :func:`joint_update` of z."""
    shift, covariance = joint_update(matrix, value)
    root = prediction.root
    return mean + linalg.matvec(root, shift), linalg.congruence(root, covariance)


def _outcomes(prediction: CentrePrediction) -> Outcomes:
    if prediction.outcomes is None:
        raise RuntimeError("the prediction has no outcomes: it was made by another centre")
    return prediction.outcomes
