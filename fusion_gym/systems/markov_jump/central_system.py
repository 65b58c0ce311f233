"""The Markov jump plant with a centre that receives measurements, as a reference.

Source: markov_jump (event-triggered distributed fusion estimation for asynchronous Markov jump
systems with correlated noises and fading measurements), its plant and sensors; the centre is ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.core.nature import AS_ASSUMED, Nature
from fusion_gym.core.system import (
    Block,
    SignalArray,
    age_block,
    common_signals,
    log_deviation,
    numbered,
    sensed,
)
from fusion_gym.systems.markov_jump.centralised_linear import (
    Belief,
    CentralisedLinearFilter,
    ModePrediction,
)
from fusion_gym.systems.markov_jump.interacting_models import InteractingModels
from fusion_gym.systems.markov_jump.linear_minimum_variance import AugmentedModel, Times
from fusion_gym.systems.markov_jump.plant import MarkovJumpPlant, Modes
from fusion_gym.systems.markov_jump.sensors import FadingSensors
from fusion_gym.systems.markov_jump.state import OF_FAMILY, MarkovJumpFamily, sampling_blocks

_RANGE = 5.0  # whitened quantities and logarithms of deviation ratios are clipped here


@dataclass(slots=True)
class MarkovJumpCentralState:
    """The state of N runs at one time k; n states, l sensors.

    ``time`` k (N,) · ``truth`` (n, N), ``mode`` θ (N,), ``process_noise`` w(k) (r, N), which moves
    the plant next · ``measurement`` (l, N), the held value where a sensor does not sample ·
    ``held`` (l, N), the last delivered measurement · ``age`` (l, N), steps since then · ``belief``
    of the centre, a prior until delivery · ``prediction`` from that prior · ``mean`` (n, N),
    ``covariance`` (n, n, N), the centre's after the delivery · ``departure`` (4, N) of the truth
    from the model, if any.
    """

    time: Times
    truth: Array
    mode: Modes
    process_noise: Array
    measurement: Array
    held: Array
    age: Array
    belief: Belief
    prediction: ModePrediction | None
    mean: Array
    covariance: Array
    departure: Array | None = None


CENTRAL_SIGNALS = (
    *common_signals(
        "(sensors, 1, N)",
        measurement="the new measurement, or the held one if the sensor does not sample",
        innovation="measurement minus its expectation, 0 if the sensor does not sample",
        variance_reduction="reduction of this trace by a linear update with this sample",
    ),
    *OF_FAMILY,
)


@dataclass(frozen=True)
class MarkovJumpCentralSystem(MarkovJumpFamily[MarkovJumpCentralState]):
    """The plant, its sensors and one filter at the centre.

    A packet carries the sensor's new measurement. A request of a sensor that does not sample
    delivers nothing, although the network grants it and takes its tokens. Nothing is fed back.

    ``state_weights`` (n,) weigh the traces among the signals, ``magnitude`` (n,) divides observed
    estimates, ``reference`` (n,) observed variances and ``scale`` (l,) observed measurements.
    """

    plant: MarkovJumpPlant
    sensors: FadingSensors
    model: AugmentedModel
    estimator: CentralisedLinearFilter | InteractingModels
    state_names: tuple[str, ...]
    state_weights: Array
    magnitude: Array
    reference: Array
    scale: Array
    nature: Nature = AS_ASSUMED
    signals = CENTRAL_SIGNALS
    extensions = ("create",)

    @classmethod
    def create(
        cls,
        plant: MarkovJumpPlant,
        sensors: FadingSensors,
        interacting: bool,
        state_names: tuple[str, ...],
        state_weights: Array | None,
        horizon: int,
        nature: Nature = AS_ASSUMED,
    ) -> MarkovJumpCentralSystem:
        """Return the system with :class:`InteractingModels` or the linear filter."""
        common = cls._common_fields(plant, sensors, state_names, state_weights, horizon, nature)
        linear = CentralisedLinearFilter.create(common["model"], horizon)
        estimator = InteractingModels.create(plant, sensors) if interacting else linear
        return cls(**common, estimator=estimator, scale=_measured(linear, horizon))

    def offers(self, capability: str) -> bool:
        """See :class:`System`; covariances of interacting models depend on the data."""
        if capability == "covariance_cycle":
            return not isinstance(self.estimator, InteractingModels)
        return super().offers(capability)

    @property
    def covariance_cycle(self) -> int:
        """Steps after which the sampling repeats."""
        return math.lcm(*self.sensors.period[:, 0].tolist())

    @property
    def observation(self) -> tuple[Block, ...]:
        """Blocks of the observation; mode probabilities only with interacting models."""
        nodes, n, scale = numbered(self.sensor_count), self.plant.size, self.scale[:, None]
        block = partial(Block, limit=_RANGE)
        innovation = "innovation against the centre's expectation, whitened, 0 without a sample"
        deviation = (
            "logarithm of the innovation's deviation over the measurement's root mean square"
        )
        measured = {"root mean square": self.scale}
        probability = Block(
            "mode_probability",
            "probability of the mode",
            lambda s: s.belief.probability,
            (numbered(self.plant.modes),),
        )
        return (
            block("whitened_innovation", innovation, self._whitened, (nodes,), "scheduler"),
            block(
                "difference",
                "new minus held measurement over its root mean square",
                lambda s: (s.measurement - s.held) / scale,
                (nodes,),
                "own",
                "own",
                constants=measured,
            ),
            *sampling_blocks(self.sensors),
            age_block(nodes),
            block(
                "innovation_log_deviation",
                deviation,
                lambda s: np.log(self._deviation(sensed(s.prediction)) / scale),
                (nodes,),
                constants=measured,
            ),
            block(
                "log_deviation",
                "logarithm of the predicted over the open-loop deviation",
                self._log_deviation,
                (self.state_names,),
                constants={"open-loop deviation": np.sqrt(self.reference)},
            ),
            block(
                "estimate",
                "prediction over the state's root mean square",
                lambda s: sensed(s.prediction).mean[:n] / self.magnitude[:, None],
                (self.state_names,),
                constants={"root mean square": self.magnitude},
            ),
            *((probability,) if isinstance(self.estimator, InteractingModels) else ()),
        )

    def start(self, noise: Array) -> MarkovJumpCentralState:
        """Draw the initial state; nothing is measured, and the held value is its expectation."""
        runs, n = noise.shape[-1], self.plant.size
        truth, mode, process_noise, departure = self._start(noise)
        belief, time = self.estimator.start(runs), np.zeros(runs, dtype=np.int64)
        mean, covariance = self.estimator.estimate(belief)
        held = self.estimator.prediction(belief, time).mean[n:]
        return MarkovJumpCentralState(
            time=time,
            truth=truth,
            mode=mode,
            process_noise=process_noise,
            measurement=held,
            held=held,
            age=np.zeros((self.sensor_count, runs)),
            belief=belief,
            prediction=None,
            mean=mean,
            covariance=covariance,
            departure=departure,
        )

    def sense(self, state: MarkovJumpCentralState, noise: Array) -> MarkovJumpCentralState:
        """Move the plant, measure, and predict.

        Source: markov_jump, equations (3), (4).
        """
        truth, mode, process_noise, measurement = self._move(state, noise)
        time = state.time + 1
        belief = self.estimator.predict(state.belief, state.time)
        return replace(
            state,
            time=time,
            truth=truth,
            mode=mode,
            process_noise=process_noise,
            measurement=np.where(self.sensors.sampled(time), measurement, state.held),
            age=state.age + 1.0,
            belief=belief,
            prediction=self.estimator.prediction(belief, time),
        )

    def deliver(
        self, state: MarkovJumpCentralState, granted: NDArray[np.bool_]
    ) -> MarkovJumpCentralState:
        """Update the centre with all granted samples at once."""
        sensed(state.prediction)
        taken = granted & self.sensors.sampled(state.time)
        # What is not taken counts for nothing, and may be no number where it is not visible.
        measurement = np.where(taken, state.measurement, state.held)
        belief = self.estimator.update(state.belief, measurement, taken, state.time)
        mean, covariance = self.estimator.estimate(belief)
        return replace(
            state,
            held=measurement,
            age=np.where(taken, 0.0, state.age),
            belief=belief,
            mean=mean,
            covariance=covariance,
        )

    def read(
        self, state: MarkovJumpCentralState
    ) -> Mapping[str, SignalArray | Callable[[], SignalArray]]:
        """Return the signals of ``CENTRAL_SIGNALS``."""
        prediction, n = sensed(state.prediction), self.plant.size
        prior = prediction.covariance[:n, :n]
        return {
            "measurement": state.measurement[:, None],
            "innovation": lambda: self._innovation(state, prediction)[:, None],
            "held": state.held[:, None],
            "age": state.age,
            "expected_measurement": prediction.mean[n:, None],
            "innovation_deviation": lambda: self._deviation(prediction)[:, None],
            "prior_mean": prediction.mean[:n],
            "prior_covariance": prior,
            "silent_variance": lambda: linalg.weighted_trace(prior, self.state_weights),
            "variance_reduction": lambda: self._reduction(
                prediction.covariance, self.state_weights, self.sensors.sampled(state.time)
            ),
            "centre_variance": lambda: linalg.trace(prior),
            "greedy_variance": lambda: self._greedy_variance(state, prediction),
            "sampled": lambda: self.sensors.sampled(state.time),
        }

    def local_means(self, state: MarkovJumpCentralState) -> Array:
        """Return the centre's estimate for each sensor (sensors, n, N); nodes have no filters."""
        return np.repeat(state.mean[None], self.sensor_count, axis=0)

    def _whitened(self, state: MarkovJumpCentralState) -> Array:
        prediction = sensed(state.prediction)
        return self._innovation(state, prediction) / self._deviation(prediction)

    def _log_deviation(self, state: MarkovJumpCentralState) -> Array:
        n = self.plant.size
        return log_deviation(sensed(state.prediction).covariance[:n, :n], self.reference)

    def _innovation(self, state: MarkovJumpCentralState, prediction: ModePrediction) -> Array:
        surprise = state.measurement - prediction.mean[self.plant.size :]
        return np.where(self.sensors.sampled(state.time), surprise, 0.0)

    def _deviation(self, prediction: ModePrediction) -> Array:
        return np.sqrt(linalg.diagonal(prediction.covariance)[self.plant.size :])

    def _reduction(self, covariance: Array, weights: Array, useful: NDArray[np.bool_]) -> Array:
        """Return the reduction (l, N) of the weighted trace by each single measurement."""
        n = self.plant.size
        cross = covariance[:n, n:]
        squares = linalg.total(weights[:, None, None] * cross * cross, 0)
        own = linalg.diagonal(covariance)[n:]
        return np.where(useful, squares / np.where(useful, own, 1.0), 0.0)

    def _greedy_variance(self, state: MarkovJumpCentralState, prediction: ModePrediction) -> Array:
        """Return the trace as samples join in the order of the largest reduction."""
        n, covariance = self.plant.size, prediction.covariance
        left = self.sensors.sampled(state.time)
        sensors, result = np.arange(self.sensor_count)[:, None], np.zeros(left.shape)
        for _ in range(self.sensor_count):
            gain = np.where(left, self._reduction(covariance, np.ones(n), left), -1.0)
            best = gain.argmax(0)
            selected = (sensors == best) & left
            trace = linalg.trace(covariance[:n, :n])
            result[selected] = np.broadcast_to(trace, left.shape)[selected]
            column = np.take_along_axis(covariance, (n + best)[None, None], axis=1)[:, 0]
            own = np.take_along_axis(column, (n + best)[None], axis=0)[0]
            weight = np.where(selected.any(0), 1.0 / np.where(selected.any(0), own, 1.0), 0.0)
            covariance = covariance - linalg.outer(column, column) * weight
            left = left & ~selected
        return result


def _measured(linear: CentralisedLinearFilter, horizon: int) -> Array:
    """Return root mean squares (l,) of the sensors' measurements over k = 1..horizon."""
    model = linear.model
    sensors, noise = model.sensors, model.plant.noise_covariance
    total = np.zeros(sensors.count)
    coupling = sensors.noise_coupling[..., 0]
    for time, step in zip(range(horizon + 1), model.steps(), strict=False):
        if time > 0:
            total += ((model.faded @ step.moment) * model.faded).sum(1)
            total += linear.variance[:, min(time, linear.variance.shape[1] - 1)]
    return np.asarray(np.sqrt(total / horizon + ((coupling @ noise) * coupling).sum(1)))
