"""Interacting multiple models: one Kalman filter a mode, mixed by the mode's probabilities.

Source: H. A. P. Blom and Y. Bar-Shalom, "The interacting multiple model algorithm for systems with
Markovian switching coefficients", IEEE Trans. Automatic Control 33, 1988; the system is from
markov_jump.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.namespace import namespace
from fusion_gym.systems.markov_jump.centralised_linear import (
    Belief,
    ModePrediction,
    condition_on,
    mode_mixture,
    predict_jointly,
    with_noise,
)
from fusion_gym.systems.markov_jump.linear_minimum_variance import Times
from fusion_gym.systems.markov_jump.plant import MarkovJumpPlant
from fusion_gym.systems.markov_jump.sensors import FadingSensors


@dataclass(frozen=True)
class InteractingModels:
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

    plant: MarkovJumpPlant
    sensors: FadingSensors
    maps: Array
    motion: Array
    unfaded: Array

    @classmethod
    def create(cls, plant: MarkovJumpPlant, sensors: FadingSensors) -> InteractingModels:
        """Return the filter of a plant and its sensors."""
        n, count = plant.size, sensors.count
        unfaded = sensors.measurement_matrix.transpose(2, 0, 1)
        maps = np.zeros((plant.modes, n + count, n + len(plant.noise_covariance)))
        maps[:, :n, :n] = np.eye(n)
        maps[:, n:, :n] = sensors.fading_mean[:, None] * unfaded
        maps[:, n:, n:] = sensors.noise_coupling[..., 0]
        motion = np.concatenate((plant.transition, plant.process_gain), axis=1)
        return cls(
            plant=plant,
            sensors=sensors,
            maps=maps[..., None],
            motion=np.ascontiguousarray(motion.transpose(2, 0, 1))[..., None],
            unfaded=np.ascontiguousarray(unfaded)[..., None],
        )

    def start(self, runs: int) -> Belief:
        """Return the belief of time 0: the plant's own distributions."""
        plant, n = self.plant, self.plant.size
        probability = np.broadcast_to(plant.initial_probabilities[:, None], (plant.modes, runs))
        mean = np.broadcast_to(plant.initial_mean, (plant.modes, n, runs))
        covariance = np.broadcast_to(plant.initial_covariance, (plant.modes, n, n, runs))
        return with_noise(probability.copy(), mean, covariance, plant.noise_covariance)

    def predict(self, belief: Belief, time: Times) -> Belief:
        """Return the prediction for ``time`` + 1 from the belief after ``time`` (N,)."""
        xp, chain = namespace(belief.mean), self.plant.mode_transition
        moved = linalg.matvec(self.motion, belief.mean)
        spread = linalg.congruence(self.motion, belief.covariance)
        beliefs = []
        for later in range(self.plant.modes):
            joint = chain[:, later, None] * belief.probability
            own = linalg.total(joint)
            possible = own > 0.0  # else any weights will do
            weights = xp.where(possible, joint, 1.0 / self.plant.modes)
            weights /= xp.where(possible, own, 1.0)
            mixed = linalg.total(weights[:, None] * moved, 0)
            apart = moved - mixed
            second = weights[:, None, None] * (spread + linalg.outer(apart, apart))
            beliefs.append((own, mixed, linalg.total(second, 0)))
        probability, mean, covariance = map(xp.stack, zip(*beliefs, strict=True))
        probability /= linalg.total(probability)
        return with_noise(probability, mean, covariance, self.plant.noise_covariance)

    def prediction(self, belief: Belief, time: Times) -> ModePrediction:
        """Return the prediction of plant and measurements for ``time`` (N,)."""
        return predict_jointly(belief, self.maps, self._variance(belief))

    def update(
        self, belief: Belief, measurement: Array, taken: NDArray[np.bool_], time: Times
    ) -> Belief:
        """Return the belief after the ``taken`` (l, N) of the measurements (l, N)."""
        rows, variance = self.maps[:, self.plant.size :], self._variance(belief)
        after, likelihood = condition_on(belief, rows, variance, measurement, taken)
        # The likeliest possible model has weight one, so that far tails do not make 0 / 0.
        xp = namespace(likelihood)
        possible = xp.where(belief.probability > 0.0, likelihood, -np.inf)
        weights = belief.probability * xp.exp(possible - possible.max(0))
        return after._replace(probability=weights / linalg.total(weights))

    def estimate(self, belief: Belief) -> tuple[Array, Array]:
        """Return mean (n, N) and covariance (n, n, N) of the plant's state, over all modes."""
        return mode_mixture(belief, self.maps[:, : self.plant.size])

    def _variance(self, belief: Belief) -> Array:
        """Return variances (M, l, N) of the measurements' independent noises, including fading."""
        n = self.plant.size
        mean, covariance = belief.mean[:, :n], belief.covariance[:, :n, :n]
        second = covariance + linalg.outer(mean, mean)
        observed = linalg.quadratic(self.unfaded, second[:, None])
        return self.sensors.fading_variance[:, None] * observed + self.sensors.variance
