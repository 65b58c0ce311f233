"""Transmit when the centre's densities with and without a packet diverge."""

from dataclasses import dataclass

import numpy as np

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.beliefs import Estimate
from fusion_gym.core.knowledge import Signals
from fusion_gym.policies.base import Requests, check_at_most, parameter, strongest
from fusion_gym.policies.belief_rule import BeliefRule


@dataclass
class KullbackLeibler(BeliefRule):
    r"""Request where a packet's divergence of the centre's density is at least ``threshold`` nats.

    D(s) = ½ (tr P⁻¹ P_s - n + δᵀ P⁻¹ δ + ln det P - ln det P_s), with δ = x̂(s) - x̂, is the
    divergence from N(x̂(s), P_s) to N(x̂, P). The former is the centre's density after the packet of
    s only, the latter its prediction. With ``own`` the best estimate x*, which has the sensor's
    memory, replaces x̂(s). D counts a reduction of the variance even if the mean does not change.

    Args:
        own: every sensor decides locally, by its memory and the broadcasts.
        threshold: θ >= 0, in nats.
        at_most: most requests in a step, by the highest divergence; None for no limit.

    Raises:
        ConfigurationError: a value that is not allowed, ``at_most`` with ``own``, or a task whose
            policies do not see the sensors.

    Equation:
        $$
        D(s)=\frac{1}{2}\left(\mathrm{tr}(P^{-1}P_s)-n+\delta^{\mathsf
        T}P^{-1}\delta+\ln\frac{\det P}{\det P_s}\right)\ge\theta,\qquad \delta=\hat x(s)-\hat x
        $$

        N(x̂, P) is the centre's density without transmissions, N(x̂(s), P_s) after the packet of s
        only, n the number of states, θ ``threshold`` in nats.

    Assumes: Gaussian densities, and claimed covariances that are true.

    Source: J. W. Marck and J. Sijs, "Relevant sampling applied to event-based state-estimation",
    SENSORCOMM 2010.

    Example: ``kullback_leibler:threshold=0.8,at_most=1`` in ``fusion_gym/TobitOscillator-v1
    filter=tobit random_start=True token_rate=2 memory=True``.
    """

    threshold: float = parameter(0.5, validation.number, at_least=0.0)
    at_most: int | None = parameter(None, check_at_most)

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        beliefs = self.beliefs(signals)
        divergence = _divergence(beliefs.best if self.own else beliefs.sent, beliefs.silent)
        return strongest(divergence, divergence >= self.threshold, self.at_most, signals["age"])


def _divergence(estimate: Estimate, silent: Estimate) -> Array:
    """Return the divergence from one Gaussian to another, in nats (sensors, N)."""
    difference = estimate.mean - silent.mean
    size = difference.shape[-2]
    spread = linalg.trace(linalg.solve(silent.covariance, estimate.covariance))
    distance = linalg.dot(difference, linalg.solve_vector(silent.covariance, difference))
    volume = _log_determinant(silent.covariance) - _log_determinant(estimate.covariance)
    return 0.5 * (spread - size + distance + volume)


def _log_determinant(covariance: Array) -> Array:
    return 2.0 * linalg.total(np.log(linalg.diagonal(linalg.cholesky(covariance))))
