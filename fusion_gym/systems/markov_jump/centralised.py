"""A centre that receives the measurements of the Markov jump plant, as a reference.

Its filter is the best linear one, or interacting models. They share the beliefs about state and
noise, their update with any of the measurements, and the prediction of measurements.

Source: markov_jump (event-triggered distributed fusion estimation for asynchronous Markov jump
systems with correlated noises and fading measurements), its plant and sensors; the centre is ours.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.core import knowledge
from fusion_gym.core.estimator import Reception, SignalValues
from fusion_gym.namespace import namespace, set_at, take, update_at
from fusion_gym.systems.bases import RANGE, Deliveries, ScaledEstimator
from fusion_gym.systems.markov_jump.linear_minimum_variance import (
    LONGEST,
    ROUNDING,
    AugmentedModel,
    Times,
    settled,
)
from fusion_gym.systems.markov_jump.system import OF_FAMILY, sampling_blocks

_ALL = slice(None)


class Belief(NamedTuple):
    """The centre's belief about the state and the noise w(k) that moves it next.

    One normal distribution of z = col(state, w) for each of M models: ``probability`` (M, N),
    ``mean`` (M, s, N), ``covariance`` (M, s, s, N). In a prediction w has mean 0 and covariance Q
    and is independent of the state.
    """

    probability: Array
    mean: Array
    covariance: Array


class ModePrediction(NamedTuple):
    """Moments of col(x, y): the plant's states and all sensors' measurements.

    ``mean`` (n + l, N), ``covariance`` (n + l, n + l, N), as if all sensors sampled.
    """

    mean: Array
    covariance: Array


def with_noise(
    probability: Array, mean: Array, covariance: Array, noise_covariance: Array
) -> Belief:
    """Return a prediction from the state's moments (M, a, N), (M, a, a, N) and Q (r, r)."""
    xp, (models, size, runs) = namespace(mean), mean.shape
    whole, state, noise = size + len(noise_covariance), slice(size), slice(size, None)
    means, spread = xp.zeros((models, whole, runs)), xp.zeros((models, whole, whole, runs))
    means = set_at(means, (..., state, _ALL), mean)
    spread = set_at(spread, (..., state, state, _ALL), covariance)
    spread = set_at(spread, (..., noise, noise, _ALL), noise_covariance[..., None])
    return Belief(probability, means, spread)


def condition_on(
    belief: Belief, rows: Array, variance: Array, measurement: Array, taken: NDArray[np.bool_]
) -> tuple[Belief, Array]:
    """Return the belief after the ``taken`` measurements, and their log likelihood by model.

    Measurement i is ``rows[:, i]`` z plus independent noise: the measurement noises share only w,
    which is a part of z. Sequential updates therefore equal a joint one.

    Args:
        belief: a prediction.
        rows: (M, l, s, 1).
        variance: (M, l, N), of each measurement's own noise, > 0.
        measurement: (l, N).
        taken: (l, N).
    """
    mean, covariance, xp = belief.mean, belief.covariance, namespace(taken)
    likelihood = xp.zeros(belief.probability.shape)
    for sensor in range(len(measurement)):
        row = rows[:, sensor]
        cross = linalg.matvec(covariance, row)
        spread = linalg.dot(row, cross) + variance[:, sensor]
        surprise = measurement[sensor] - linalg.dot(row, mean)
        weight = xp.where(taken[sensor], 1.0 / spread, 0.0)
        mean = mean + cross * (weight * surprise)[:, None]
        covariance = covariance - linalg.outer(cross, cross) * weight[:, None, None]
        loss = surprise * surprise / spread + xp.log(spread)
        likelihood -= xp.where(taken[sensor], 0.5 * loss, 0.0)
    return Belief(belief.probability, mean, covariance), likelihood


def mode_mixture(belief: Belief, maps: Array) -> tuple[Array, Array]:
    """Return mean (p, N) and covariance (p, p, N) of maps · z over all models."""
    means = linalg.matvec(maps, belief.mean)
    spreads = linalg.congruence(maps, belief.covariance)
    xp = namespace(means)
    deviation = xp.sqrt(xp.maximum(linalg.diagonal(belief.covariance), 0.0))
    certain = linalg.diagonal(spreads) <= ROUNDING * linalg.matvec(np.abs(maps), deviation) ** 2
    spreads = xp.where(certain[:, :, None] | certain[:, None], 0.0, spreads)
    if len(means) == 1:
        return means[0], spreads[0]
    mean = linalg.total(belief.probability[:, None] * means, 0)
    apart = means - mean
    spreads += linalg.outer(apart, apart)
    return mean, linalg.total(belief.probability[:, None, None] * spreads, 0)


@dataclass(frozen=True)
class CentralFilter(ABC):
    """A filter at the centre, with one normal distribution of z for each of M models.

    ``maps`` (M, n + l, s, 1) from z to col(x, y), with y without its independent noise · ``motion``
    from z to the next state of a model.
    """

    model: AugmentedModel
    maps: Array
    motion: Array

    @abstractmethod
    def start(self, runs: int) -> Belief:
        """Return the belief of time 0, without measurements."""

    @abstractmethod
    def predict(self, belief: Belief, time: Times) -> Belief:
        """Return the prediction for ``time`` + 1 from the belief after ``time`` (N,)."""

    @abstractmethod
    def _variance(self, belief: Belief, time: Times) -> Array:
        """Return variances (M, l, N) of the measurements' independent noises at ``time`` (N,)."""

    def prediction(self, belief: Belief, time: Times) -> ModePrediction:
        """Return the prediction of plant and measurements for ``time`` (N,)."""
        variance = self._variance(belief, time)
        mean, covariance = mode_mixture(belief, self.maps)
        own, sensors = linalg.total(belief.probability[:, None] * variance, 0), variance.shape[1]
        for sensor in range(sensors):
            place = len(mean) - sensors + sensor
            covariance = update_at(np.add, covariance, (..., place, place, _ALL), own[sensor])
        return ModePrediction(mean, covariance)

    def update(
        self, belief: Belief, measurement: Array, taken: NDArray[np.bool_], time: Times
    ) -> Belief:
        """Return the belief after the ``taken`` (l, N) of the measurements (l, N)."""
        rows, variance = self.maps[:, self.model.plant.size :], self._variance(belief, time)
        after, likelihood = condition_on(belief, rows, variance, measurement, taken)
        # The likeliest possible model has weight one, so that far tails do not make 0 / 0.
        xp = namespace(likelihood)
        possible = xp.where(belief.probability > 0.0, likelihood, -np.inf)
        weights = belief.probability * xp.exp(possible - possible.max(0))
        return after._replace(probability=weights / linalg.total(weights))

    def estimate(self, belief: Belief) -> tuple[Array, Array]:
        """Return mean (n, N) and covariance (n, n, N) of the plant's state, over all models."""
        return mode_mixture(belief, self.maps[:, : self.model.plant.size])


@dataclass(frozen=True)
class CentralisedLinearFilter(CentralFilter):
    r"""Best linear filter at the centre, of all delivered measurements.

    The state of the belief is ζ = col(x 1{θ = m}), and the belief has one model. Covariances depend
    on time and deliveries, not on the data, and are exact.

    With a = modes · n, s = a + r: ``maps`` (1, n + l, s, 1) from z to col(x, y), with y_i = c_i ζ +
    α_i w plus independent noise · ``motion`` [Ā B̄(k)] (a, s, T) · ``additional`` Q_c(k) (a, a, T)
    · ``variance`` of the independent noises σ_i² C_i P(k) C_iᵀ + R_i (l, T). Tables end at their
    steady state.

    Equation:
        $$
        z=\begin{bmatrix}\zeta\\ w\end{bmatrix},\qquad K_i=\frac{P_z r_i^{\mathsf T}}{r_i P_z
        r_i^{\mathsf T}+\sigma_i^2C_iMC_i^{\mathsf T}+R_i},\qquad r_i=(c_i,\ \alpha_i)
        $$

        $$
        \hat z\leftarrow\hat z+K_i(y_i-r_i\hat z),\qquad P_z\leftarrow P_z-K_i\,r_iP_z
        $$

        for every measurement that was delivered, one after the other; then

        $$
        \hat\zeta(k+1)=(\bar A\ \ \bar B)\,\hat z,\qquad P_\zeta(k+1)=(\bar A\ \ \bar
        B)\,P_z\,(\bar A\ \ \bar B)^{\mathsf T}+Q_c
        $$

        with the model of
        :class:`~fusion_gym.systems.markov_jump.linear_minimum_variance.LocalFilters`, a new w with
        mean 0 and covariance Q, and Q_c the covariance of ξ.

    Assumes: a Markov jump system whose mode nobody sees, and transmissions that are not chosen
    by the noise; the estimate is the best linear one, not the best.

    Source: markov_jump, equations (5)-(22), with the measurements of all sensors in one vector.
    """

    additional: Array
    variance: Array

    @classmethod
    def create(cls, model: AugmentedModel, horizon: int) -> CentralisedLinearFilter:
        """Return tables for the times 0..horizon + 1 at least, or until their steady state."""
        sensors, n, size = model.sensors, model.plant.size, model.size
        noises = len(model.plant.noise_covariance)
        maps = np.zeros((n + sensors.count, size + noises))
        maps[:n, :size] = np.tile(np.eye(n), model.plant.modes)
        maps[n:, :size], maps[n:, size:] = model.faded, sensors.noise_coupling[..., 0]
        rows: list[tuple[Array, Array, Array]] = []
        now: tuple[Array, ...] = ()
        for time, step in enumerate(model.steps()):
            observed = ((model.unfaded @ step.moment) * model.unfaded).sum(1)
            own = sensors.fading_variance * observed + sensors.variance[:, 0]
            rows.append((np.hstack((model.transition, step.input)), step.additional, own))
            before, now = now, step.moments(model.plant)
            if (time > 0 and settled(now, before)) or time >= max(horizon + 2, LONGEST):
                break
        motion, additional, variance = (
            np.stack(entries, -1) for entries in zip(*rows, strict=True)
        )
        return cls(model, maps[None, ..., None], motion, additional, variance)

    def measured(self, horizon: int) -> Array:
        """Return root mean squares (l,) of the sensors' measurements over k = 1..horizon."""
        model, coupling = self.model, self.model.sensors.noise_coupling[..., 0]
        total = np.zeros(len(coupling))
        for time, step in zip(range(horizon + 1), model.steps(), strict=False):
            if time > 0:
                total += ((model.faded @ step.moment) * model.faded).sum(1)
                total += self.variance[:, min(time, self.variance.shape[1] - 1)]
        shared = ((coupling @ model.plant.noise_covariance) * coupling).sum(1)
        return np.asarray(np.sqrt(total / horizon + shared))

    def start(self, runs: int) -> Belief:
        """Return the belief of time 0, without measurements."""
        first = next(self.model.steps())
        covariance = first.moment - np.outer(first.mean, first.mean)
        size = self.model.size
        return with_noise(
            np.ones((1, runs)),
            np.broadcast_to(first.mean[:, None], (1, size, runs)),
            np.broadcast_to(covariance[..., None], (1, size, size, runs)),
            self.model.plant.noise_covariance,
        )

    def predict(self, belief: Belief, time: Times) -> Belief:
        """Return the prediction for ``time`` + 1 from the belief after ``time`` (N,)."""
        place = self._at(time)
        motion = take(self.motion, place)
        covariance = linalg.congruence(motion, belief.covariance[0])
        covariance += take(self.additional, place)
        mean = linalg.matvec(motion, belief.mean[0])
        noise = self.model.plant.noise_covariance
        return with_noise(belief.probability, mean[None], covariance[None], noise)

    def _variance(self, belief: Belief, time: Times) -> Array:
        return take(self.variance, self._at(time))[None]

    def _at(self, time: Times) -> Times:
        return namespace(time).minimum(time, self.variance.shape[-1] - 1)


@dataclass(frozen=True)
class InteractingModels(CentralFilter):
    r"""Interacting multiple models at the centre: a Kalman filter and a probability for each mode.

    Model j stands for θ(k) = j; its belief is about z = col(x, w). θ(k) governs both the
    measurement at k and the move to k + 1. Beliefs are therefore predicted by the matrices of their
    mode and mixed afterwards: p(θ(k+1) = m) = Σ_j p_jm p(θ(k) = j), and the belief of m has the
    first two moments of that mixture. Given the mode, y_i = β̄_i H_ij x + α_i w plus independent
    noise of variance R_i + σ_i² E(H_ij x)² under the prediction. Fading acts as noise of that
    variance, so estimates and probabilities are approximate, and covariances depend on the data.

    Shapes, s = n + r: ``maps`` (M, n + l, s, 1) from z to col(x, y), ``motion`` [Φ_j Γ_j]
    (M, n, s, 1), ``unfaded`` H (M, l, n, 1).

    Equation:
        $$
        \mu_j\leftarrow\frac{\mu_j\,\ell_j}{\sum_i\mu_i\,\ell_i},\qquad \mu_m(k+1)=\sum_j
        p_{jm}\,\mu_j,\qquad \omega_{j|m}=\frac{p_{jm}\,\mu_j}{\mu_m(k+1)}
        $$

        $$
        \hat x_m(k+1)=\sum_j\omega_{j|m}\,\hat x_j^{-},\qquad
        P_m(k+1)=\sum_j\omega_{j|m}\left(P_j^{-}+(\hat x_j^{-}-\hat x_m)(\hat x_j^{-}-\hat
        x_m)^{\mathsf T}\right)
        $$

        $$
        \hat x=\sum_m\mu_m\hat x_m,\qquad P=\sum_m\mu_m\left(P_m+(\hat x_m-\hat x)(\hat x_m-\hat
        x)^{\mathsf T}\right)
        $$

        μ are the probabilities of the modes, p the Markov chain, ℓⱼ the likelihood of the delivered
        measurements under mode j. x̂ⱼ⁻, Pⱼ⁻ are the prediction of the Kalman filter of mode j, with
        yᵢ = β̄ᵢ Hᵢⱼ x + αᵢ w plus a noise of variance Rᵢ + σᵢ² E(Hᵢⱼ x)².

    Assumes: one Gaussian a mode after every step, and fading that acts as Gaussian noise.

    Source: H. A. P. Blom and Y. Bar-Shalom, "The interacting multiple model algorithm for
    systems with Markovian switching coefficients", IEEE Trans. Automatic Control 33, 1988; the
    system is from markov_jump.
    """

    unfaded: Array

    @classmethod
    def create(cls, model: AugmentedModel) -> InteractingModels:
        """Return the filter of a plant and its sensors."""
        plant, sensors = model.plant, model.sensors
        n, count = plant.size, sensors.count
        unfaded = sensors.measurement_matrix.transpose(2, 0, 1)
        maps = np.zeros((plant.modes, n + count, n + len(plant.noise_covariance)))
        maps[:, :n, :n] = np.eye(n)
        maps[:, n:, :n] = sensors.fading_mean[:, None] * unfaded
        maps[:, n:, n:] = sensors.noise_coupling[..., 0]
        motion = np.concatenate((plant.transition, plant.process_gain), axis=1)
        return cls(
            model=model,
            maps=maps[..., None],
            motion=np.ascontiguousarray(motion.transpose(2, 0, 1))[..., None],
            unfaded=np.ascontiguousarray(unfaded)[..., None],
        )

    def start(self, runs: int) -> Belief:
        """Return the belief of time 0: the plant's own distributions."""
        plant, n = self.model.plant, self.model.plant.size
        probability = np.broadcast_to(plant.initial_probabilities[:, None], (plant.modes, runs))
        mean = np.broadcast_to(plant.initial_mean, (plant.modes, n, runs))
        covariance = np.broadcast_to(plant.initial_covariance, (plant.modes, n, n, runs))
        return with_noise(probability.copy(), mean, covariance, plant.noise_covariance)

    def predict(self, belief: Belief, time: Times) -> Belief:
        """Return the prediction for ``time`` + 1 from the belief after ``time`` (N,)."""
        xp, chain = namespace(belief.mean), self.model.plant.mode_transition
        moved = linalg.matvec(self.motion, belief.mean)
        spread = linalg.congruence(self.motion, belief.covariance)
        beliefs = []
        for later in range(self.model.plant.modes):
            joint = chain[:, later, None] * belief.probability
            own = linalg.total(joint)
            possible = own > 0.0  # else any weights will do
            weights = xp.where(possible, joint, 1.0 / self.model.plant.modes)
            weights /= xp.where(possible, own, 1.0)
            mixed = linalg.total(weights[:, None] * moved, 0)
            apart = moved - mixed
            second = weights[:, None, None] * (spread + linalg.outer(apart, apart))
            beliefs.append((own, mixed, linalg.total(second, 0)))
        probability, mean, covariance = map(xp.stack, zip(*beliefs, strict=True))
        probability /= linalg.total(probability)
        return with_noise(probability, mean, covariance, self.model.plant.noise_covariance)

    def _variance(self, belief: Belief, time: Times) -> Array:
        """Return variances (M, l, N) of the measurements' independent noises, including fading."""
        n = self.model.plant.size
        mean, covariance = belief.mean[:, :n], belief.covariance[:, :n, :n]
        second = covariance + linalg.outer(mean, mean)
        observed = linalg.quadratic(self.unfaded, second[:, None])
        return self.model.sensors.fading_variance[:, None] * observed + self.model.sensors.variance


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
                "the predicted",
                lambda s: knowledge.sensed(s.prediction).covariance[:n, :n],
            ),
            self.estimate_block(
                "prediction over the state's root mean square",
                lambda s: knowledge.sensed(s.prediction).mean[:n],
            ),
            *((probability,) if isinstance(self.filter, InteractingModels) else ()),
        )

    def start(self, measurement: Array, announcement: None) -> MarkovJumpCentralEstimate:
        """Return the belief of time 0; nothing is measured, and its expectation is held."""
        n, runs = self.model.plant.size, measurement.shape[-1]
        belief, time = self.filter.start(runs), np.zeros(runs, dtype=np.int64)
        mean, covariance = self.filter.estimate(belief)
        held = self.filter.prediction(belief, time).mean[n:, None]
        return MarkovJumpCentralEstimate.begin(held, time, belief, None, mean, covariance)

    def predict(self, state: MarkovJumpCentralEstimate) -> MarkovJumpCentralEstimate:
        """Predict states and measurements."""
        time = state.time + 1
        belief = self.filter.predict(state.belief, state.time)
        return state.later(
            time=time, belief=belief, prediction=self.filter.prediction(belief, time)
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
