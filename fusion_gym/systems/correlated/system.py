"""Correlated noises known by bounds, robust local filters, sequential fusion without feedback.

Source: adaptive_innovation (K. Xu, X. Li, J. Wang and Y. Gao, "Robust sequential fusion estimation
based on adaptive innovation event-triggered mechanism for uncertain networked systems", 2022).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.core import knowledge
from fusion_gym.core.estimator import Reception, SignalValues
from fusion_gym.core.plant import AS_ASSUMED, Nature, true_noise
from fusion_gym.fusion.intersection import SequentialIntersection
from fusion_gym.fusion.rules import FusionRule
from fusion_gym.fusion.several import CovarianceIntersection
from fusion_gym.namespace import namespace, ndtr, set_at, update_at
from fusion_gym.systems.bases import RANGE, Deliveries, ScaledEstimator, SensorPlant, Truth
from fusion_gym.systems.correlated.filters import (
    CorrelatedSensors,
    JointErrorCovariance,
    RobustKalmanFilter,
    RobustOutcomes,
)
from fusion_gym.systems.linear_plant import LinearPlant, largest_ratio
from fusion_gym.systems.solvable import BoundingEstimator
from fusion_gym.validation import refusal

_ALL = slice(None)
RANDOM_SCALE = (0.4, 1.0)  # range of an episode's noise scale where it is drawn


@dataclass(slots=True)
class CorrelatedTrackingTruth(Truth):
    """The true state of N runs at one time, with ``scale`` (N,), actual variances over bounds."""

    scale: Array


@dataclass(frozen=True)
class CorrelatedTrackingPlant(SensorPlant[CorrelatedTrackingTruth]):
    """A linear plant with sensors that share its noise.

    ``dynamics.process_factor`` is Γ Q^½, so that plant and sensors use the same normals.
    ``noise_scale`` is the ratio of actual variances to bounds; ``None`` draws it for each episode
    from ``RANDOM_SCALE``. ``nature`` is the departure of the truth from this model.
    """

    dynamics: LinearPlant
    sensors: CorrelatedSensors
    noise_scale: float | None
    state_names: tuple[str, ...]
    nature: Nature = AS_ASSUMED

    @property
    def start_channels(self) -> int:
        """Normals of a start: the state's deviation, the noise scale, nature's."""
        return self.dynamics.initial_factor.shape[1] + 1 + self.nature.channels

    def start(self, noise: Array) -> tuple[CorrelatedTrackingTruth, None]:
        """Draw the initial state; nothing has been measured."""
        noise, departure = self.nature.begin(noise)
        scale = self._scale(noise[-1])
        truth = self.dynamics.start(self.dynamics.initial_mean, scale**0.5 * noise[:-1])
        nothing = np.full((self.sensors.count, self.sensors.size, noise.shape[-1]), np.nan)
        time = np.zeros(noise.shape[-1])
        return CorrelatedTrackingTruth(truth, nothing, departure, time, scale), None

    def sense(
        self, state: CorrelatedTrackingTruth, noise: Array, control: Array | None = None
    ) -> CorrelatedTrackingTruth:
        """Move the plant, and measure with the same noise.

        Source: adaptive_innovation, equations (1)-(3).
        """
        actual, r = state.scale**0.5 * noise, self.dynamics.noise_channels
        process, own = true_noise(state.departure, actual[:r], actual[r:])
        moving, departure = self.dynamics.at(state.time), state.departure
        truth = moving.advance(state.truth, process, departure, control)
        time = state.time + 1.0
        measurement = self.sensors.at(time).measure(truth, process, own)
        return replace(state, truth=truth, measurement=measurement, time=time)

    @property
    def draw_channels(self) -> int:
        """Number of states, and one for the noise scale."""
        return self.dynamics.size + 1

    def draw(
        self, measurement: Array, mean: Array, covariance: Array, noise: Array, time: Array
    ) -> CorrelatedTrackingTruth:
        """Draw the noise scale from its law, and the truth from that share of the covariance."""
        scale = self._scale(noise[-1])
        truth = linalg.draw_normal(mean, scale * covariance, noise[:-1])
        return CorrelatedTrackingTruth(truth, measurement, None, time, scale)

    def rounding(self, horizon: int) -> tuple[float, float]:
        """See :class:`Plant`."""
        every = self.sensors.each_step
        rows = np.moveaxis(every.measurement_matrix / every.deviation[:, :, None], -1, 0)
        return largest_ratio(self.dynamics.second_moments(horizon), rows), 0.0

    def _scale(self, noise: Array) -> Array:
        """Return noise scales (N,) from standard normals (N,)."""
        if self.noise_scale is not None:
            return np.full(noise.shape, self.noise_scale)
        low, high = RANDOM_SCALE
        return low + (high - low) * ndtr(noise)


@dataclass(slots=True)
class CorrelatedTrackingEstimate(Deliveries):
    """The estimates of N runs at one time; n states, l sensors, m channels.

    Estimate 0 is the fused one and estimate i is node i's. ``time`` (N,), the step in the episode ·
    ``prior_mean`` (l + 1, n, N),
    ``prior_covariance`` (l + 1, n, n, N), predictions · ``expected`` (l, m, N) and ``outcomes`` at
    the nodes · ``means`` (l + 1, n, N), ``covariances`` (l + 1, n, n, N), posteriors · ``joint``
    (l + 1, l + 1, n, n, N), the bound of the errors' covariances, if tracked.
    """

    time: Array
    prior_mean: Array
    prior_covariance: Array
    expected: Array
    outcomes: RobustOutcomes | None
    means: Array
    covariances: Array
    joint: Array | None


SIGNALS = (
    *knowledge.common_signals(prior_covariance="conservative covariance of the prediction"),
    knowledge.LOCAL_VARIANCE,
)


@dataclass(frozen=True)
class CorrelatedTrackingEstimator(
    ScaledEstimator[CorrelatedTrackingEstimate], BoundingEstimator[CorrelatedTrackingEstimate]
):
    """Robust local filters, and a fusion rule without feedback.

    ``joint`` tracks the covariances of the errors, of which the actual ones are the share
    ``noise_scale`` in the mean.
    """

    model: LinearPlant
    filter: RobustKalmanFilter
    fusion: FusionRule
    noise_scale: float
    joint: JointErrorCovariance | None = None
    signals = SIGNALS
    independent_nodes = True

    @property
    def covariance_fields(self) -> tuple[str, ...]:  # type: ignore[override]
        """See :class:`Estimator`; with a schedule runs at different steps differ.

        Covariance intersection of several searches in each run.
        """
        if self.covariance_cycle is None or isinstance(self.fusion, CovarianceIntersection):
            return ()
        return "prior_covariance", "covariances", "joint"

    @property
    def covariance_cycle(self) -> int | None:  # type: ignore[override]
        """See :class:`Estimator`; actual covariances need constant matrices."""
        return 1 if self.model.period == self.filter.sensors.period == 1 else None

    @property
    def observation(self) -> tuple[knowledge.Block, ...]:
        """Blocks of the observation."""
        nodes = knowledge.numbered(self.filter.sensors.count)
        block = partial(knowledge.Block, limit=RANGE)
        components = (nodes, knowledge.numbered(self.filter.sensors.size))
        innovation = "innovation of the node over its predicted deviation"
        return (
            block("whitened_innovation", innovation, self._whitened, components, "own", "own"),
            block(
                "fused_innovation",
                "innovation of the fused prediction over its predicted deviation",
                self._fused_innovation,
                components,
                "scheduler",
            ),
            knowledge.age_block(nodes),
            self.deviation_block(
                "local_log_deviation",
                "the node's predicted",
                lambda s: s.prior_covariance[1:],
                nodes,
            ),
            self.deviation_block(
                "log_deviation", "the fused predicted", lambda s: s.prior_covariance[0]
            ),
            self.estimate_block(
                "fused prediction over the state's root mean square", lambda s: s.prior_mean[0]
            ),
        )

    def start(self, measurement: Array, announcement: None) -> CorrelatedTrackingEstimate:
        """Return equal estimates; nothing has been measured."""
        nodes, n, runs = self.filter.sensors.count, self.model.size, measurement.shape[-1]
        mean = np.broadcast_to(self.model.initial_mean, (nodes + 1, n, runs)).copy()
        covariance = np.broadcast_to(self.model.initial_covariance, (nodes + 1, n, n, runs)).copy()
        expected = self.filter.expect(mean[1:])
        joint = None if self.joint is None else self.joint.start(runs)
        return CorrelatedTrackingEstimate.begin(
            expected, np.zeros(runs), mean, covariance, expected, None, mean, covariance, joint
        )

    def predict(
        self, state: CorrelatedTrackingEstimate, control: Array | None = None
    ) -> CorrelatedTrackingEstimate:
        """Predict all estimates.

        Source: adaptive_innovation, equations (12), (40), (52).
        """
        time = state.time + 1.0
        model, filters = self.model.at(state.time), self._filters(time)
        prior_mean, prior_covariance = model.predict(state.means, state.covariances, control)
        joint = state.joint
        if self.joint is not None and joint is not None:
            joint = self.joint.predict(joint)
        return state.later(
            time=time,
            prior_mean=prior_mean,
            prior_covariance=prior_covariance,
            expected=filters.expect(prior_mean[1:]),
            outcomes=filters.outcomes(prior_covariance[1:]),
            joint=joint,
        )

    def update(
        self, state: CorrelatedTrackingEstimate, reception: Reception
    ) -> CorrelatedTrackingEstimate:
        """Update the nodes, and fuse the centre's prediction with their estimates.

        Source: adaptive_innovation, equations (12), (37)-(41) or (47)-(53).
        """
        outcomes, arrived = knowledge.sensed(state.outcomes), reception.arrived
        grant, xp, nodes = arrived[:, None], namespace(arrived), slice(1, None)
        correction = linalg.matvec(outcomes.gain, state.measurement - state.expected)
        correction = xp.where(grant, correction, 0.0)
        mean = update_at(np.add, state.prior_mean.copy(), (..., nodes, _ALL, _ALL), correction)
        prior = state.prior_covariance
        own = xp.where(grant[:, None], outcomes.delivered_covariance, prior[1:])
        covariance = xp.concatenate((prior[:1], own))
        active = xp.concatenate((xp.ones_like(arrived[:1]), arrived))  # and the prediction
        fused = self.fusion.fuse(mean, covariance, active)
        mean = set_at(mean, (..., 0, _ALL, _ALL), fused.mean)
        covariance = set_at(covariance, (..., 0, _ALL, _ALL, _ALL), fused.covariance)
        joint = state.joint
        if self.joint is not None and joint is not None:
            joint = self.joint.update(joint, outcomes.gain, arrived)
            joint = self.joint.fuse(joint, fused.gains)
        return state.after(arrived, means=mean, covariances=covariance, joint=joint)

    def read(self, state: CorrelatedTrackingEstimate, failure: Array | None = None) -> SignalValues:
        """Return the signals of ``SIGNALS``."""
        outcomes = knowledge.sensed(state.outcomes)
        return {
            **super().read(state, failure),
            "innovation": lambda: state.measurement - state.expected,
            "expected_measurement": state.expected,
            "innovation_deviation": lambda: _deviation(outcomes.innovation_covariance),
            "prior_mean": state.prior_mean[0],
            "prior_covariance": state.prior_covariance[0],
            "silent_variance": lambda: self.trace(state.prior_covariance[0]),
            "variance_reduction": lambda: self._variance_reduction(state),
            "local_variance": lambda: linalg.trace(state.prior_covariance[1:]),
        }

    def single_deliveries(self, state: CorrelatedTrackingEstimate) -> tuple[Array, Array]:
        """See :class:`Estimator`; all sensors' runs are fused at once."""
        outcomes, count = knowledge.sensed(state.outcomes), len(state.age)
        correction = linalg.matvec(outcomes.gain, state.measurement - state.expected)
        means = state.prior_mean[1:] + correction, state.prior_mean[0]
        covariances = outcomes.delivered_covariance, state.prior_covariance[0]
        xp = namespace(correction)
        pairs = (
            xp.stack((xp.tile(prior, count), xp.concatenate([*posterior], axis=-1)))
            for posterior, prior in (means, covariances)
        )
        fused = self._pair.fuse(*pairs)
        mean, covariance = (
            xp.stack(xp.split(values, count, axis=-1)) for values in (fused.mean, fused.covariance)
        )
        return mean, covariance

    def adopt(
        self,
        state: CorrelatedTrackingEstimate,
        mean: Array,
        covariance: Array,
        runs: NDArray[np.bool_],
    ) -> CorrelatedTrackingEstimate:
        """Replace the fused estimate in ``runs`` (N,), not the nodes'."""
        xp, before = namespace(runs), (state.means, state.covariances)
        parts = zip((mean, covariance), before, strict=True)
        means, covariances = (
            xp.concatenate((xp.where(runs, new, old[0])[None], old[1:])) for new, old in parts
        )
        return replace(state, means=means, covariances=covariances)

    def mean(self, state: CorrelatedTrackingEstimate) -> Array:
        """Return the centre's mean (n, N)."""
        return state.means[0]

    def covariance(self, state: CorrelatedTrackingEstimate) -> Array:
        """Return the centre's conservative covariance (n, n, N)."""
        return state.covariances[0]

    def local_means(self, state: CorrelatedTrackingEstimate) -> Array:
        """Return the nodes' posterior means (sensors, n, N)."""
        return state.means[1:]

    def select_sensor(self, sensor: int) -> CorrelatedTrackingEstimator:
        """See :class:`Estimator`; the centre joins its prediction with one node's estimate."""
        own = RobustKalmanFilter(self.filter.sensors.select(sensor))
        return replace(self, filter=own, fusion=self._pair, joint=None)

    def with_actual_covariance(self) -> CorrelatedTrackingEstimator:
        """Return the same estimator with tracked covariances of the errors."""
        return replace(self, joint=JointErrorCovariance.create(self.model, self.filter.sensors))

    def actual_covariance(self, state: CorrelatedTrackingEstimate) -> Array:
        """Return the actual covariances (l + 1, l + 1, n, n, N); estimate 0 is the fused one.

        Gains and fusion weights come from the bounds, so they are proportional to the noise scale.
        Where it is drawn they are the mean over its draws.

        Args:
            state: a state after :meth:`update`.

        Raises:
            ConfigurationError: the estimator does not track them.
        """
        if state.joint is None:
            raise refusal("track_actual", False, "True for actual covariances", "here")
        return self.noise_scale * state.joint

    def error_covariance(self, state: CorrelatedTrackingEstimate) -> Array:
        """Return the actual covariance (n, n, N) of the fused error."""
        return self.actual_covariance(state)[0, 0]

    def _whitened(self, state: CorrelatedTrackingEstimate) -> Array:
        deviation = _deviation(knowledge.sensed(state.outcomes).innovation_covariance)
        return (state.measurement - state.expected) / deviation

    def _filters(self, time: Array) -> RobustKalmanFilter:
        """Return the filters at steps (N,)."""
        return RobustKalmanFilter(self.filter.sensors.at(time))

    def _fused_innovation(self, state: CorrelatedTrackingEstimate) -> Array:
        filters = self._filters(state.time)
        deviation = _deviation(filters.innovation_covariance(state.prior_covariance[0]))
        return (state.measurement - filters.expect(state.prior_mean[0])) / deviation

    def _variance_reduction(self, state: CorrelatedTrackingEstimate) -> Array:
        reduced = [self.trace(covariance) for covariance in self.single_deliveries(state)[1]]
        return self.trace(state.prior_covariance[0]) - namespace(reduced[0]).stack(reduced)

    @property
    def _pair(self) -> FusionRule:
        """The rule for the prediction and one node's estimate."""
        if isinstance(self.fusion, SequentialIntersection):
            return replace(self.fusion, order=None)
        return self.fusion


def _deviation(covariance: Array) -> Array:
    """Square roots of the diagonals: (..., m, m, N) to (..., m, N)."""
    return linalg.diagonal(covariance) ** 0.5
