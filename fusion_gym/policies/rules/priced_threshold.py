"""Transmit above a threshold that depends on price, tokens and age."""

from dataclasses import dataclass
from typing import Any, ClassVar, Literal, cast, get_args

import numpy as np

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.namespace import namespace
from fusion_gym.policies.base import (
    PerSensor,
    Requests,
    Rule,
    SearchRange,
    check_price,
    each_number,
    not_negative_parameter,
    parameter,
    surprise,
)
from fusion_gym.policies.belief_rule import BeliefRule

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
            (:mod:`fusion_gym.core.memory`). ``"innovation"``: the squared norm of the innovation,
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
