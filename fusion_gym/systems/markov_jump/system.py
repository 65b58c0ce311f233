"""Markov jump plant, nodes with filters, a link from node to centre, fusion of the centre's copies.

Source: markov_jump (event-triggered distributed fusion estimation for asynchronous Markov jump
systems with correlated noises and fading measurements).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.core.nature import AS_ASSUMED, Nature
from fusion_gym.core.system import Block, SignalArray, age_block, log_deviation, numbered, sensed
from fusion_gym.fusion.rules import FusionRule, MatrixWeightedFusion
from fusion_gym.systems.markov_jump.lag_errors import JointPrediction, LagRecursion
from fusion_gym.systems.markov_jump.linear_minimum_variance import AugmentedModel, LocalFilters
from fusion_gym.systems.markov_jump.plant import MarkovJumpPlant
from fusion_gym.systems.markov_jump.sensors import FadingSensors
from fusion_gym.systems.markov_jump.state import (
    SIGNALS,
    MarkovJumpFamily,
    MarkovJumpState,
    sampling_blocks,
)

_RANGE = 5.0  # whitened quantities and logarithms of deviation ratios are clipped here
_FLOOR = 1e-9  # least deviation of a lag, relative to open loop: it is zero right after a packet


@dataclass(frozen=True)
class MarkovJumpSystem(MarkovJumpFamily[MarkovJumpState]):
    """The plant, its sensors, the nodes' filters, the joint recursion and a fusion rule.

    ``state_weights`` (n,) weigh the traces among the signals, ``magnitude`` (n,) divides observed
    estimates and ``reference`` (n,) observed variances.
    """

    plant: MarkovJumpPlant
    sensors: FadingSensors
    model: AugmentedModel
    filters: LocalFilters
    recursion: LagRecursion
    fusion: FusionRule
    state_names: tuple[str, ...]
    state_weights: Array
    magnitude: Array
    reference: Array
    nature: Nature = AS_ASSUMED
    signals = SIGNALS
    extensions = ("create", "full_rate_traces")

    @classmethod
    def create(
        cls,
        plant: MarkovJumpPlant,
        sensors: FadingSensors,
        fusion: FusionRule,
        state_names: tuple[str, ...],
        state_weights: Array | None,
        horizon: int,
        nature: Nature = AS_ASSUMED,
    ) -> MarkovJumpSystem:
        """Return the system with tables for ``horizon`` steps."""
        common = cls._common_fields(plant, sensors, state_names, state_weights, horizon, nature)
        filters = LocalFilters.create(common["model"], horizon)
        recursion = LagRecursion.create(filters, plant.size)
        return cls(**common, filters=filters, recursion=recursion, fusion=fusion)

    @property
    def covariance_cycle(self) -> int:
        """Steps after which the sampling repeats; covariances do not depend on the data."""
        return self.filters.period

    @property
    def observation(self) -> tuple[Block, ...]:
        """Blocks of the observation."""
        nodes, states = (numbered(self.sensor_count),), (self.state_names,)
        own = partial(Block, node="own", limit=_RANGE)
        fused = partial(Block, labels=states, limit=_RANGE)
        difference = "node's estimate minus the centre's copy, over its deviation"
        innovation = "node's innovation over its deviation, 0 without a sample"
        local = "logarithm of the root of the node's trace over the open-loop trace"
        copies = "logarithm of the copy's predicted over the open-loop deviation"
        open_loop = {"open-loop deviation": np.sqrt(self.reference)}
        return (
            own("whitened_difference", difference, self._difference, nodes + states, "own"),
            own("whitened_innovation", innovation, self._whitened_innovation, nodes, "own"),
            *sampling_blocks(self.sensors),
            age_block(*nodes),
            own(
                "local_log_deviation",
                local,
                self._local_log_deviation,
                nodes,
                constants={"open-loop trace": self.reference.sum()},
            ),
            own(
                "copy_log_deviation",
                copies,
                self._copy_log_deviation,
                nodes + states,
                constants=open_loop,
            ),
            fused(
                "log_deviation",
                "logarithm of the silent fused over the open-loop deviation",
                lambda s: log_deviation(s.prior_covariance, self.reference),
                constants=open_loop,
            ),
            fused(
                "estimate",
                "fused estimate without a transmission over the root mean square",
                lambda s: s.prior_mean / self.magnitude[:, None],
                constants={"root mean square": self.magnitude},
            ),
        )

    def start(self, noise: Array) -> MarkovJumpState:
        """Draw the initial state; all estimates are the mean of ζ(0), without lags."""
        runs, n, count = noise.shape[-1], self.plant.size, self.sensor_count
        truth, mode, process_noise, departure = self._start(noise)
        first = self.model.initial_mean
        mean = np.broadcast_to(first[:, None], (count, len(first), runs)).copy()
        noise_mean = np.zeros((count, self.plant.process_gain.shape[1], runs))
        state_mean = np.broadcast_to(self.plant.initial_mean, (n, runs)).copy()
        covariance = np.broadcast_to(self.plant.initial_covariance, (n, n, runs)).copy()
        return MarkovJumpState(
            time=np.zeros(runs, dtype=np.int64),
            truth=truth,
            mode=mode,
            process_noise=process_noise,
            innovation=np.zeros((count, runs)),
            node_mean=mean,
            node_noise=noise_mean,
            copy_mean=mean,
            copy_noise=noise_mean,
            held=self._collapse(mean),
            age=np.zeros((count, runs)),
            sent=np.ones((count, runs), dtype=np.bool_),
            lags=self.recursion.start(runs),
            prediction=None,
            prior_mean=state_mean,
            prior_covariance=covariance,
            mean=state_mean,
            covariance=covariance,
            departure=departure,
        )

    def sense(self, state: MarkovJumpState, noise: Array) -> MarkovJumpState:
        """Move the plant, measure, update the nodes, and predict the copies.

        Source: markov_jump, equations (3), (4), (12)-(22), (36)-(39).
        """
        truth, mode, process_noise, measurement = self._move(state, noise)
        time = state.time + 1
        before, place = self.filters.at(state.time), self.filters.at(time)
        prior = self.filters.predict(state.node_mean, state.node_noise, before)
        update = self.filters.update(prior, measurement, self.sensors.sampled(time), place)
        copy_mean = self.filters.predict(state.copy_mean, state.copy_noise, before)
        lags = self.recursion.predict(state.lags, state.sent, before)
        prediction = self.recursion.prediction(lags, place)
        silence = np.zeros(state.sent.shape, dtype=np.bool_)
        silent = self.fusion.fuse(self._collapse(copy_mean), prediction.joint(silence))
        return replace(
            state,
            time=time,
            truth=truth,
            mode=mode,
            process_noise=process_noise,
            innovation=update.innovation,
            node_mean=update.mean,
            node_noise=update.noise_mean,
            copy_mean=copy_mean,
            copy_noise=np.zeros_like(state.copy_noise),
            age=state.age + 1.0,
            lags=lags,
            prediction=prediction,
            prior_mean=silent.mean,
            prior_covariance=silent.covariance,
        )

    def deliver(self, state: MarkovJumpState, granted: NDArray[np.bool_]) -> MarkovJumpState:
        """Replace the centre's copies by granted estimates, and fuse the copies.

        Source: markov_jump, equations (34)-(39), (55)-(57).
        """
        grant = granted[:, None]
        copy_mean = np.where(grant, state.node_mean, state.copy_mean)
        fused = self.fusion.fuse(self._collapse(copy_mean), sensed(state.prediction).joint(granted))
        return replace(
            state,
            copy_mean=copy_mean,
            copy_noise=np.where(grant, state.node_noise, state.copy_noise),
            held=np.where(grant, self._collapse(state.node_mean), state.held),
            age=np.where(granted, 0.0, state.age),
            sent=granted.copy(),
            mean=fused.mean,
            covariance=fused.covariance,
        )

    def read(self, state: MarkovJumpState) -> Mapping[str, SignalArray | Callable[[], SignalArray]]:
        """Return the signals of ``SIGNALS``."""
        prediction = sensed(state.prediction)
        place = self.filters.at(state.time)
        return {
            "measurement": lambda: self._collapse(state.node_mean),
            "innovation": lambda: self._collapse(state.node_mean - state.copy_mean),
            "held": state.held,
            "age": state.age,
            "expected_measurement": lambda: self._collapse(state.copy_mean),
            "innovation_deviation": lambda: self._lag_deviation(prediction),
            "prior_mean": state.prior_mean,
            "prior_covariance": state.prior_covariance,
            "silent_variance": lambda: linalg.weighted_trace(
                state.prior_covariance, self.state_weights
            ),
            "variance_reduction": lambda: self._variance_reduction(state, prediction),
            "centre_variance": lambda: linalg.trace(state.prior_covariance),
            "greedy_variance": lambda: self._greedy_variance(state, prediction),
            "local_variance": lambda: self.recursion.local_trace.take(place, -1),
            "sampled": lambda: self.sensors.sampled(state.time),
        }

    def local_means(self, state: MarkovJumpState) -> Array:
        """Return the nodes' estimates (sensors, n, N)."""
        return self._collapse(state.node_mean)

    def full_rate_traces(self) -> Array:
        """Return the trace of the optimal fused covariance over one period at full rate, (period,).

        It is tr P_d of (33) in the steady state, with every node sending at every step.
        """
        local = self.recursion.local[..., -self.filters.period :]
        means = np.zeros((self.sensor_count, self.plant.size, self.filters.period))
        return linalg.trace(MatrixWeightedFusion().fuse(means, local).covariance)

    def _collapse(self, mean: Array) -> Array:
        """Return x̂ = Σ_m ζ̂_m (l, n, N) of ζ̂ (l, a, N), equation (44).

        Source: markov_jump, equation (44).
        """
        n = self.plant.size
        result = mean[:, :n].copy()
        for first in range(n, mean.shape[1], n):
            result += mean[:, first : first + n]
        return result

    def _difference(self, state: MarkovJumpState) -> Array:
        lag = self._collapse(state.node_mean - state.copy_mean)
        return lag / self._lag_deviation(sensed(state.prediction))

    def _whitened_innovation(self, state: MarkovJumpState) -> Array:
        nodes, place = np.arange(self.sensor_count), self.filters.at(state.time)
        variance = self.filters.innovation_covariance[nodes, nodes].take(place, -1)
        return state.innovation / np.sqrt(variance)

    def _local_log_deviation(self, state: MarkovJumpState) -> Array:
        trace = self.recursion.local_trace.take(self.filters.at(state.time), -1)
        return log_deviation(trace[:, None, None], self.reference.sum(keepdims=True))[:, 0]

    def _copy_log_deviation(self, state: MarkovJumpState) -> Array:
        prediction, nodes = sensed(state.prediction), np.arange(self.sensor_count)
        covariance = prediction.local[nodes, nodes] + prediction.lag[nodes, nodes]
        return log_deviation(covariance, self.reference)

    def _lag_deviation(self, prediction: JointPrediction) -> Array:
        """Return the predicted deviations (l, n, N) of node minus copy, above zero."""
        nodes = np.arange(self.sensor_count)
        variance = linalg.diagonal(prediction.lag[nodes, nodes])
        return np.sqrt(np.maximum(variance, (_FLOOR * _FLOOR) * self.reference[:, None]))

    def _variance_reduction(self, state: MarkovJumpState, prediction: JointPrediction) -> Array:
        silent = linalg.weighted_trace(state.prior_covariance, self.state_weights)
        silence = np.zeros(state.sent.shape, dtype=np.bool_)
        each = self._covariances_after_next(state, prediction, silence)
        return np.stack(
            [silent - linalg.weighted_trace(covariance, self.state_weights) for covariance in each]
        )

    def _greedy_variance(self, state: MarkovJumpState, prediction: JointPrediction) -> Array:
        """Return the trace as sensors join in the order of the largest reduction."""
        sent = np.zeros(state.sent.shape, dtype=np.bool_)
        sensors, result = np.arange(self.sensor_count)[:, None], np.empty(sent.shape)
        trace = linalg.trace(state.prior_covariance)
        for _ in range(self.sensor_count):
            each = self._covariances_after_next(state, prediction, sent)
            options = np.where(sent, np.inf, [linalg.trace(covariance) for covariance in each])
            selected = sensors == options.argmin(0)
            result[selected] = np.broadcast_to(trace, sent.shape)[selected]
            trace, sent = options.min(0), sent | selected
        return result

    def _covariances_after_next(
        self, state: MarkovJumpState, prediction: JointPrediction, sent: NDArray[np.bool_]
    ) -> list[Array]:
        """Return fused covariances (n, n, N) if ``sent`` (l, N) and one more sensor transmit."""
        means, each = self._collapse(state.copy_mean), []
        for sensor in range(self.sensor_count):
            more = sent.copy()
            more[sensor] = True
            each.append(self.fusion.fuse(means, prediction.joint(more)).covariance)
        return each
