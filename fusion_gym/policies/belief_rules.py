"""Rules that use the beliefs of the scheduler or of each sensor: values, differences, prices."""

from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, cast, get_args

import numpy as np

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.beliefs import Beliefs, Estimate
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.core.memory import Owner
from fusion_gym.core.task import Task
from fusion_gym.envs.views import SensorView
from fusion_gym.errors import forbidden
from fusion_gym.namespace import namespace
from fusion_gym.policies.base import (
    THRESHOLD,
    PerSensor,
    Requests,
    Rule,
    SearchRange,
    check_at_most,
    check_price,
    each_number,
    not_negative_parameter,
    parameter,
    strongest,
    surprise,
)
from fusion_gym.validation import boolean, refusal


@dataclass
class BeliefRule(Rule):
    """A rule on the beliefs of the scheduler, or with ``own`` on the beliefs of each sensor.

    ``together`` names the parameters that compare sensors, which ``own`` excludes.
    """

    task: Task = field(repr=False)
    own: bool = parameter(False, boolean)
    together: ClassVar[tuple[str, ...]] = ("at_most",)

    def __post_init__(self) -> None:
        super().__post_init__()
        only = {name: getattr(self, name) for name in self.together}
        check_owner(self.task, self.own, **only)
        self.memory_owner: Owner | None = "own" if self.own else "scheduler"

    @property
    def knowledge(self) -> Knowledge:
        """The knowledge class, by the task's memory and by ``own``."""
        return knows(self.task, self.own)

    def beliefs(self, signals: Signals) -> Beliefs:
        """Return the beliefs of the scheduler, or of each sensor."""
        return beliefs_of(signals, self.own)


def knows(task: Task, own: bool) -> Knowledge:
    """Return the knowledge class of a rule on beliefs, in a task with or without memory."""
    if task.options.memory:
        return "own_memory" if own else "scheduler_memory"
    return "own" if own else "scheduler"


def check_owner(task: Task, own: bool, **only_together: Any) -> None:
    """Check that a task shows the measurements, and with ``own`` allows local decisions."""
    if task.options.information != "sensors":
        allowed = "'sensors', because it reads new measurements"
        raise refusal("information", task.options.information, allowed, "with this rule")
    if not own:
        return
    SensorView(task)  # refuses tasks without local decisions
    for name, value in only_together.items():
        if value not in (None, 0, 1):
            raise refusal(name, value, "left out with own=True, because sensors decide locally")


def beliefs_of(signals: Signals, own: bool) -> Beliefs:
    """Return the beliefs of the scheduler, or of each sensor."""
    result: Any = signals["own_beliefs" if own else "beliefs"]
    return result


def check_threshold(name: str, value: PerSensor | None) -> None:
    """Check numbers >= 0, or None."""
    if value is not None:
        not_negative_parameter(name, value)


@dataclass
class ValueOfInformation(BeliefRule):
    r"""Request the sensors whose packet has a value of at least ``threshold``, or of its price.

    The value is v(s) = ‖x* - x̂‖² - E‖x* - x̂(s)‖². x* is the best estimate, x̂ the centre's estimate
    without transmissions and x̂(s) its estimate after the packet of s only
    (:mod:`fusion_gym.core.beliefs`). With memory x* uses all unsent measurements, without memory
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

    Sources: :mod:`fusion_gym.core.beliefs` lists them.

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
    (:mod:`fusion_gym.core.beliefs`). The norm has the weights of the reward, scaled to a mean of 1,
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
        :class:`ValueOfInformation`; ``at_most`` sensors are requested. With ``own`` every sensor
        compares its own x* and x̂.

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


Score = Literal["value", "innovation", "variance"]


def _power(
    deviation: float, low: float = -3.0, high: float = 3.0, per_sensor: bool = False
) -> SearchRange:
    return SearchRange(low, high, per_sensor, logarithmic=False, deviation=deviation)


_SHARE = _power(0.1, 0.0, 1.0)
_THRESHOLD = SearchRange(0.0, np.inf, deviation=0.15)
_MARGIN = SearchRange(1.0, float(np.exp(4.0)), per_sensor=False, deviation=0.15)


@dataclass
class PricedThreshold(BeliefRule):
    r"""Request where a mixture of value and loss reaches a threshold that depends on the price.

    A search (:mod:`fusion_gym.evaluation.rule_search`) sets its dozen parameters for all prices at
    once, instead of one threshold for each price.

    Args:
        own: every sensor decides locally, by its memory and the broadcasts.
        score: v and l. ``"value"``: the expected value of a packet and the squared norm of x* - x̂
            (:mod:`fusion_gym.core.beliefs`). ``"innovation"``: the squared norm of the innovation,
            v in predicted standard deviations, l in the unit of the measurement. ``"variance"``:
            the reduction of the fused trace by a packet, and the trace without packets, both
            predicted by the centre.
        threshold: θ >= 0 at the reference price, for all sensors or for each, in the unit of the
            score.
        price_exponent: β, for all sensors or for each; 1 is proportional to the price.
        price: price of a token; None for the price in the reward, which an episode may draw.
        reference_price: p₀ > 0.
        mixture: m, from 0 (v only) to 1 (l only).
        token_exponent: κ; above 0 few tokens lower the threshold, below 0 they raise it.
        age_exponent: α; above 0 a long silence raises the threshold, below 0 it lowers it.
        margin: s >= 1, the factor by which each further sensor in the same step must exceed its
            threshold at the reference price; 1 for no margin.
        margin_exponent: μ; above 0 the margin grows with the price, and is never below 1.

    Raises:
        ConfigurationError: a value that is not allowed, a margin with ``own``, ``own`` with the
            variance, or, except with the variance, a task whose policies do not see the sensors.

    Equation:
        $$
        r_i=\frac{v_i^{1-m}\,l^m}{\theta_i}\left(\frac{p}{p_0}\right)^{-\beta_i}
        \left(\frac{b+1}{\bar b+1}\right)^{-\kappa}\left(\frac{a_i+1}{6}\right)^{-\alpha},\qquad
        \delta_i(t)=1\iff v_i>0,\ r_i\ge\max\{1,s\,(p/p_0)^\mu\}^{k_i}
        $$

        vᵢ and l are the ``score``, p is the price of a token, b the tokens and b̄ their capacity
        (the ratio is 1 where tokens are unlimited). aᵢ are the steps since the last delivery, kᵢ is
        the number of sensors with a larger r in this step. θ is ``threshold``, β
        ``price_exponent``, p₀ ``reference_price``, m ``mixture``, κ ``token_exponent``, α
        ``age_exponent``, s ``margin``, μ ``margin_exponent``.

    Assumes: the assumptions of the rule of its score, ``value_of_information``,
    ``innovation_threshold`` or ``variance_threshold``; numbers that were searched for this task.

    Source: none; the scores are from these three rules, the powers from this library.

    Example: ``priced_threshold:threshold=0.03,reference_price=0.02`` in
    ``fusion_gym/TobitOscillator-v1 filter=tobit random_start=True token_rate=2 cost_weight=0.01
    memory=True``.
    """

    score: Score = parameter("value", validation.choice, options=get_args(Score))
    threshold: PerSensor = parameter(0.03, not_negative_parameter, _THRESHOLD)
    price_exponent: PerSensor = parameter(1.0, each_number, _power(0.075, -1.0, 4.0, True))
    price: float | None = parameter(None, check_price)
    reference_price: float = parameter(1.0, validation.number, above=0.0)
    mixture: float = parameter(0.0, validation.number, _SHARE, at_least=0.0, at_most=1.0)
    token_exponent: float = parameter(0.0, validation.number, _power(0.15))
    age_exponent: float = parameter(0.0, validation.number, _power(0.1))
    margin: float = parameter(1.0, validation.number, _MARGIN, at_least=1.0)
    margin_exponent: float = parameter(0.0, validation.number, _power(0.075))
    together: ClassVar[tuple[str, ...]] = ("margin", "margin_exponent")
    stateless: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.score == "variance":
            Rule.__post_init__(self)
            if self.own:
                raise validation.refusal("own", self.own, "false with score='variance'")
        else:
            super().__post_init__()
        if self.score != "value":
            self.memory_owner = None

    @property
    def knowledge(self) -> Knowledge:
        """The knowledge class, by the score, the task's memory and the comparison of sensors."""
        if self.score == "innovation":
            return "scheduler" if self.margin != 1.0 or self.margin_exponent else "own"
        return "centre" if self.score == "variance" else super().knowledge

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        return self.log_ratio(signals) >= 0.0

    def log_ratio(self, signals: Signals) -> Array:
        """Return ln r - k ln max{1, s (p/p0)^μ} (sensors, N); a request is at least 0."""
        value, loss = self._scores(signals)
        bucket, sensors = self.task.network.bucket, len(value)
        xp = namespace(value)
        age = xp.maximum(signals["age"], 0.0)
        price = signals["price"] if self.price is None else np.asarray(self.price)
        level = signals["energy" if bucket.per_sensor else "tokens"]
        tokens = (level + 1.0) / (bucket.capacity + 1.0)
        log_price = _log(price / self.reference_price)
        least = _log(self.column("threshold", sensors))
        least = least + self.column("price_exponent", sensors) * log_price
        if not bucket.unlimited:
            least = least + self.token_exponent * xp.log(tokens)
        least = least + self.age_exponent * xp.log((age + 1.0) / 6.0)
        score = (1.0 - self.mixture) * _log(value) + self.mixture * _log(loss)
        ratio = xp.where(value > 0.0, score - least, -np.inf)
        margin = xp.maximum(_log(self.margin) + self.margin_exponent * log_price, 0.0)
        if xp is not np or margin.any():
            rank = xp.argsort(xp.lexsort((-age, -ratio), axis=0), axis=0)
            ratio = ratio - rank * margin
        return cast(Array, ratio)

    def _scores(self, signals: Signals) -> tuple[Array, Array]:
        """Return the two scores v (sensors, N) and l (…, N)."""
        if self.score == "innovation":
            return surprise(signals, whitened=True), surprise(signals)
        if self.score == "variance":
            return signals["variance_reduction"], signals["silent_variance"]
        beliefs = self.beliefs(signals)
        return beliefs.value, beliefs.loss


def _log(values: Any) -> Array:
    """Return ln of values >= 0, finite at 0."""
    xp = namespace(values)
    result: Array = xp.log(xp.maximum(values, 1e-300))
    return result
