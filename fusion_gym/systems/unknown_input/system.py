"""A plant with an unknown input, joint input-state filters, fusion without feedback.

Source: unknown_input (Y. Sun, M. Fu, J. Mao and G. Wei, "Recursive filtering of multi-rate
cyber-physical systems with unknown inputs under adaptive event-triggered mechanisms", 2023).
"""

import functools
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.core import knowledge
from fusion_gym.core.estimator import Reception, SignalValues
from fusion_gym.core.plant import AS_ASSUMED, Nature, true_noise
from fusion_gym.namespace import namespace, ndtr
from fusion_gym.systems.bases import RANGE, Deliveries, ScaledEstimator, SensorPlant, Truth
from fusion_gym.systems.linear_plant import largest_ratio
from fusion_gym.systems.unknown_input.nodes import Estimates, NodePrediction, Nodes, RunNodes
from fusion_gym.systems.unknown_input.plant import InputSensors, InputSignal, UnknownInputPlant

_IMAGINED = 32  # signals of which one is taken, where one is imagined


@dataclass(slots=True)
class UnknownInputTruth(Truth):
    """The true state of N runs at one time; the truth is [x(k); d(k - 1)].

    ``signal`` (rows, N), the memory of the input signal; a sensing is a sampling instant.
    """

    signal: Array


@dataclass(frozen=True)
class DrivenPlant(SensorPlant[UnknownInputTruth]):
    """A linear plant under an input signal, with its sensors.

    One step is one sampling instant. ``nature`` is the departure of the truth from this model.
    """

    dynamics: UnknownInputPlant
    signal: InputSignal
    sensors: InputSensors
    state_names: tuple[str, ...]
    nature: Nature = AS_ASSUMED

    @property
    def noise_channels(self) -> int:
        """Normals of one step: input, process noise, sensors."""
        return self.signal.noise_channels + super().noise_channels

    @property
    def start_channels(self) -> int:
        """Normals of a start: initial state, first measurements, signal, nature's."""
        own = self.dynamics.size + self.sensors.noise_channels
        return own + self.signal.start_channels + self.nature.channels

    def start(self, noise: Array) -> tuple[UnknownInputTruth, None]:
        """Draw the initial state, and measure it."""
        n, runs, count = self.dynamics.size, noise.shape[-1], self.sensors.noise_channels
        noise, departure = self.nature.begin(noise)
        state = self.dynamics.start(noise[:n])
        first = true_noise(departure, noise[:0], noise[n : n + count])[1]
        truth = namespace(noise).concatenate((state, np.zeros((self.dynamics.inputs, runs))))
        measurement = self.sensors.measure(state, first)
        signal = self.signal.start(noise[n + count :])
        return UnknownInputTruth(truth, measurement, departure, np.zeros(runs), signal), None

    def sense(self, state: UnknownInputTruth, noise: Array) -> UnknownInputTruth:
        """Move the plant under the input for one interval, and measure.

        Source: unknown_input, equations (2) and (4).
        """
        r, drawn = self.dynamics.noise_channels, self.signal.noise_channels
        inputs = self.signal.value(state.signal, state.time)
        departure = state.departure
        process, own = true_noise(departure, noise[drawn : drawn + r], noise[drawn + r :])
        last = state.truth[: self.dynamics.size]
        moved = self.dynamics.advance(last, inputs, process, departure)
        truth = namespace(moved, inputs).concatenate((moved, inputs))
        measurement = self.sensors.measure(moved, own)
        signal = self.signal.advance(state.signal, noise[:drawn])
        return UnknownInputTruth(truth, measurement, departure, state.time + 1.0, signal)

    @property
    def draw_channels(self) -> int | None:
        """Number of states, and the normals of ``_IMAGINED`` signals; ``None`` if it is fixed."""
        if not self.signal.start_channels:
            return None
        signal = self.signal.noise_channels + _IMAGINED * (self.signal.start_channels + 1)
        return self.dynamics.size + signal

    def draw(
        self, measurement: Array, mean: Array, covariance: Array, noise: Array, time: Array
    ) -> UnknownInputTruth:
        """Draw the signal from its law and the belief about the input that has just acted.

        Of ``_IMAGINED`` signals drawn as at a start, one is chosen in proportion to the density of
        its last value under N(mean, covariance). The rest of the truth follows that distribution,
        given this value. The draw ignores older estimates of the signal.
        """
        n, steps, runs = self.dynamics.size, self.signal.noise_channels, len(time)
        first, moving, drawn = np.split(noise, (n, n + steps))
        choice, starts = drawn[:_IMAGINED], drawn[_IMAGINED:].reshape(-1, _IMAGINED * runs)
        last = np.tile(time - 1.0, _IMAGINED)
        memories = self.signal.start(starts)
        values = self.signal.value(memories, last).reshape(-1, _IMAGINED, runs)
        apart = np.moveaxis(values - mean[n:, None], 1, 0)
        spread = covariance[n:, n:]
        # The largest of Gumbel numbers moved by log weights is a draw with these weights.
        weight = -0.5 * linalg.dot(apart, linalg.solve_vector(spread, apart))
        choices = (weight - np.log(-np.log(ndtr(choice)))).argmax(0)
        memory = memories.reshape(-1, _IMAGINED, runs)[:, choices, np.arange(runs)]
        off = apart[choices, :, np.arange(runs)].T
        cross = covariance[:n, n:]
        gained = linalg.solve(spread, linalg.transpose(cross))
        left = linalg.symmetrise(covariance[:n, :n] - linalg.matmul(cross, gained))
        moved = mean[:n] + linalg.matvec(linalg.transpose(gained), off)
        truth = np.concatenate((linalg.draw_normal(moved, left, first), mean[n:] + off))
        signal = self.signal.advance(memory, moving)
        return UnknownInputTruth(truth, measurement, None, time, signal)

    def open_loop(self, horizon: int) -> Array:
        """Return the mean squared error (n + q,) over k = 1..horizon of a prediction with d = 0."""
        return self.dynamics.open_loop(self.signal, horizon)

    def rounding(self, horizon: int) -> tuple[float, float]:
        """See :class:`Plant`."""
        dynamics, sensors = self.dynamics, self.sensors
        moments = dynamics.second_moments(self.signal, horizon, dynamics.initial_mean[:, 0])
        deviation = np.sqrt(linalg.diagonal(sensors.covariance))
        rows = sensors.measurement_matrix[..., 0] / deviation
        return largest_ratio(moments[:, : dynamics.size], rows), 0.0


@dataclass(slots=True)
class UnknownInputEstimate(Deliveries):
    """The estimates of N runs at one time.

    ``time`` (N,), sampling instants since the start · ``estimates``, the posteriors ·
    ``prediction``, the predictions.
    """

    time: Array
    estimates: Estimates
    prediction: NodePrediction | None


SIGNALS = (
    knowledge.LOCAL_VARIANCE,
    *knowledge.common_signals(
        age="sampling instants since the last delivery",
        expected_measurement="the node's expectation, with the predicted input",
        prior_mean="prediction of the fused state",
        prior_covariance="covariance of the prediction, with zero blocks between state and input",
    ),
)


@dataclass(frozen=True)
class UnknownInputEstimator(ScaledEstimator[UnknownInputEstimate]):
    """Nodes with a fusion centre, without feedback.

    The estimated quantity is [x(k); d(k - 1)]: an input becomes observable only after it has acted.
    """

    nodes: Nodes
    signals = SIGNALS
    independent_nodes = True

    @property
    def covariance_cycle(self) -> int | None:  # type: ignore[override]
        """1 if nodes predict without a delivery, so that covariances follow from the deliveries.

        They do not with the paper's filter, nor with a hold variance, whose covariance ignores the
        age of the held measurement. They refer to the filter's model of the input.
        """
        follows = isinstance(self.nodes, RunNodes) and self.nodes.hold_variance is None
        return 1 if follows else None

    @property
    def observation(self) -> tuple[knowledge.Block, ...]:
        """Blocks of the observation; a "state" is a state or an input."""
        nodes = knowledge.numbered(self.nodes.sensors.count)
        labels = (nodes, knowledge.numbered(self.nodes.sensors.size))
        new = partial(knowledge.Block, labels=labels, knowledge="own", node="own", limit=RANGE)
        innovation = "innovation of the node over its predicted deviation"
        return (
            new("whitened_innovation", innovation, self._whitened),
            new(
                "held_difference",
                "new minus held measurement over √2 noise deviations",
                lambda s: (s.measurement - s.held) / self._noise_deviation,
                constants={"√2 noise deviations": self._noise_deviation[..., 0]},
            ),
            knowledge.age_block(nodes),
            self.deviation_block(
                "local_log_deviation", "the node's predicted", self._prior_covariance, nodes
            ),
            self.deviation_block("log_deviation", "the last fused", self._last_covariance),
            self.estimate_block(
                "fused prediction over the root mean square",
                lambda s: knowledge.sensed(s.prediction).fused_mean,
            ),
        )

    def start(self, measurement: Array, announcement: None) -> UnknownInputEstimate:
        """Return equal estimates; every first measurement is known without charge."""
        runs = measurement.shape[-1]
        return UnknownInputEstimate.begin(measurement, np.zeros(runs), self.nodes.start(runs), None)

    def predict(self, state: UnknownInputEstimate) -> UnknownInputEstimate:
        """Predict at the nodes."""
        return state.later(time=state.time + 1.0, prediction=self.nodes.predict(state.estimates))

    def update(self, state: UnknownInputEstimate, reception: Reception) -> UnknownInputEstimate:
        """Update the nodes with the measurements that arrive, and fuse.

        Source: unknown_input, equations (8), (24), (25).
        """
        knowledge.sensed(state.prediction)
        after = state.after(reception.arrived)
        estimates = self.nodes.update(after, reception.arrived)
        return replace(after, estimates=estimates)

    def read(self, state: UnknownInputEstimate, failure: Array | None = None) -> SignalValues:
        """Return the signals of ``SIGNALS``."""
        prediction, n = knowledge.sensed(state.prediction), self.nodes.model.size
        predict = self.nodes.model.predict_covariance

        @functools.cache
        def variances() -> tuple[Array, Array]:
            return self.nodes.variances(state, self.state_weights)

        return {
            **super().read(state, failure),
            "innovation": lambda: state.measurement - prediction.expected,
            "expected_measurement": prediction.expected,
            "innovation_deviation": lambda: self._deviation(state),
            "prior_mean": prediction.fused_mean[:n],
            "prior_covariance": lambda: predict(self._last_covariance(state))[:n, :n],
            "silent_variance": lambda: variances()[0],
            "variance_reduction": lambda: variances()[1],
            "local_variance": lambda: linalg.trace(self._prior_covariance(state)[:, :n, :n]),
        }

    def mean(self, state: UnknownInputEstimate) -> Array:
        """Return the centre's mean (n + q, N)."""
        return state.estimates.fused_mean

    def covariance(self, state: UnknownInputEstimate) -> Array:
        """Return the centre's covariance (n + q, n + q, N)."""
        covariance = self.nodes.fused_covariance(state.estimates, state.time)
        return _lanes(covariance, len(state.time))

    def local_means(self, state: UnknownInputEstimate) -> Array:
        """Return the nodes' posterior means (sensors, n + q, N)."""
        return state.estimates.mean

    def _deviation(self, state: UnknownInputEstimate) -> Array:
        """Return the innovation's deviation (l, m, N)."""
        n, sensors, prior = self.nodes.model.size, self.nodes.sensors, self._prior_covariance(state)
        spread = linalg.matmul(sensors.measurement_matrix, prior[:, :n, :n])
        variance = spread[..., 0, :] * sensors.measurement_matrix[..., 0, :]
        for column in range(1, n):
            variance += spread[..., column, :] * sensors.measurement_matrix[..., column, :]
        variance += linalg.diagonal(sensors.covariance)
        return variance**0.5

    @functools.cached_property
    def _noise_deviation(self) -> Array:
        """√2 deviations of the measurement noise, (l, m, 1)."""
        return np.sqrt(2.0 * linalg.diagonal(self.nodes.sensors.covariance))

    def _whitened(self, state: UnknownInputEstimate) -> Array:
        expected = knowledge.sensed(state.prediction).expected
        return (state.measurement - expected) / self._deviation(state)

    def _prior_covariance(self, state: UnknownInputEstimate) -> Array:
        """Return the nodes' predicted covariances (l, s, s, N)."""
        prior = self.nodes.prior_covariance(knowledge.sensed(state.prediction), state.time)
        return _lanes(prior, len(state.time))

    def _last_covariance(self, state: UnknownInputEstimate) -> Array:
        """Return the centre's covariance (s, s, N) of one instant before."""
        before = self.nodes.fused_covariance(state.estimates, state.time - 1.0)
        return _lanes(before, len(state.time))


def _lanes(value: Array, runs: int) -> Array:
    """Broadcast one column for all runs, or one for each, to (..., runs)."""
    return namespace(value).broadcast_to(value, (*value.shape[:-1], runs))
