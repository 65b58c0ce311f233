"""Linear minimum-variance filter of a centre that receives measurements.

It shares with the interacting models the beliefs about state and noise, their update with any of
the measurements, and the prediction of measurements.

Source: markov_jump (event-triggered distributed fusion estimation for asynchronous Markov jump
systems with correlated noises and fading measurements), for all sensors at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.namespace import namespace, set_at, take, update_at
from fusion_gym.systems.markov_jump.linear_minimum_variance import (
    LONGEST,
    ROUNDING,
    AugmentedModel,
    Times,
    settled,
)

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


def predict_jointly(belief: Belief, maps: Array, variance: Array) -> ModePrediction:
    """Return the prediction with ``maps`` (M, n + l, s, 1) and noise ``variance`` (M, l, N)."""
    mean, covariance = mode_mixture(belief, maps)
    own, sensors = linalg.total(belief.probability[:, None] * variance, 0), variance.shape[1]
    for sensor in range(sensors):
        place = len(mean) - sensors + sensor
        covariance = update_at(np.add, covariance, (..., place, place, _ALL), own[sensor])
    return ModePrediction(mean, covariance)


@dataclass(frozen=True)
class CentralisedLinearFilter:
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

    model: AugmentedModel
    maps: Array
    motion: Array
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

    def prediction(self, belief: Belief, time: Times) -> ModePrediction:
        """Return the prediction of plant and measurements for ``time`` (N,)."""
        return predict_jointly(belief, self.maps, self._variance(time))

    def update(
        self, belief: Belief, measurement: Array, taken: NDArray[np.bool_], time: Times
    ) -> Belief:
        """Return the belief after the ``taken`` (l, N) of the measurements (l, N)."""
        rows = self.maps[:, self.model.plant.size :]
        return condition_on(belief, rows, self._variance(time), measurement, taken)[0]

    def estimate(self, belief: Belief) -> tuple[Array, Array]:
        """Return mean (n, N) and covariance (n, n, N) of the plant's state."""
        return mode_mixture(belief, self.maps[:, : self.model.plant.size])

    def _variance(self, time: Times) -> Array:
        return take(self.variance, self._at(time))[None]

    def _at(self, time: Times) -> Times:
        return namespace(time).minimum(time, self.variance.shape[-1] - 1)
