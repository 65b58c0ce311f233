"""The true plant with fading sensors; nodes with filters, and fusion of the centre's copies.

Source: markov_jump (event-triggered distributed fusion estimation for asynchronous Markov jump
systems with correlated noises and fading measurements).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.core import knowledge
from fusion_gym.core.estimator import Reception, SignalValues
from fusion_gym.core.plant import AS_ASSUMED, Nature, true_noise
from fusion_gym.fusion.rules import FusionRule, MatrixWeightedFusion
from fusion_gym.namespace import namespace, take
from fusion_gym.systems.bases import RANGE, Deliveries, ScaledEstimator, SensorPlant, Truth
from fusion_gym.systems.markov_jump.linear_minimum_variance import (
    AugmentedModel,
    JointPrediction,
    LagCovariances,
    LagRecursion,
    LocalFilters,
    Times,
)
from fusion_gym.systems.markov_jump.plant import FadingSensors, MarkovJumpPlant, Modes, draw_mode

_FLOOR = 1e-9  # least deviation of a lag, relative to open loop: it is zero right after a packet
_PER_SENSOR = "(sensors, N)"


@dataclass(slots=True)
class MarkovJumpTruth(Truth):
    """The true state of N runs at one time k, measured as if all sensors sampled.

    ``time`` k (N,) · ``mode`` θ (N,) · ``process_noise`` w(k) (r, N), which moves the plant next.
    """

    mode: Modes
    process_noise: Array


@dataclass(frozen=True)
class FadingPlant(SensorPlant[MarkovJumpTruth]):
    """A Markov jump plant with fading sensors, and the augmented model of its moments.

    ``nature`` is the departure of the truth from this model.
    """

    dynamics: MarkovJumpPlant
    sensors: FadingSensors
    model: AugmentedModel
    state_names: tuple[str, ...]
    nature: Nature = AS_ASSUMED

    @property
    def noise_channels(self) -> int:
        """Normals of one step: process noise, mode, sensors."""
        return super().noise_channels + 1

    @property
    def start_channels(self) -> int:
        """Normals of a start: state, mode, first process noise, nature's."""
        return self.draw_channels + self.nature.channels

    def start(self, noise: Array) -> tuple[MarkovJumpTruth, None]:
        """Draw the initial state; nothing is measured."""
        noise, departure = self.nature.begin(noise)
        first, runs = self.dynamics.size + 1, noise.shape[-1]
        truth, mode = self.dynamics.start(noise[:first])
        process = true_noise(departure, noise[first:], noise[:0])[0]
        drawn = self.dynamics.process_noise(process)
        time, nothing = np.zeros(runs, np.int64), np.full((self.sensors.count, 1, runs), np.nan)
        return MarkovJumpTruth(truth, nothing, departure, time, mode, drawn), None

    def sense(self, state: MarkovJumpTruth, noise: Array) -> MarkovJumpTruth:
        """Move the plant, and measure with all sensors.

        The state's process noise is the actual one.

        Source: markov_jump, equations (3), (4).
        """
        plant, sensors, moving = self.dynamics, self.sensors, self.dynamics.noise_channels
        xp = namespace(noise)
        fading, own = xp.split(noise[moving + 1 :], (sensors.count,))
        process, own = true_noise(state.departure, noise[:moving], own)
        following = plant.advance(state.truth, state.mode, state.process_noise, state.departure)
        jumped = plant.jump(state.mode, noise[moving])
        drawn = plant.process_noise(process)
        measurement = sensors.measure(following, jumped, drawn, xp.concatenate((fading, own)))
        return MarkovJumpTruth(
            following, measurement[:, None], state.departure, state.time + 1, jumped, drawn
        )

    @property
    def draw_channels(self) -> int:
        """Normals of truth, mode and process noise."""
        return self.dynamics.size + 1 + self.dynamics.noise_channels

    def draw(
        self, measurement: Array, mean: Array, covariance: Array, noise: Array, time: Array
    ) -> MarkovJumpTruth:
        """Draw the truth from N(mean, covariance), the mode and the process noise from their laws.

        The draws of mode and process noise do not use the measurements.
        """
        plant, n, times = self.dynamics, self.dynamics.size, time.astype(np.int64)
        law = np.empty((plant.modes, len(times)))
        for each in np.unique(times):
            moved = np.linalg.matrix_power(plant.mode_transition, each)
            law[:, times == each] = (plant.initial_probabilities @ moved)[:, None]
        truth = linalg.draw_normal(mean, covariance, noise[:n])
        mode = draw_mode(np.cumsum(law, 0)[:-1], noise[n])
        process_noise = plant.process_noise(noise[n + 1 :])
        return MarkovJumpTruth(truth, measurement, None, times, mode, process_noise)

    def open_loop(self, horizon: int) -> Array:
        """Return the mean error variance (n,) over t = 1..horizon without any delivery."""
        return self.model.scales(horizon)[0]


@dataclass(slots=True)
class MarkovJumpEstimate(Deliveries):
    """The estimates of N runs at one time k; n states, a = modes · n, r noises, l sensors.

    ``measurement`` (l, 1, N), NaN, and ``innovation`` ε (l, N), zero, where a sensor does not
    sample · ``held`` (l, n, N), the last delivered estimates · ``time`` k (N,) · ``node_mean``
    ζ̂(k|k) (l, a, N), ``node_noise`` ŵ (l, r, N), the nodes' · ``copy_mean`` (l, a, N),
    ``copy_noise`` (l, r, N), the centre's: a prediction until delivery · ``lags`` and
    ``prediction``, covariances · ``prior_mean`` (n, N), ``prior_covariance`` (n, n, N), fused
    without a transmission · ``mean`` (n, N), ``covariance`` (n, n, N), fused after the delivery.
    """

    time: Times
    innovation: Array
    node_mean: Array
    node_noise: Array
    copy_mean: Array
    copy_noise: Array
    lags: LagCovariances
    prediction: JointPrediction | None
    prior_mean: Array
    prior_covariance: Array
    mean: Array
    covariance: Array


# What both estimators of the family offer beside the common signals.
OF_FAMILY = (
    knowledge.Signal(
        "centre_variance", "centre", "(N,)", "plain trace of the covariance without a delivery"
    ),
    knowledge.Signal(
        "greedy_variance",
        "centre",
        _PER_SENSOR,
        "trace if only the sensors before this one in the greedy order transmit",
    ),
    knowledge.Signal(
        "sampled", "centre", _PER_SENSOR, "whether the sensor samples at this step", "own"
    ),
)
SIGNALS = (
    *knowledge.common_signals(
        "(sensors, n, N)",
        measurement="the node's new estimate",
        innovation="the node's new estimate minus the centre's copy",
        held="the last delivered estimate",
        expected_measurement="the centre's copy, predicted",
    ),
    *OF_FAMILY,
    knowledge.LOCAL_VARIANCE,
)


def sampling_blocks(sensors: FadingSensors) -> tuple[knowledge.Block, knowledge.Block]:
    """Return the blocks of the observation with the sensors' sampling phases."""
    own = partial(knowledge.Block, labels=(knowledge.numbered(sensors.count),), node="own")
    since = "steps since the sensor's last sampling time over its period"
    return (
        own(
            "sampled", "whether the sensor samples at this step", lambda s: sensors.sampled(s.time)
        ),
        own("phase", since, lambda s: (s.time % sensors.period) / sensors.period),
    )


@dataclass(frozen=True)
class MarkovJumpEstimator(ScaledEstimator[MarkovJumpEstimate]):
    """The nodes' filters, the joint recursion of the errors and a fusion rule."""

    model: AugmentedModel
    filters: LocalFilters
    recursion: LagRecursion
    fusion: FusionRule
    signals = SIGNALS
    independent_nodes = True

    @property
    def covariance_cycle(self) -> int:  # type: ignore[override]
        """Steps after which the sampling repeats; covariances do not depend on the data."""
        return self.filters.period

    @property
    def observation(self) -> tuple[knowledge.Block, ...]:
        """Blocks of the observation."""
        nodes = knowledge.numbered(self.model.sensors.count)
        own, every = partial(knowledge.Block, node="own", limit=RANGE), (nodes, self.state_names)
        difference = "node's estimate minus the centre's copy, over its deviation"
        innovation = "node's innovation over its deviation, 0 without a sample"
        local = "logarithm of the root of the node's trace over the open-loop trace"
        return (
            own("whitened_difference", difference, self._difference, every, "own"),
            own("whitened_innovation", innovation, self._whitened_innovation, (nodes,), "own"),
            *sampling_blocks(self.model.sensors),
            knowledge.age_block(nodes),
            own(
                "local_log_deviation",
                local,
                self._local_log_deviation,
                (nodes,),
                constants={"open-loop trace": self.reference.sum()},
            ),
            self.deviation_block(
                "copy_log_deviation", "the copy's predicted", self._copy_covariance, nodes
            ),
            self.deviation_block("log_deviation", "the silent fused", lambda s: s.prior_covariance),
            self.estimate_block(
                "fused estimate without a transmission over the root mean square",
                lambda s: s.prior_mean,
            ),
        )

    def start(self, measurement: Array, announcement: None) -> MarkovJumpEstimate:
        """Return the mean of ζ(0) as all estimates, without lags; nothing is measured."""
        plant, runs = self.model.plant, measurement.shape[-1]
        n, count, first = plant.size, self.model.sensors.count, self.model.initial_mean
        mean = np.broadcast_to(first[:, None], (count, len(first), runs)).copy()
        noise_mean = np.zeros((count, plant.process_gain.shape[1], runs))
        state_mean = np.broadcast_to(plant.initial_mean, (n, runs)).copy()
        covariance = np.broadcast_to(plant.initial_covariance, (n, n, runs)).copy()
        nodes, fused = (mean, noise_mean), (state_mean, covariance)
        time, nothing = np.zeros(runs, dtype=np.int64), np.zeros((count, runs))
        held, lags = self._collapse(mean), self.recursion.start(runs)
        return MarkovJumpEstimate(
            measurement, held, nothing, time, nothing, *nodes, *nodes, lags, None, *fused, *fused
        )

    def predict(self, state: MarkovJumpEstimate) -> MarkovJumpEstimate:
        """Predict nodes and copies, and fuse the copies without a transmission.

        Source: markov_jump, equations (14)-(16), (36)-(39).
        """
        time = state.time + 1
        before, place = self.filters.at(state.time), self.filters.at(time)
        copy_mean = self.filters.predict(state.copy_mean, state.copy_noise, before)
        lags = self.recursion.predict(state.lags, state.age == 0.0, before)
        prediction = self.recursion.prediction(lags, place)
        silence = np.zeros(state.age.shape, dtype=np.bool_)
        silent = self.fusion.fuse(self._collapse(copy_mean), prediction.joint(silence))
        return state.later(
            time=time,
            innovation=np.zeros(state.innovation.shape),
            node_mean=self.filters.predict(state.node_mean, state.node_noise, before),
            node_noise=np.zeros(state.node_noise.shape),
            copy_mean=copy_mean,
            copy_noise=np.zeros(state.copy_noise.shape),
            lags=lags,
            prediction=prediction,
            prior_mean=silent.mean,
            prior_covariance=silent.covariance,
        )

    def observe(self, state: MarkovJumpEstimate, measurement: Array) -> MarkovJumpEstimate:
        """Update the nodes that sample with their own measurements.

        Source: markov_jump, equations (12)-(22).
        """
        sampled, place = self.model.sensors.sampled(state.time), self.filters.at(state.time)
        mean, noise_mean, innovation = self.filters.update(
            state.node_mean, measurement[:, 0], sampled, place
        )
        seen = namespace(sampled, measurement).where(sampled[:, None], measurement, np.nan)
        return replace(
            state, measurement=seen, innovation=innovation, node_mean=mean, node_noise=noise_mean
        )

    def update(self, state: MarkovJumpEstimate, reception: Reception) -> MarkovJumpEstimate:
        """Replace the centre's copies by the estimates that arrive, and fuse the copies.

        Source: markov_jump, equations (34)-(39), (55)-(57).
        """
        arrived, prediction = reception.arrived, knowledge.sensed(state.prediction)
        grant, xp = arrived[:, None], namespace(arrived)
        copy_mean = xp.where(grant, state.node_mean, state.copy_mean)
        fused = self.fusion.fuse(self._collapse(copy_mean), prediction.joint(arrived))
        return state.after(
            arrived,
            self._collapse(state.node_mean),
            copy_mean=copy_mean,
            copy_noise=xp.where(grant, state.node_noise, state.copy_noise),
            mean=fused.mean,
            covariance=fused.covariance,
        )

    def read(self, state: MarkovJumpEstimate, failure: Array | None = None) -> SignalValues:
        """Return the signals of ``SIGNALS``."""
        prediction = knowledge.sensed(state.prediction)
        place = self.filters.at(state.time)
        return {
            **super().read(state, failure),
            "measurement": lambda: self._collapse(state.node_mean),
            "innovation": lambda: self._collapse(state.node_mean - state.copy_mean),
            "expected_measurement": lambda: self._collapse(state.copy_mean),
            "innovation_deviation": lambda: self._lag_deviation(prediction),
            "silent_variance": lambda: self.trace(state.prior_covariance),
            "variance_reduction": lambda: self._variance_reduction(state, prediction),
            "centre_variance": lambda: linalg.trace(state.prior_covariance),
            "greedy_variance": lambda: self._greedy_variance(state, prediction),
            "local_variance": lambda: take(self.recursion.local_trace, place),
            "sampled": lambda: self.model.sensors.sampled(state.time),
        }

    def local_means(self, state: MarkovJumpEstimate) -> Array:
        """Return the nodes' estimates (sensors, n, N)."""
        return self._collapse(state.node_mean)

    def full_rate_traces(self) -> Array:
        """Return the trace of the optimal fused covariance over one period at full rate, (period,).

        It is tr P_d of (33) in the steady state, with every node sending at every step.
        """
        local = self.recursion.local[..., -self.filters.period :]
        means = np.zeros((self.model.sensors.count, self.model.plant.size, self.filters.period))
        return linalg.trace(MatrixWeightedFusion().fuse(means, local).covariance)

    def _collapse(self, mean: Array) -> Array:
        """Return x̂ = Σ_m ζ̂_m (l, n, N) of ζ̂ (l, a, N), equation (44).

        Source: markov_jump, equation (44).
        """
        nodes, _, runs = mean.shape
        return linalg.total(mean.reshape(nodes, -1, self.model.plant.size, runs), 1)

    def _difference(self, state: MarkovJumpEstimate) -> Array:
        lag = self._collapse(state.node_mean - state.copy_mean)
        return lag / self._lag_deviation(knowledge.sensed(state.prediction))

    def _whitened_innovation(self, state: MarkovJumpEstimate) -> Array:
        nodes, place = np.arange(self.model.sensors.count), self.filters.at(state.time)
        variance = take(self.filters.innovation_covariance[nodes, nodes], place)
        return state.innovation / namespace(variance).sqrt(variance)

    def _local_log_deviation(self, state: MarkovJumpEstimate) -> Array:
        trace = take(self.recursion.local_trace, self.filters.at(state.time))[:, None, None]
        return knowledge.log_deviation(trace, self.reference.sum(keepdims=True))[:, 0]

    def _copy_covariance(self, state: MarkovJumpEstimate) -> Array:
        prediction, nodes = knowledge.sensed(state.prediction), np.arange(self.model.sensors.count)
        return prediction.local[nodes, nodes] + prediction.lag[nodes, nodes]

    def _lag_deviation(self, prediction: JointPrediction) -> Array:
        """Return the predicted deviations (l, n, N) of node minus copy, above zero."""
        nodes = np.arange(self.model.sensors.count)
        variance, xp = linalg.diagonal(prediction.lag[nodes, nodes]), namespace(prediction.lag)
        least = (_FLOOR * _FLOOR) * self.reference[:, None]
        return xp.sqrt(xp.maximum(variance, least))

    def _variance_reduction(self, state: MarkovJumpEstimate, prediction: JointPrediction) -> Array:
        silent, silence = self.trace(state.prior_covariance), np.zeros(state.age.shape, np.bool_)
        each = self._covariances_after_next(state, prediction, silence)
        return namespace(silent).stack([silent - self.trace(one) for one in each])

    def _greedy_variance(self, state: MarkovJumpEstimate, prediction: JointPrediction) -> Array:
        """Return the trace as sensors join in the order of the largest reduction."""
        sent: Any = np.zeros(state.age.shape, dtype=np.bool_)
        sensors, result = np.arange(len(sent))[:, None], np.zeros(sent.shape)
        trace, xp = linalg.trace(state.prior_covariance), namespace(state.prior_covariance)
        for _ in range(self.model.sensors.count):
            each = self._covariances_after_next(state, prediction, sent)
            traces = xp.stack([linalg.trace(covariance) for covariance in each])
            options = xp.where(sent, np.inf, traces)
            selected = sensors == options.argmin(0)
            result = xp.where(selected, trace, result)
            trace, sent = options.min(0), sent | selected
        return result

    def _covariances_after_next(
        self, state: MarkovJumpEstimate, prediction: JointPrediction, sent: NDArray[np.bool_]
    ) -> list[Array]:
        """Return fused covariances (n, n, N) if ``sent`` (l, N) and one more sensor transmit."""
        means = self._collapse(state.copy_mean)
        several = (sent | own[:, None] for own in np.eye(len(sent), dtype=np.bool_))
        return [self.fusion.fuse(means, prediction.joint(more)).covariance for more in several]
