"""Rules that use the beliefs of the scheduler or of each sensor."""

from dataclasses import dataclass
from typing import Any, ClassVar

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.knowledge import Signals
from fusion_gym.core.memory import Beliefs, Estimate
from fusion_gym.errors import forbidden
from fusion_gym.namespace import namespace
from fusion_gym.policies.base import (
    THRESHOLD,
    PerSensor,
    Requests,
    check_at_most,
    check_price,
    not_negative_parameter,
    parameter,
    strongest,
)
from fusion_gym.policies.belief_rule import BeliefRule


def check_threshold(name: str, value: PerSensor | None) -> None:
    """Check numbers >= 0, or None."""
    if value is not None:
        not_negative_parameter(name, value)


@dataclass
class ValueOfInformation(BeliefRule):
    r"""Request the sensors whose packet has a value of at least ``threshold``, or of its price.

    The value is v(s) = ‖x* - x̂‖² - E‖x* - x̂(s)‖². x* is the best estimate, x̂ the centre's estimate
    without transmissions and x̂(s) its estimate after the packet of s only
    (:mod:`fusion_gym.core.memory`). With memory x* uses all unsent measurements, without memory
    the measurements of this step. The norm has the weights of the reward, scaled to a mean of 1. In
    most settings this is the strongest rule, above all with memory.

    Args:
        own: every sensor decides locally, by its memory and the broadcasts.
        threshold: θ >= 0, for all sensors or for each, in squared units of the states; 0.03 without
            a price.
        price: price of a token in the reward's units, instead of the threshold.
        at_most: most requests in a step, by the highest value; None for no limit.

    Raises:
        ConfigurationError: both thresholds, a value that is not allowed, ``at_most`` with
            ``own``, or a task whose policies do not see the sensors.

    Equation:
        $$
        v(s)=\lVert x^\star-\hat x\rVert_W^2-\mathrm{E}\,\lVert x^\star-\hat x(s)\rVert_W^2,\qquad
        \delta_s(t)=1\Rightarrow v(s)\ge\theta
        $$

        x* is the best estimate, x̂ the centre's estimate without transmissions, x̂(s) its estimate
        after a transmission of s only; the expectation is over the packet's arrival. W are the
        reward's weights with mean 1, θ is ``threshold``. With ``price`` p instead, v in the
        reward's units must reach p times the tokens of the transmission. With ``at_most``, the
        sensors of the highest value are requested.

    Assumes: x* is the conditional mean given the knowledge of its owner, and only this step counts.

    Sources: :mod:`fusion_gym.core.memory` lists them.

    Example: ``value_of_information:threshold=0.03,at_most=1`` in ``fusion_gym/TobitOscillator-v1
    filter=tobit random_start=True token_rate=2 memory=True``.
    """

    threshold: PerSensor | None = parameter(None, check_threshold, THRESHOLD)
    price: float | None = parameter(None, check_price)
    at_most: int | None = parameter(None, check_at_most)
    stateless: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.threshold is not None and self.price is not None:
            reason = "leave one of them out"
            raise forbidden("price", self.price, reason, f"with threshold = {self.threshold}")

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        value = self.beliefs(signals).value
        if self.price is None:
            least: Any = 0.03 if self.threshold is None else self.column("threshold", len(value))
        else:
            value = self.task.error_scale * value
            least = self.price * signals["token_cost"]
        return strongest(value, value >= least, self.at_most, signals["age"])


@dataclass
class EstimateDifference(BeliefRule):
    r"""Request the sensors of the highest value when ‖x* - x̂‖ >= ``threshold``.

    x* is the best estimate and x̂ the centre's estimate without transmissions
    (:mod:`fusion_gym.core.memory`). The norm has the weights of the reward, scaled to a mean of 1,
    and the unit of the states. With ``own`` and without memory it is the change of the estimate by
    the sensor's own measurement.

    Args:
        own: every sensor decides locally, by its memory and the broadcasts.
        threshold: θ >= 0, for all sensors or for each, in the unit of the states or without one.
        whitened: weigh by the inverse of the centre's claimed covariance.
        at_most: most requests in a step, by the highest value; None for no limit.

    Raises:
        ConfigurationError: a value that is not allowed, ``at_most`` with ``own``, or a task whose
            policies do not see the sensors.

    Equation:
        $$
        \lVert x^\star-\hat x\rVert_W\ge\theta\ \Rightarrow\ \text{request the sensors of the
        highest value}\ v(s)
        $$

        x* is the best estimate, x̂ the centre's estimate without transmissions, W the reward's
        weights with mean 1 (with ``whitened`` P⁻¹, P the centre's covariance of x̂), θ
        ``threshold``, v as in
        :class:`~fusion_gym.policies.rules.beliefs.ValueOfInformation`; ``at_most``
        sensors are requested. With ``own`` every sensor compares its own x* and x̂.

    Assumes: x* is the conditional mean given the knowledge of its owner. The squared error is then
    the squared error of x*, which no decision changes, plus the squared difference.

    Sources: Y. Xu and J. P. Hespanha, "Optimal communication logics in networked control systems",
    IEEE CDC 2004; G. M. Lipsa and N. C. Martins, "Remote state estimation with communication costs
    for first-order LTI systems", IEEE Trans. Automatic Control 56, 2011.

    Example: ``estimate_difference:threshold=0.25`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2 memory=True``.
    """

    threshold: PerSensor = parameter(0.2, not_negative_parameter, THRESHOLD)
    whitened: bool = parameter(False, validation.boolean)
    at_most: int | None = parameter(1, check_at_most)
    stateless: ClassVar[bool] = True

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        beliefs, age = self.beliefs(signals), signals["age"]
        squared = _whitened(beliefs) if self.whitened else beliefs.loss
        due = squared >= self.column("threshold", len(age)) ** 2
        requests = namespace(due).broadcast_to(due, age.shape)
        if self.own or self.at_most is None:
            return requests.copy()
        return strongest(beliefs.value, requests, self.at_most, age)


def _whitened(beliefs: Beliefs) -> Array:
    """Return (x* - x̂)ᵀ P⁻¹ (x* - x̂), with P the centre's covariance of x̂ (k, N)."""
    difference, covariance = beliefs.difference, beliefs.silent.covariance
    return linalg.dot(difference, linalg.solve_vector(covariance, difference))


@dataclass
class KullbackLeibler(BeliefRule):
    r"""Request where a packet's divergence of the centre's density is at least ``threshold`` nats.

    D(s) = ½ (tr P⁻¹ P_s - n + δᵀ P⁻¹ δ + ln det P - ln det P_s), with δ = x̂(s) - x̂, is the
    divergence from N(x̂(s), P_s) to N(x̂, P). The former is the centre's density after the packet of
    s only, the latter its prediction. With ``own`` the best estimate x*, which has the sensor's
    memory, replaces x̂(s). D counts a reduction of the variance even if the mean does not change.

    Args:
        own: every sensor decides locally, by its memory and the broadcasts.
        threshold: θ >= 0, for all sensors or for each, in nats.
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

    threshold: PerSensor = parameter(0.5, not_negative_parameter, THRESHOLD)
    at_most: int | None = parameter(None, check_at_most)
    stateless: ClassVar[bool] = True

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        beliefs = self.beliefs(signals)
        divergence = _divergence(beliefs.best if self.own else beliefs.sent, beliefs.silent)
        due = divergence >= self.column("threshold", len(divergence))
        return strongest(divergence, due, self.at_most, signals["age"])


def _divergence(estimate: Estimate, silent: Estimate) -> Array:
    """Return the divergence from one Gaussian to another, in nats (sensors, N)."""
    difference = estimate.mean - silent.mean
    size = difference.shape[-2]
    spread = linalg.trace(linalg.solve(silent.covariance, estimate.covariance))
    distance = linalg.dot(difference, linalg.solve_vector(silent.covariance, difference))
    volume = _log_determinant(silent.covariance) - _log_determinant(estimate.covariance)
    return 0.5 * (spread - size + distance + volume)


def _log_determinant(covariance: Array) -> Array:
    root = linalg.diagonal(linalg.cholesky(covariance))
    return 2.0 * linalg.total(namespace(root).log(root))
