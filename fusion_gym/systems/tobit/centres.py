"""Nodes and fusion centres, from prediction and deliveries to the fused estimate, by filter."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Protocol, Self, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.errors import ConfigurationError, forbidden, refusal
from fusion_gym.fusion.rules import FusionRule
from fusion_gym.fusion.table import Structure, choose_rule
from fusion_gym.namespace import active_rows, namespace
from fusion_gym.systems.linear_plant import LinearPlant
from fusion_gym.systems.silence import Silence
from fusion_gym.systems.tobit.filters import (
    AssumedDensityFilter,
    Expectation,
    KalmanFilter,
    NodeFilter,
    StochasticEventFilter,
    joint_update,
    linear_update,
)
from fusion_gym.systems.tobit.sensors import CensoredSensors

Gaussian = tuple[Array, Array]  # mean (…, n, N) and covariance (…, n, n, N)
Packets = NDArray[np.bool_]
STRUCTURE = Structure(
    common="all nodes start from the same prediction", holds=("information shares",)
)
_MOST_CHANNELS = 100  # whose joint covariance is solved in every step
_ROUNDS = 2  # a third changes errors by less than a thousandth
_LEAST_SHARE = 1e-9  # of a variance; the rest of the difference is rounding


class Nodes(NamedTuple):
    """What sensors without feedback predict from their own deliveries.

    ``mean`` (sensors, n, N) and ``covariance`` (sensors, n, n, N) of the state, ``value`` and
    ``deviation`` (sensors, m, N) of the measurement.
    """

    mean: Array
    covariance: Array
    value: Array
    deviation: Array


class Prediction(NamedTuple):
    """The prediction of centre and nodes before a transmission.

    ``expectation`` of the measurements, ``deviation`` (sensors, m, N) of the innovation, ``root`` G
    (n, n, N) of the covariance without a transmission, the centre's ``prior``, and, where nodes
    have covariances of their own, their ``outcomes`` z of x = x̂ + G z. A centre that uses held
    values has them as ``held``, a hold its ``moment``, sensors without feedback their ``nodes``;
    ``possible`` (sensors, N) are the sensors that the network would have granted, ``None`` for all.
    """

    expectation: Expectation
    deviation: Array
    root: Array
    prior: Gaussian
    outcomes: Any = None
    held: Any = None
    moment: Any = None
    nodes: Nodes | None = None
    possible: Any = None

    @property
    def own(self) -> tuple[Array, Array]:
        """Expectation and deviation of the measurements, as the sensors know them."""
        if self.nodes is not None:
            return self.nodes.value, self.nodes.deviation
        return self.expectation.value, self.deviation


class Centre(Protocol):
    """The interface of nodes and centre.

    Attributes:
        separable: Whether :meth:`single` is available, and faster than one update after another.
        reads_silence: Whether a step without a delivery is information.
        traceable: Whether JAX traces the methods.
        predicts: Whether a step without a delivery only predicts, by A x̂.
        predictable: Whether the covariances depend on the deliveries only.
    """

    filter: Any
    separable: ClassVar[bool] = False
    reads_silence: ClassVar[bool] = False
    traceable: ClassVar[bool] = True
    predicts: ClassVar[bool] = False
    predictable: ClassVar[bool] = False

    @property
    def sensors(self) -> CensoredSensors:
        """The sensors."""
        return self.filter.sensors

    def at(self, step: Array) -> Self:
        """Return the centre with the matrices of its sensors at steps (N,)."""
        sensors = self.sensors.at(step)
        if sensors is self.sensors:
            return self
        return replace(cast(Any, self), filter=replace(self.filter, sensors=sensors))

    def advance(self, model: LinearPlant, state: Any, control: Array | None) -> Prediction:
        """Return the prediction one step after a state's delivery and an input (k, N)."""
        prior = model.predict(state.mean, state.covariance, control)
        return self.predict(prior, state.held, state.time + 1.0)

    def predict(self, prior: Gaussian, held: Array, time: Array) -> Prediction:
        """Return the expectations under the centre's prior (n, N), (n, n, N)."""

    def update(self, prediction: Prediction, measurement: Array, granted: Packets) -> Gaussian:
        """Return mean (n, N) and covariance (n, n, N) after the grants (sensors, N)."""

    def local_means(self, prediction: Prediction, measurement: Array, granted: Packets) -> Array:
        """Return the nodes' means (sensors, n, N) before feedback; without nodes, the centre's."""
        own = self.update(prediction, measurement, granted)[0]
        return np.broadcast_to(own, (len(granted), *own.shape))

    def single(self, prediction: Prediction, measurement: Array) -> Gaussian:
        """Return means (sensors, n, N) and covariances (sensors, n, n, N) after single grants."""
        raise RuntimeError(f"{type(self).__name__} is not separable")

    def variances(self, prediction: Prediction, weights: Array) -> tuple[Array, Array]:
        """Return a silent step's weighted fused trace (N,), and its reductions (sensors, N).

        A packet holds the expected measurement.
        """
        count, runs = self.sensors.count, prediction.root.shape[-1]

        def trace(granted: Packets) -> Array:
            packets = np.broadcast_to(granted[:, None], (count, runs))
            posterior = self.update(prediction, prediction.expectation.value, packets)
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

    filter: NodeFilter
    share: Array

    @property
    def predicts(self) -> bool:  # type: ignore[override]
        """See :class:`Centre`."""
        return self.filter.predicts

    @property
    def predictable(self) -> bool:  # type: ignore[override]
        """See :class:`Centre`; true for Kalman filters of uncensored sensors."""
        return type(self.filter) is KalmanFilter and self.sensors.unlimited


@dataclass(frozen=True)
class FeedbackCentre(NodeCentre):
    """A node filter for each sensor, fusion, and feedback of the result to the nodes.

    Nodes and fusion work on z of x = x̂ + G z with G Gᵀ the covariance of the prediction, so that
    all inverted covariances are regular.

    Source: tobit_token_bucket, equations (20)-(23), (29)-(37), (50), (51); round_robin_tobit,
    equations (18)-(27).
    """

    fusion: FusionRule

    def predict(self, prior: Gaussian, held: Array, time: Array) -> Prediction:
        """See :class:`Centre`."""
        expectation = self.filter.expect(prior[0])
        root = linalg.root(self.sensors.regular(prior[1]))
        observed = linalg.matmul(self.sensors.measurement_matrix, root)
        deviation = _deviation(self.sensors, expectation, linalg.total(observed * observed))
        share = self.share[:, None, None]
        inflated = observed / namespace(share).sqrt(share)
        outcomes = self.filter.outcomes(inflated, expectation, held, time)
        return Prediction(expectation, deviation, root, prior, outcomes)

    def update(self, prediction: Prediction, measurement: Array, granted: Packets) -> Gaussian:
        """See :class:`Centre`; each node uses its planned outcome of a grant or of silence."""
        outcomes, root, share = prediction.outcomes, prediction.root, self.share[:, None]
        both = outcomes.delivered_covariance, outcomes.silent_covariance
        own = namespace(granted).where(granted[:, None, None], *both)
        local = self._shift(prediction, measurement, granted)
        fused = self.fusion.fuse(local, own / share[:, None], basis=root)
        mean = prediction.prior[0] + linalg.matvec(root, fused.mean)
        return mean, linalg.congruence(root, fused.covariance)

    def local_means(self, prediction: Prediction, measurement: Array, granted: Packets) -> Array:
        """See :class:`Centre`."""
        local = self._shift(prediction, measurement, granted)
        return prediction.prior[0] + linalg.matvec(prediction.root, local)

    def _shift(self, prediction: Prediction, measurement: Array, granted: Packets) -> Array:
        """Return the nodes' means (sensors, n, N) of z."""
        outcomes = prediction.outcomes
        innovation = measurement - prediction.expectation.value
        delivered = linalg.matvec(linalg.transpose(outcomes.correction), innovation)
        local = namespace(granted).where(granted[:, None], delivered, outcomes.silent_mean)
        share = self.share[:, None]
        return local / namespace(share).sqrt(share)

    def variances(self, prediction: Prediction, weights: Array) -> tuple[Array, Array]:
        """See :class:`Centre`; a filter that minimises a bound uses the bound."""
        outcomes, root = prediction.outcomes, prediction.root
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

    filter: KalmanFilter
    separable = True

    def predict(self, prior: Gaussian, held: Array, time: Array) -> Prediction:
        """See :class:`Centre`; ``held`` and ``time`` have no effect."""
        sensors, weight = self.sensors, self.filter.silence
        expectation, root = self.filter.expect(prior[0]), linalg.root(prior[1])
        observed = linalg.matmul(sensors.measurement_matrix, root)
        deviation = _deviation(sensors, expectation, linalg.total(observed * observed))
        if weight is not None:
            # Both sides times √Z, so that weight 0 is no exception.
            scale = (weight[:, None] / (1.0 + weight[:, None] * sensors.variance)) ** 0.5
            nothing = 0.0 * expectation.value
            _, silent = joint_update(_stack(scale[:, :, None] * observed), _stack(nothing))
            root = linalg.matmul(root, linalg.root(silent))
        return Prediction(expectation, deviation, root, prior)

    def update(self, prediction: Prediction, measurement: Array, granted: Packets) -> Gaussian:
        """See :class:`Centre`."""
        mean, covariance = prediction.prior
        xp, places = namespace(granted), active_rows(granted)
        silent = covariance if self.filter.silence is None else linalg.gram(prediction.root)
        if not places.size:
            return mean, silent
        matrix, value = self._whitened(prediction, measurement, places)
        matrix = xp.where(granted[places, None, None], matrix, 0.0)
        mean, posterior = _shifted(prediction, _stack(matrix), _stack(value))
        return mean, xp.where(granted.any(0), posterior, silent)

    def local_means(self, prediction: Prediction, measurement: Array, granted: Packets) -> Array:
        """See :class:`Centre`."""
        sensors, expectation = self.sensors, prediction.expectation
        weighted = expectation.uncensored_probability[:, :, None] * sensors.measurement_matrix
        cross = linalg.matmul(weighted, prediction.prior[1])
        total = linalg.matmul(cross, linalg.transpose(weighted))
        noise = sensors.variance * expectation.truncated_variance
        total = linalg.add_diagonal(total, self.share[:, None] * noise)
        innovation = measurement - expectation.value
        innovation = namespace(innovation).where(granted[:, None], innovation, 0.0)
        shift = linalg.matvec(linalg.transpose(cross), linalg.solve_vector(total, innovation))
        return prediction.prior[0] + shift

    def single(self, prediction: Prediction, measurement: Array) -> Gaussian:
        """See :class:`Centre`."""
        return _shifted(prediction, *self._whitened(prediction, measurement, slice(None)))

    def variances(self, prediction: Prediction, weights: Array) -> tuple[Array, Array]:
        """See :class:`Centre`."""
        silent = linalg.weighted_trace(linalg.gram(prediction.root), weights)
        single = self.single(prediction, prediction.expectation.value)[1]
        return silent, silent - linalg.weighted_trace(single, weights)

    def _whitened(
        self, prediction: Prediction, measurement: Array, places: Any
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
    predicts = True

    def predict(self, prior: Gaussian, held: Array, time: Array) -> Prediction:
        """See :class:`Centre`; ``held`` and ``time`` have no effect."""
        root = linalg.root(prior[1])
        expectation = self.filter.expect(prior[0], root)
        floor = 1e-3 * self.sensors.variance
        deviation = namespace(root).sqrt(expectation.noise_variance + floor)
        return Prediction(expectation, deviation, root, prior)

    def update(self, prediction: Prediction, measurement: Array, granted: Packets) -> Gaussian:
        """See :class:`Centre`."""
        mean, covariance = prediction.prior
        mean, root = self.filter.update(mean, prediction.root, measurement, granted)
        fused = namespace(granted).where(granted.any(0), linalg.gram(root), covariance)
        return mean, fused

    def variances(self, prediction: Prediction, weights: Array) -> tuple[Array, Array]:
        """See :class:`Centre`; the reduction is the expected one."""
        silent = linalg.weighted_trace(prediction.prior[1], weights)
        expected = self.filter.expected_covariance(prediction.prior[0], prediction.root)
        return silent, silent - linalg.weighted_trace(expected, weights)


def _deviation(sensors: CensoredSensors, expectation: Expectation, spread: Array) -> Array:
    """Return the innovation's deviation from the variances ``spread`` of C x, all (l, m, N)."""
    q = expectation.uncensored_probability
    variance = q * q * spread + expectation.noise_variance + 1e-3 * sensors.variance
    return namespace(variance).sqrt(variance)


def _stack(values: Array) -> Array:
    """Return the channels of all sensors (sensors · m, …) of (sensors, m, …)."""
    return values.reshape(-1, *values.shape[2:])


def _shifted(prediction: Prediction, matrix: Array, value: Array) -> Gaussian:
    """Return mean and covariance of x = x̂ + G z after :func:`joint_update` of z."""
    shift, covariance = joint_update(matrix, value)
    root = prediction.root
    return prediction.prior[0] + linalg.matvec(root, shift), linalg.congruence(root, covariance)


@dataclass(frozen=True)
class JointCentre(FederatedCentre):
    r"""Kalman filter at the centre, of all deliveries of a step, without nodes.

    With C and y the delivered rows and R the joint covariance of their noises: S = C P Cᵀ + R, K =
    P Cᵀ S⁻¹, x̂ = x⁻ + K (y - C x⁻), P = P⁻ - K C P⁻. It is optimal for uncensored sensors and
    ignores censoring.

    Equation:
        $$
        S=C P C^{\mathsf T}+R,\qquad K=P C^{\mathsf T}S^{-1}
        $$

        $$
        \hat x^{+}=\hat x+K(y-C\hat x),\qquad P^{+}=P-K C P
        $$

        y and C stack the measurements of all sensors that have arrived in the step, and R is the
        covariance of their noises, correlations between sensors included. When nothing arrives the
        prediction stays.

    Assumes: a linear plant, Gaussian noises whose joint covariance is known, uncensored sensors,
    and transmissions that are not chosen by the noise.

    Source: B. D. O. Anderson and J. B. Moore, "Optimal Filtering", 1979, chapter 3.
    """

    def update(self, prediction: Prediction, measurement: Array, granted: Packets) -> Gaussian:
        """See :class:`Centre`."""
        mean, covariance = prediction.prior
        xp, sensors, runs = namespace(granted), self.sensors, granted.shape[-1]
        every = xp.repeat(granted, sensors.size, axis=0)
        channels = active_rows(every)
        if not channels.size:
            return mean, covariance
        taken = every[channels].astype(np.float64)
        innovation = (measurement - prediction.expectation.value).reshape(-1, runs)[channels]
        # A channel that has not arrived stands for nothing, with a variance of 1.
        noise = taken[:, None] * taken * sensors.noise_covariance[np.ix_(channels, channels)]
        matrix = linalg.matmul(sensors.stacked_matrix[channels], prediction.root)
        both = taken[:, None] * xp.concatenate([matrix, innovation[:, None]], axis=1)
        both = linalg.whiten(linalg.add_diagonal(noise, 1.0 - taken), both)
        shift, posterior = joint_update(both[:, :-1], both[:, -1])
        posterior = linalg.congruence(prediction.root, posterior)
        mean = mean + linalg.matvec(prediction.root, shift)
        return mean, xp.where(granted.any(0), posterior, covariance)

    local_means = Centre.local_means


def joint_centre(
    options: Any, sensors: CensoredSensors, kind: type[JointCentre] = JointCentre
) -> JointCentre:
    """Return the centre of ``filter="joint"`` or ``"local"``.

    Args:
        options: options of the environment, of which none matters.
        sensors: the sensors.
        kind: class of the centre.

    Raises:
        ConfigurationError: more than 100 channels.
    """
    channels = sensors.noise_channels
    if channels > _MOST_CHANNELS:
        raise ConfigurationError(
            f"filter = {options.filter!r} is not allowed with {sensors.count} sensors of "
            f"{sensors.size} channels: together they may have at most {_MOST_CHANNELS}, because a "
            "step costs their cube; with independent noises 'kalman' is the same filter"
        )
    return kind(KalmanFilter(sensors), np.ones((sensors.count, 1)))


@dataclass(frozen=True)
class LocalCentre(JointCentre):
    r"""Kalman filter of all deliveries at the centre, and one of its own deliveries at each sensor.

    The centre sends nothing back, so a sensor can compute its innovation alone.

    Equation:
        $$
        \text{delivered:}\quad \hat x_i^{+}=\hat x_i+K_i(y_i-C_i\hat x_i),\qquad
        \text{else:}\quad \hat x_i^{+}=\hat x_i,\qquad \hat x_i'=A\hat x_i^{+}
        $$

        K_i is the gain of sensor i alone; its innovation has the variance C_i P_i C_iᵀ + R_i.

    Assumes: what :class:`JointCentre` assumes.

    Source: B. D. O. Anderson and J. B. Moore, "Optimal Filtering", 1979, chapter 3.
    """

    traceable = False

    def advance(self, model: LinearPlant, state: Any, control: Array | None) -> Prediction:
        """See :class:`Centre`; an estimate of a sensor begins at the plant's."""
        result = super().advance(model, state, control)
        if state.prediction is None:
            shape = (self.sensors.count, model.size, state.time.size)
            mean = np.broadcast_to(model.initial_mean, shape)
            covariance = np.broadcast_to(model.initial_covariance, (*shape[:2], *shape[1:]))
        else:
            mean, covariance = state.prediction.nodes[:2]
        arrived = state.age == 0.0
        if state.available is not None:
            arrived = arrived & state.available
        matrix, variance = self.sensors.measurement_matrix, self.sensors.variance
        root = linalg.root(covariance)
        correction, posterior = linear_update(linalg.matmul(matrix, root), variance)
        innovation = state.measurement - linalg.matvec(matrix, mean)
        shift = linalg.matvec(linalg.transpose(correction), innovation)
        mean = mean + arrived[:, None] * linalg.matvec(root, shift)
        posterior = linalg.congruence(root, posterior)
        covariance = np.where(arrived[:, None, None], posterior, covariance)
        mean, covariance = model.predict(mean, covariance, control)
        spread = linalg.diagonal(linalg.congruence(matrix, covariance))
        value, deviation = linalg.matvec(matrix, mean), np.sqrt(spread + variance)
        return result._replace(nodes=Nodes(mean, covariance, value, deviation))


@dataclass(frozen=True)
class HoldCentre(Centre):
    r"""Least squares of the held values, weighted by the noises, without a filter.

    The covariance is the mean squared error by the model. It follows the second moment Σ of (x, d),
    with d = C x - ȳ what happened since the deliveries.

    Equation:
        $$
        \hat x=C^{+}\bar y,\qquad C^{+}=(C^{\mathsf T}R^{-1}C)^{-1}C^{\mathsf T}R^{-1},\qquad
        P=C^{+}\,\Sigma_{dd}\,(C^{+})^{\mathsf T}
        $$

        $$
        \Sigma'=F\Sigma F^{\mathsf T}+\begin{pmatrix}I\\C\end{pmatrix}W\begin{pmatrix}I\\
        C\end{pmatrix}^{\mathsf T},\qquad F=\begin{pmatrix}A&0\\C(A-I)&I\end{pmatrix}
        $$

        ȳ, C and R stack the last delivered values, matrices and variances of all sensors. A
        delivery of sensor i sets d_i = -v_i: its rows and columns of Σ become zero but for the
        covariance R_i.

    Assumes: deliveries at times that do not depend on the values, for P; and sensors that together
    determine the state.

    Source: none; the hold of industrial controllers, with the moments of the model.
    """

    filter: KalmanFilter
    plant: LinearPlant
    traceable = False

    @functools.cached_property
    def inverse(self) -> Array:
        """C⁺ (n, channels, 1)."""
        matrix, size, deviation = _unit_free(self.sensors)
        inverse: Array = np.linalg.pinv(matrix) / size[:, None] / deviation
        return inverse[..., None]

    @functools.cached_property
    def motion(self) -> tuple[Array, Array]:
        """F and the covariance of the noise of (x, d), each (n + channels, n + channels, 1)."""
        matrix, transition = self.sensors.stacked_matrix[..., 0], self.plant.transition[..., 0]
        channels, n = matrix.shape
        still: Array = np.eye(n)
        state = [transition, np.zeros((n, channels))]
        motion: Array = np.block([state, [matrix @ (transition - still), np.eye(channels)]])
        both = np.concatenate([still, matrix])[..., None]
        return motion[..., None], linalg.congruence(both, self.plant.process_covariance)

    def predict(self, prior: Gaussian, held: Array, time: Array) -> Prediction:
        """See :class:`Centre`; the prediction of the start, when every value is delivered."""
        mean, covariance = prior
        n, channels = self.inverse.shape[:2]
        moment = np.zeros((n + channels, n + channels, mean.shape[-1]))
        moment[:n, :n] = covariance + linalg.outer(mean, mean)
        return self._predict(prior, held, moment)

    def advance(self, model: LinearPlant, state: Any, control: Array | None) -> Prediction:
        """See :class:`Centre`; the estimate stays, and there is no input."""
        before = state.prediction
        if before is None:
            runs, plant = state.mean.shape[-1], self.plant
            first = (plant.initial_mean, plant.initial_covariance)
            mean, covariance = (np.repeat(values, runs, axis=-1) for values in first)
            before = self.predict((mean, covariance), state.held, state.time)
        transition, noise = self.motion
        moment = self._delivered(before.moment, state.age == 0.0)
        moment = linalg.congruence(transition, moment) + noise
        return self._predict((state.mean, self._covariance(moment)), state.held, moment)

    def update(self, prediction: Prediction, measurement: Array, granted: Packets) -> Gaussian:
        """See :class:`Centre`."""
        held = np.where(granted[:, None], measurement, prediction.held)
        mean = linalg.matvec(self.inverse, held.reshape(-1, held.shape[-1]))
        return mean, self._covariance(self._delivered(prediction.moment, granted))

    def _predict(self, prior: Gaussian, held: Array, moment: Array) -> Prediction:
        expectation, root = self.filter.expect(prior[0]), linalg.root(prior[1])
        observed = linalg.matmul(self.sensors.measurement_matrix, root)
        spread = linalg.total(observed * observed) + self.sensors.variance
        return Prediction(expectation, np.sqrt(spread), root, prior, held=held, moment=moment)

    def _delivered(self, moment: Array, granted: Packets) -> Array:
        """Return Σ after the deliveries (sensors, N)."""
        n = self.plant.size
        late = np.repeat(~granted, self.sensors.size, axis=0).astype(np.float64)
        keep = np.concatenate([np.ones((n, late.shape[-1])), late])
        result = keep[:, None] * keep * moment
        noise = (1.0 - late) * self.sensors.variance.reshape(-1, 1)
        places = np.arange(n, len(keep))
        result[places, places] += noise
        return result

    def _covariance(self, moment: Array) -> Array:
        n = self.plant.size
        return linalg.congruence(self.inverse, moment[n:, n:])


def _unit_free(sensors: CensoredSensors) -> tuple[Array, Array, Array]:
    """Return R^-½ C S⁻¹ (channels, n), S (n,) that makes its columns of length 1, and √R."""
    deviation = sensors.deviation.reshape(-1)
    matrix = sensors.stacked_matrix[..., 0] / deviation[:, None]
    size = np.sqrt((matrix * matrix).sum(0))
    size = np.where(size > 0.0, size, 1.0)
    return matrix / size, size, deviation


def hold_centre(sensors: CensoredSensors, plant: LinearPlant) -> HoldCentre:
    """Return the centre of ``filter="hold"``.

    Args:
        sensors: the sensors.
        plant: the plant of the model.

    Raises:
        ConfigurationError: censored sensors, or sensors that do not determine the state.
    """
    for part in (plant, sensors):
        part.refuse_schedule("with filter='hold'")
    rank = int(np.linalg.matrix_rank(_unit_free(sensors)[0]))
    if rank < plant.size:
        raise ConfigurationError(
            f"filter = 'hold' is not allowed with measurement_matrices of rank {rank}: together "
            f"they must determine all {plant.size} states, because a held value has no model"
        )
    if not sensors.unlimited:
        raise forbidden("filter", "hold", "a held limit is no measurement", "with censored sensors")
    return HoldCentre(KalmanFilter(sensors), plant)


@dataclass(frozen=True)
class TruncatedCentre(FederatedCentre):
    r"""Kalman filter for which silence is a measurement in an interval, by moment matching.

    The centre processes the deliveries first, and then all channels of silent sensors together by
    expectation propagation: each silence stands for a Gaussian measurement that has the moments of
    the truncation, given the deliveries and the other silences. Two rounds take all channels at
    once, so the order of the sensors has no effect. With one silent channel the first has the exact
    moments.

    Equation:
        $$
        \text{silent:}\quad y\in(c-\theta,\ c+\theta),\qquad s=C P_{\setminus}C^{\mathsf T},\quad
        S=s+R,\qquad z=\frac{y-C\hat x_{\setminus}}{\sqrt S}
        $$

        $$
        \tau=\frac{1-\mathrm{var}\,z}{R+s\,\mathrm{var}\,z},\qquad
        \nu=\tau\,C\hat x_{\setminus}+\frac{\sqrt S\,\mathrm E[z]}{R+s\,\mathrm{var}\,z}
        $$

        $$
        P^{+}=\Bigl(P^{-1}+\sum\tau\,C^{\mathsf T}C\Bigr)^{-1},\qquad
        \hat x^{+}=P^{+}\Bigl(P^{-1}\hat x+\sum\nu\,C^{\mathsf T}\Bigr)
        $$

        z is a standard normal truncated to the interval (c - θ, c + θ) of
        :class:`~fusion_gym.systems.silence.Silence`, τ and ν are precision and information of the
        channel's measurement, and x̂∖ and P∖ are the estimate without that measurement. A silent
        sensor whose request the tokens would not have paid for gives no information.

    Assumes: a linear plant, Gaussian noises, uncensored sensors, the trigger of the option
    ``trigger`` with this threshold and without a min_interval.

    Source: J. Sijs and M. Lazar, "Event based state estimation with time synchronous updates",
    IEEE Trans. Automatic Control 57, 2012; T. P. Minka, "Expectation propagation for approximate
    Bayesian inference", Uncertainty in Artificial Intelligence 17, 2001.
    """

    silence: Silence

    predictable = False
    separable = False
    reads_silence = True
    traceable = False
    local_means = Centre.local_means
    variances = Centre.variances

    def predict(self, prior: Gaussian, held: Array, time: Array) -> Prediction:
        """See :class:`Centre`; ``time`` has no effect."""
        return super().predict(prior, held, time)._replace(held=held)

    def update(self, prediction: Prediction, measurement: Array, granted: Packets) -> Gaussian:
        """See :class:`Centre`."""
        mean, covariance = super().update(prediction, measurement, granted)
        silent = ~granted if prediction.possible is None else ~granted & prediction.possible
        silent = silent & (self.silence.threshold > 0.0)
        if not silent.any():
            return mean, covariance
        middle = self.silence.middle(prediction.held, prediction.expectation.value)
        shift = middle - linalg.matvec(self.sensors.measurement_matrix, mean)
        root = linalg.root(covariance)
        z, posterior = self._truncate(root, shift, silent)
        some = silent.any(0)
        mean = np.where(some, mean + linalg.matvec(root, z), mean)
        return mean, np.where(some, linalg.congruence(root, posterior), covariance)

    def _truncate(self, root: Array, shift: Array, silent: Packets) -> tuple[Array, Array]:
        """Return mean and covariance of z, x = x̂ + G z, given that measurements are silent.

        Args:
            root: G (n, n, N).
            shift: c - C x̂ (sensors, m, N).
            silent: (sensors, N).
        """
        sensors = self.sensors
        matrix = linalg.matmul(sensors.stacked_matrix, root)
        noise = sensors.variance.reshape(sensors.noise_channels, -1)
        threshold = np.repeat(self.silence.threshold, sensors.size, axis=0)
        middle, silent = shift.reshape(noise.shape[0], -1), np.repeat(silent, sensors.size, axis=0)
        precision = information = np.zeros(silent.shape)
        z, posterior = np.zeros(root.shape[1:]), linalg.identity(len(root))
        for _ in range(_ROUNDS if len(noise) > 1 else 1):
            spread = linalg.dot(linalg.matmul(matrix, posterior), matrix)
            left = np.maximum(1.0 - precision * spread, _LEAST_SHARE)
            own, variance = (linalg.matvec(matrix, z) - spread * information) / left, spread / left
            deviation = np.sqrt(variance + noise)
            first, second = self.silence.moments(threshold, middle - own, deviation, 0.0)
            rest = noise + variance * second
            precision = np.where(silent, (1.0 - second) / rest, 0.0)
            information = precision * own + np.where(silent, deviation * first / rest, 0.0)
            weighted = linalg.matmul(linalg.transpose(precision[:, None] * matrix), matrix)
            posterior = linalg.inverse(linalg.identity(len(root)) + weighted)
            z = linalg.matvec(posterior, linalg.matvec(linalg.transpose(matrix), information))
        return z, posterior


def truncated_centre(options: Any, sensors: CensoredSensors) -> TruncatedCentre:
    """Return the centre of ``filter="truncated"``.

    Args:
        options: options of the environment.
        sensors: the sensors.

    Raises:
        ConfigurationError: censored sensors, a trigger that is missing or measures several channels
            together, or a threshold that is not allowed.
    """
    if not sensors.unlimited:
        allowed = "'kalman', 'tobit' or 'adf' with censored sensors"
        raise refusal("filter", "truncated", allowed)
    silence = Silence.create(options, sensors.count, sensors.size)
    return TruncatedCentre(KalmanFilter(sensors), np.ones((sensors.count, 1)), silence)


@dataclass(frozen=True)
class Filter:
    """A row of a table of filters: its class, and the function that makes its centre.

    The docstring of ``kind`` has meaning, equation, assumption and source. ``own`` are options of
    this filter only; for other filters they are ``None``.
    """

    kind: type
    make: Callable[[Any, CensoredSensors], Centre]
    own: tuple[str, ...] = ()

    @property
    def nodes(self) -> bool:
        """Whether the filter has nodes; without nodes the options of their fusion are ``None``."""
        return issubclass(self.kind, NodeFilter)


def at_the_nodes(kind: Any) -> Filter:
    """Return the row of a node filter without options of its own."""
    return Filter(kind, lambda options, sensors: feedback_centre(options, kind(sensors)))


def classes(filters: Mapping[str, Filter]) -> dict[str, type]:
    """Return the class of each filter of a table."""
    return {name: row.kind for name, row in filters.items()}


def feedback_centre(options: Any, node: NodeFilter) -> Centre:
    """Return nodes with this filter and the options' fusion.

    Args:
        options: options of the environment.
        node: the nodes' filter.

    Raises:
        ConfigurationError: a rule that does not fit, or an option of another rule.
    """
    sensors = node.sensors.count
    kind = "federated" if options.fusion is None else options.fusion
    weights = None
    if kind != "federated":  # which minimises no trace
        weights = options.own_weights(node.sensors.measurement_matrix.shape[2])
    fusion = choose_rule(kind, STRUCTURE, sensors, options.order, weights)
    if kind == "federated":
        share = information_shares(options.information_shares, sensors)
        if isinstance(node, KalmanFilter):
            return FederatedCentre(node, share)
        return FeedbackCentre(node, share, fusion)
    if (given := options.information_shares) is not None:
        reason = "it belongs to fusion='federated'"
        raise forbidden("information_shares", given, reason, f"with fusion={kind!r}")
    return FeedbackCentre(node, np.ones((sensors, 1)), fusion)


# What every environment of the family offers; each adds its paper's own.
FILTERS = {
    "kalman": at_the_nodes(KalmanFilter),
    "adf": Filter(
        AssumedDensityFilter, lambda _, sensors: SequentialCentre(AssumedDensityFilter(sensors))
    ),
    "stochastic": Filter(
        StochasticEventFilter,
        lambda options, sensors: feedback_centre(
            options, StochasticEventFilter.create(sensors, options.stochastic_weight)
        ),
        own=("stochastic_weight",),
    ),
}
