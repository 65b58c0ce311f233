"""A centre that receives the measurements of the Markov jump plant, as a reference.

Source: markov_jump (event-triggered distributed fusion estimation for asynchronous Markov jump
systems with correlated noises and fading measurements), its plant and sensors; the centre is ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.core import knowledge
from fusion_gym.core.estimator import Reception, SignalValues
from fusion_gym.namespace import namespace
from fusion_gym.systems.markov_jump.centralised import (
    Belief,
    CentralFilter,
    InteractingModels,
    ModePrediction,
)
from fusion_gym.systems.markov_jump.linear_minimum_variance import AugmentedModel, Times
from fusion_gym.systems.markov_jump.system import OF_FAMILY, sampling_blocks
from fusion_gym.systems.parts import RANGE, Deliveries, ScaledEstimator


@dataclass(slots=True)
class MarkovJumpCentralEstimate(Deliveries):
    """The centre's estimate of N runs at one time k; n states, l sensors.

    ``measurement`` (l, 1, N), the held value where a sensor does not sample · ``time`` k (N,) ·
    ``belief``, a prior until delivery · ``prediction`` from that prior · ``mean`` (n, N),
    ``covariance`` (n, n, N), after the delivery.
    """

    time: Times
    belief: Belief
    prediction: ModePrediction | None
    mean: Array
    covariance: Array


CENTRAL_SIGNALS = (
    *knowledge.common_signals(
        "(sensors, 1, N)",
        measurement="the new measurement, or the held one if the sensor does not sample",
        innovation="measurement minus its expectation, 0 if the sensor does not sample",
        variance_reduction="reduction of this trace by a linear update with this sample",
    ),
    *OF_FAMILY,
)


@dataclass(frozen=True)
class MarkovJumpCentralEstimator(ScaledEstimator[MarkovJumpCentralEstimate]):
    """One filter at the centre.

    A packet carries the sensor's new measurement. A request of a sensor that does not sample
    delivers nothing, although the network grants it and takes its tokens. Nothing is fed back.

    ``scale`` (l,) divides observed measurements.
    """

    model: AugmentedModel
    filter: CentralFilter
    scale: Array
    signals = CENTRAL_SIGNALS

    @property
    def covariance_cycle(self) -> int | None:  # type: ignore[override]
        """Steps after which the sampling repeats; none if covariances depend on the data."""
        if isinstance(self.filter, InteractingModels):
            return None
        return math.lcm(*self.model.sensors.period[:, 0].tolist())

    @property
    def observation(self) -> tuple[knowledge.Block, ...]:
        """Blocks of the observation; mode probabilities only with interacting models."""
        nodes, n = knowledge.numbered(self.model.sensors.count), self.model.plant.size
        scale, block = self.scale[:, None], partial(knowledge.Block, limit=RANGE)
        innovation = "innovation against the centre's expectation, whitened, 0 without a sample"
        measured = {"root mean square": self.scale}
        probability = knowledge.Block(
            "mode_probability",
            "probability of the mode",
            lambda s: s.belief.probability,
            (knowledge.numbered(self.model.plant.modes),),
        )
        return (
            block("whitened_innovation", innovation, self._whitened, (nodes,), "scheduler"),
            block(
                "difference",
                "new minus held measurement over its root mean square",
                lambda s: (s.measurement - s.held)[:, 0] / scale,
                (nodes,),
                "own",
                "own",
                constants=measured,
            ),
            *sampling_blocks(self.model.sensors),
            knowledge.age_block(nodes),
            block(
                "innovation_log_deviation",
                "logarithm of the innovation's deviation over the measurement's root mean square",
                lambda s: namespace(s.belief.mean).log(
                    self._deviation(knowledge.sensed(s.prediction)) / scale
                ),
                (nodes,),
                constants=measured,
            ),
            self.deviation_block(
                "log_deviation",
                "logarithm of the predicted over the open-loop deviation",
                lambda s: knowledge.log_deviation(
                    knowledge.sensed(s.prediction).covariance[:n, :n], self.reference
                ),
            ),
            self.estimate_block(
                "prediction over the state's root mean square",
                lambda s: knowledge.sensed(s.prediction).mean[:n],
            ),
            *((probability,) if isinstance(self.filter, InteractingModels) else ()),
        )

    def start(self, measurement: Array, announcement: None) -> MarkovJumpCentralEstimate:
        """Return the belief of time 0; nothing is measured, and its expectation is held."""
        count, n, runs = self.model.sensors.count, self.model.plant.size, measurement.shape[-1]
        belief, time = self.filter.start(runs), np.zeros(runs, dtype=np.int64)
        mean, covariance = self.filter.estimate(belief)
        held = self.filter.prediction(belief, time).mean[n:, None]
        age = np.zeros((count, runs))
        return MarkovJumpCentralEstimate(held, held, age, time, belief, None, mean, covariance)

    def predict(self, state: MarkovJumpCentralEstimate) -> MarkovJumpCentralEstimate:
        """Predict states and measurements."""
        time = state.time + 1
        belief = self.filter.predict(state.belief, state.time)
        return replace(
            state,
            time=time,
            age=state.age + 1.0,
            belief=belief,
            prediction=self.filter.prediction(belief, time),
        )

    def observe(
        self, state: MarkovJumpCentralEstimate, measurement: Array
    ) -> MarkovJumpCentralEstimate:
        """Take the measurements of the sensors that sample."""
        sampled = self.model.sensors.sampled(state.time)[:, None]
        seen = namespace(sampled).where(sampled, measurement, state.held)
        return replace(state, measurement=seen)

    def update(
        self, state: MarkovJumpCentralEstimate, reception: Reception
    ) -> MarkovJumpCentralEstimate:
        """Update the centre with all samples that arrive at once."""
        knowledge.sensed(state.prediction)
        taken = reception.arrived & self.model.sensors.sampled(state.time)
        # What is not taken counts for nothing, and may be no number where it is not visible.
        after = state.after(taken)
        belief = self.filter.update(state.belief, after.held[:, 0], taken, state.time)
        mean, covariance = self.filter.estimate(belief)
        return replace(after, belief=belief, mean=mean, covariance=covariance)

    def read(self, state: MarkovJumpCentralEstimate, failure: Array | None = None) -> SignalValues:
        """Return the signals of ``CENTRAL_SIGNALS``."""
        prediction, n = knowledge.sensed(state.prediction), self.model.plant.size
        prior = prediction.covariance[:n, :n]
        return {
            **super().read(state, failure),
            "innovation": lambda: self._innovation(state, prediction)[:, None],
            "expected_measurement": prediction.mean[n:, None],
            "innovation_deviation": lambda: self._deviation(prediction)[:, None],
            "prior_mean": prediction.mean[:n],
            "prior_covariance": prior,
            "silent_variance": lambda: self.trace(prior),
            "variance_reduction": lambda: self._reduction(
                prediction.covariance, self.state_weights, self.model.sensors.sampled(state.time)
            ),
            "centre_variance": lambda: linalg.trace(prior),
            "greedy_variance": lambda: self._greedy_variance(state, prediction),
            "sampled": lambda: self.model.sensors.sampled(state.time),
        }

    def _whitened(self, state: MarkovJumpCentralEstimate) -> Array:
        prediction = knowledge.sensed(state.prediction)
        return self._innovation(state, prediction) / self._deviation(prediction)

    def _innovation(self, state: MarkovJumpCentralEstimate, prediction: ModePrediction) -> Array:
        surprise = state.measurement[:, 0] - prediction.mean[self.model.plant.size :]
        return namespace(surprise).where(self.model.sensors.sampled(state.time), surprise, 0.0)

    def _deviation(self, prediction: ModePrediction) -> Array:
        return linalg.diagonal(prediction.covariance)[self.model.plant.size :] ** 0.5

    def _reduction(self, covariance: Array, weights: Array, useful: NDArray[np.bool_]) -> Array:
        """Return the reduction (l, N) of the weighted trace by each single measurement."""
        n = self.model.plant.size
        cross = covariance[:n, n:]
        squares = linalg.total(weights[:, None, None] * cross * cross, 0)
        own = linalg.diagonal(covariance)[n:]
        xp = namespace(squares)
        return xp.where(useful, squares / xp.where(useful, own, 1.0), 0.0)

    def _greedy_variance(
        self, state: MarkovJumpCentralEstimate, prediction: ModePrediction
    ) -> Array:
        """Return the trace as samples join in the order of the largest reduction."""
        n, covariance = self.model.plant.size, prediction.covariance
        xp = namespace(covariance)
        left = self.model.sensors.sampled(state.time)
        sensors, result = np.arange(self.model.sensors.count)[:, None], np.zeros(left.shape)
        for _ in range(self.model.sensors.count):
            gain = xp.where(left, self._reduction(covariance, np.ones(n), left), -1.0)
            best = gain.argmax(0)
            selected = (sensors == best) & left
            trace = linalg.trace(covariance[:n, :n])
            result = xp.where(selected, trace, result)
            column = xp.take_along_axis(covariance, (n + best)[None, None], axis=1)[:, 0]
            own = xp.take_along_axis(column, (n + best)[None], axis=0)[0]
            weight = xp.where(selected.any(0), 1.0 / xp.where(selected.any(0), own, 1.0), 0.0)
            covariance = covariance - linalg.outer(column, column) * weight
            left = left & ~selected
        return result
