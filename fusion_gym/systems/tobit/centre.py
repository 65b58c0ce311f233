"""Nodes and fusion centre: from prediction and deliveries to the fused estimate."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Protocol, Self, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.errors import forbidden
from fusion_gym.fusion.rules import FusionRule
from fusion_gym.namespace import active_rows, namespace
from fusion_gym.systems.linear_plant import LinearPlant
from fusion_gym.systems.tobit import filters
from fusion_gym.systems.tobit.sensors import CensoredSensors
from fusion_gym.systems.tobit.tobit_filter import AssumedDensityFilter

Gaussian = tuple[Array, Array]  # mean (…, n, N) and covariance (…, n, n, N)
Packets = NDArray[np.bool_]


class CentrePrediction(NamedTuple):
    """The prediction of centre and nodes before a transmission.

    ``expectation`` of the measurements, ``deviation`` (sensors, m, N) of the innovation, ``root`` G
    (n, n, N) of the covariance without a transmission, and, where nodes have covariances of their
    own, their ``outcomes`` z of x = x̂ + G z. A centre that uses held values has them as ``held``,
    a hold its ``moment``; ``possible`` (sensors, N) are the sensors that the network would have
    granted, ``None`` for all.
    """

    expectation: filters.Expectation
    deviation: Array
    root: Array
    outcomes: filters.Outcomes | None = None
    held: Any = None
    moment: Any = None
    possible: Any = None


class Centre(Protocol):
    """The interface of nodes and centre.

    Attributes:
        separable: Whether :meth:`single` is available, and faster than one update after another.
        reads_silence: Whether a step without a delivery is information.
        traceable: Whether JAX traces the methods.
    """

    filter: Any
    separable: ClassVar[bool] = False
    reads_silence: ClassVar[bool] = False
    traceable: ClassVar[bool] = True

    @property
    def sensors(self) -> CensoredSensors:
        """The sensors."""
        sensors: CensoredSensors = self.filter.sensors
        return sensors

    def at(self, step: Array) -> Self:
        """Return the centre with the matrices of its sensors at steps (N,)."""
        own: Any = self
        sensors = self.sensors.at(step)
        if sensors is self.sensors:
            return self
        return cast(Self, replace(own, filter=replace(self.filter, sensors=sensors)))

    @property
    def predictable(self) -> bool:
        """Whether the covariances depend on the deliveries only."""
        return False

    def advance(self, model: LinearPlant, state: Any) -> tuple[Gaussian, CentrePrediction]:
        """Return the prior and the prediction one step after a state's delivery."""
        prior = model.predict(state.mean, state.covariance)
        return prior, self.predict(*prior, state.held, state.time + 1.0)

    def predict(self, mean: Array, covariance: Array, held: Array, time: Array) -> CentrePrediction:
        """Return the expectations under the centre's prediction (n, N), (n, n, N)."""

    def update(
        self, prior: Gaussian, prediction: CentrePrediction, measurement: Array, granted: Packets
    ) -> Gaussian:
        """Return mean (n, N) and covariance (n, n, N) after the grants (sensors, N)."""

    def local_means(
        self, prior: Gaussian, prediction: CentrePrediction, measurement: Array, granted: Packets
    ) -> Array:
        """Return the nodes' means (sensors, n, N) before feedback; without nodes, the centre's."""
        own = self.update(prior, prediction, measurement, granted)[0]
        return np.broadcast_to(own, (len(granted), *own.shape))

    def single(self, prior: Gaussian, prediction: CentrePrediction, measurement: Array) -> Gaussian:
        """Return means (sensors, n, N) and covariances (sensors, n, n, N) after single grants."""
        raise RuntimeError(f"{type(self).__name__} is not separable")

    def variances(
        self, prior: Gaussian, prediction: CentrePrediction, weights: Array
    ) -> tuple[Array, Array]:
        """Return a silent step's weighted fused trace (N,), and its reductions (sensors, N).

        A packet holds the expected measurement.
        """
        count, runs = self.sensors.count, prior[0].shape[-1]

        def trace(granted: Packets) -> Array:
            packets = np.broadcast_to(granted[:, None], (count, runs))
            posterior = self.update(prior, prediction, prediction.expectation.value, packets)
            return linalg.weighted_trace(posterior[1], weights)

        silent = trace(np.zeros(count, dtype=np.bool_))
        return silent, silent - np.stack([trace(own) for own in np.eye(count, dtype=np.bool_)])


def information_shares(share: ArrayLike | None, sensors: int) -> Array:
    """Return the shares (sensors, 1) of the prediction that the nodes get.

    Args:
        share: w_m > 0 with sum 1 (sensors,), or None for equal shares.
        sensors: number of sensors.

    Raises:
        ConfigurationError: a wrong shape, an entry <= 0, or another sum.
    """
    if share is None:
        return np.full((sensors, 1), 1.0 / sensors)
    weights = validation.array("information_shares", share, (sensors,))
    if np.any(weights <= 0) or abs(weights.sum() - 1.0) > 1e-9:
        reason = f"they must be > 0 with sum 1 (their sum is {weights.sum():.6g})"
        raise forbidden("information_shares", weights, reason)
    return weights[:, None]


@dataclass(frozen=True)
class NodeCentre(Centre):
    """A centre with a node filter for each sensor, with feedback of its prediction.

    With shares w_m of sum 1, ``share`` (sensors, 1), node m gets the prediction with its covariance
    multiplied by 1/w_m. This is the paper's feedback (51) and local prediction (29) in one: it
    inflates both the fused covariance and the process covariance. Both inflations are necessary so
    that the sum of the nodes' information counts nothing twice.

    With shares of 1 every node gets the prediction unchanged. Only the fusion rule then avoids
    counting the common prior several times; it must be a form of covariance intersection. Two nodes
    with a common prior and independent measurements are the structure for which the inverse form
    was derived, so "ici" keeps its bound here. With a single delivery every form returns the node
    that received it.

    Source: tobit_token_bucket, equation (51); round_robin_tobit, equation (27).
    """

    filter: filters.NodeFilter
    share: Array

    @property
    def predictable(self) -> bool:
        """See :class:`Centre`; true for Kalman filters of uncensored sensors."""
        return type(self.filter) is filters.KalmanFilter and self.sensors.unlimited


@dataclass(frozen=True)
class FeedbackCentre(NodeCentre):
    """A node filter for each sensor, fusion, and feedback of the result to the nodes.

    Nodes and fusion work on z of x = x̂ + G z with G Gᵀ the covariance of the prediction, so that
    all inverted covariances are regular.

    Source: tobit_token_bucket, equations (20)-(23), (29)-(37), (50), (51); round_robin_tobit,
    equations (18)-(27).
    """

    fusion: FusionRule

    def predict(self, mean: Array, covariance: Array, held: Array, time: Array) -> CentrePrediction:
        """See :class:`Centre`."""
        expectation = self.filter.expect(mean)
        root = linalg.root(self.sensors.regular(covariance))
        observed = linalg.matmul(self.sensors.measurement_matrix, root)
        deviation = _deviation(self.sensors, expectation, linalg.total(observed * observed))
        share = self.share[:, None, None]
        inflated = observed / namespace(share).sqrt(share)
        outcomes = self.filter.outcomes(inflated, expectation, held, time)
        return CentrePrediction(expectation, deviation, root, outcomes)

    def update(
        self, prior: Gaussian, prediction: CentrePrediction, measurement: Array, granted: Packets
    ) -> Gaussian:
        """See :class:`Centre`; each node uses its planned outcome of a grant or of silence."""
        outcomes, root, share = _outcomes(prediction), prediction.root, self.share[:, None]
        both = outcomes.delivered_covariance, outcomes.silent_covariance
        own = namespace(granted).where(granted[:, None, None], *both)
        local = self._shift(prediction, measurement, granted)
        fused = self.fusion.fuse(local, own / share[:, None], basis=root)
        return prior[0] + linalg.matvec(root, fused.mean), linalg.congruence(root, fused.covariance)

    def local_means(
        self, prior: Gaussian, prediction: CentrePrediction, measurement: Array, granted: Packets
    ) -> Array:
        """See :class:`Centre`."""
        local = self._shift(prediction, measurement, granted)
        return prior[0] + linalg.matvec(prediction.root, local)

    def _shift(self, prediction: CentrePrediction, measurement: Array, granted: Packets) -> Array:
        """Return the nodes' means (sensors, n, N) of z."""
        outcomes = _outcomes(prediction)
        innovation = measurement - prediction.expectation.value
        delivered = linalg.matvec(linalg.transpose(outcomes.correction), innovation)
        local = namespace(granted).where(granted[:, None], delivered, outcomes.silent_mean)
        share = self.share[:, None]
        return local / namespace(share).sqrt(share)

    def variances(
        self, prior: Gaussian, prediction: CentrePrediction, weights: Array
    ) -> tuple[Array, Array]:
        """See :class:`Centre`; a filter that minimises a bound uses the bound."""
        outcomes, root = _outcomes(prediction), prediction.root
        share = self.share[:, None, None]
        covariances = outcomes.silent_covariance / share, outcomes.delivered_covariance / share
        silent, single = (
            linalg.weighted_trace(linalg.congruence(root, fused), weights)
            for fused in self.fusion.fuse_single(*covariances, basis=root)
        )
        return silent, silent - single


@dataclass(frozen=True)
class FederatedCentre(NodeCentre):
    """Nodes with Kalman filters whose information adds up, computed at the centre.

    Nodes that share the prediction P in shares w_m of sum 1 have the information Σ (w_m P⁻¹ + Cᵀ
    N⁻¹ C) together. This equals the centre's own update by one delivered scalar after another,
    which inverts no covariance. A silent sensor of weight Z acts as an innovation of zero with the
    noise N + Z⁻¹; a delivery adds the difference N⁻¹ - (N + Z⁻¹)⁻¹ = (N + N Z N)⁻¹.

    Source: tobit_token_bucket, equations (20)-(23), (50), (51); round_robin_tobit, equations
    (18)-(27).
    """

    filter: filters.KalmanFilter
    separable = True

    def predict(self, mean: Array, covariance: Array, held: Array, time: Array) -> CentrePrediction:
        """See :class:`Centre`; ``held`` and ``time`` have no effect."""
        sensors, weight = self.sensors, self.filter.silence
        expectation, root = self.filter.expect(mean), linalg.root(covariance)
        observed = linalg.matmul(sensors.measurement_matrix, root)
        deviation = _deviation(sensors, expectation, linalg.total(observed * observed))
        if weight is not None:
            # Both sides times √Z, so that weight 0 is no exception.
            scale = (weight[:, None] / (1.0 + weight[:, None] * sensors.variance)) ** 0.5
            nothing = 0.0 * expectation.value
            _, silent = filters.joint_update(_stack(scale[:, :, None] * observed), _stack(nothing))
            root = linalg.matmul(root, linalg.root(silent))
        return CentrePrediction(expectation, deviation, root)

    def update(
        self, prior: Gaussian, prediction: CentrePrediction, measurement: Array, granted: Packets
    ) -> Gaussian:
        """See :class:`Centre`."""
        mean, covariance = prior
        xp, places = namespace(granted), active_rows(granted)
        silent = covariance if self.filter.silence is None else linalg.gram(prediction.root)
        if not places.size:
            return mean, silent
        matrix, value = self._whitened(prediction, measurement, places)
        matrix = xp.where(granted[places, None, None], matrix, 0.0)
        mean, posterior = _shifted(mean, prediction, _stack(matrix), _stack(value))
        return mean, xp.where(granted.any(0), posterior, silent)

    def local_means(
        self, prior: Gaussian, prediction: CentrePrediction, measurement: Array, granted: Packets
    ) -> Array:
        """See :class:`Centre`."""
        sensors, expectation = self.sensors, prediction.expectation
        weighted = expectation.uncensored_probability[:, :, None] * sensors.measurement_matrix
        cross = linalg.matmul(weighted, prior[1])
        total = linalg.matmul(cross, linalg.transpose(weighted))
        noise = sensors.variance * expectation.truncated_variance
        total = linalg.add_diagonal(total, self.share[:, None] * noise)
        innovation = measurement - expectation.value
        innovation = namespace(innovation).where(granted[:, None], innovation, 0.0)
        shift = linalg.matvec(linalg.transpose(cross), linalg.solve_vector(total, innovation))
        return prior[0] + shift

    def single(self, prior: Gaussian, prediction: CentrePrediction, measurement: Array) -> Gaussian:
        """See :class:`Centre`."""
        whitened = self._whitened(prediction, measurement, slice(None))
        return _shifted(prior[0], prediction, *whitened)

    def variances(
        self, prior: Gaussian, prediction: CentrePrediction, weights: Array
    ) -> tuple[Array, Array]:
        """See :class:`Centre`."""
        silent = linalg.weighted_trace(linalg.gram(prediction.root), weights)
        single = self.single(prior, prediction, prediction.expectation.value)[1]
        return silent, silent - linalg.weighted_trace(single, weights)

    def _whitened(
        self, prediction: CentrePrediction, measurement: Array, places: Any
    ) -> tuple[Array, Array]:
        """Return N^-½ q C G (…, m, n, N) and N^-½ (y - ŷ): deliveries with unit noise."""
        sensors, expectation, weight = self.sensors, prediction.expectation, self.filter.silence
        noise = sensors.variance[places] * expectation.truncated_variance[places]
        innovation = measurement[places] - expectation.value[places]
        if weight is not None:
            larger = 1.0 + weight[places, None] * noise
            noise, innovation = noise * larger, innovation * larger
        scale = 1.0 / namespace(noise).sqrt(noise)
        matrix = linalg.matmul(sensors.measurement_matrix[places], prediction.root)
        scaled = scale * expectation.uncensored_probability[places]
        return scaled[..., None, :] * matrix, scale * innovation


@dataclass(frozen=True)
class SequentialCentre(Centre):
    """A centre without nodes, which processes the deliveries one after another."""

    filter: AssumedDensityFilter

    def predict(self, mean: Array, covariance: Array, held: Array, time: Array) -> CentrePrediction:
        """See :class:`Centre`; ``held`` and ``time`` have no effect."""
        root = linalg.root(covariance)
        expectation = self.filter.expect(mean, root)
        floor = 1e-3 * self.sensors.variance
        deviation = namespace(root).sqrt(expectation.noise_variance + floor)
        return CentrePrediction(expectation, deviation, root)

    def update(
        self, prior: Gaussian, prediction: CentrePrediction, measurement: Array, granted: Packets
    ) -> Gaussian:
        """See :class:`Centre`."""
        mean, covariance = prior
        mean, root = self.filter.update(mean, prediction.root, measurement, granted)
        fused = namespace(granted).where(granted.any(0), linalg.gram(root), covariance)
        return mean, fused

    def variances(
        self, prior: Gaussian, prediction: CentrePrediction, weights: Array
    ) -> tuple[Array, Array]:
        """See :class:`Centre`; the reduction is the expected one."""
        silent = linalg.weighted_trace(prior[1], weights)
        expected = self.filter.expected_covariance(prior[0], prediction.root)
        return silent, silent - linalg.weighted_trace(expected, weights)


def _deviation(sensors: CensoredSensors, expectation: filters.Expectation, spread: Array) -> Array:
    """Return the innovation's deviation from the variances ``spread`` of C x, all (l, m, N)."""
    q = expectation.uncensored_probability
    variance = q * q * spread + expectation.noise_variance + 1e-3 * sensors.variance
    return namespace(variance).sqrt(variance)


def _stack(values: Array) -> Array:
    """Return the channels of all sensors (sensors · m, …) of (sensors, m, …)."""
    return values.reshape(-1, *values.shape[2:])


def _shifted(
    mean: Array, prediction: CentrePrediction, matrix: Array, value: Array
) -> tuple[Array, Array]:
    """Return mean and covariance of x = x̂ + G z after :func:`joint_update` of z."""
    shift, covariance = filters.joint_update(matrix, value)
    root = prediction.root
    return mean + linalg.matvec(root, shift), linalg.congruence(root, covariance)


def _outcomes(prediction: CentrePrediction) -> filters.Outcomes:
    if prediction.outcomes is None:
        raise RuntimeError("the prediction has no outcomes: another centre made it")
    return prediction.outcomes
