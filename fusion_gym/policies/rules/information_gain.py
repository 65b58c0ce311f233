"""Greedy choice by predicted reduction of variance per token."""

from dataclasses import dataclass
from typing import ClassVar

from fusion_gym import validation
from fusion_gym.core.system import Knowledge, Signals
from fusion_gym.policies.base import Requests, Rule, check_at_most, parameter, strongest


@dataclass
class InformationGain(Rule):
    r"""Request where the relative reduction of the fused trace per token is >= ``threshold``.

    The reduction is that of a delivery from this sensor alone, relative to the trace without any
    delivery; it does not depend on the measurement.

    Args:
        threshold: θ >= 0, the least relative reduction for each token.
        at_most: most sensors requested in a step, those of the highest gain; None for no limit.

    Equation:
        $$
        g_i=\frac{\mathrm{tr}(W P_\varnothing)-\mathrm{tr}(W P_{\{i\}})}{c_i\ \mathrm{tr}(W
        P_\varnothing)},\qquad \delta_i(t)=1\Rightarrow g_i\ge\theta
        $$

        Of those that reach θ (``threshold``), the ``at_most`` of the highest gain. P_∅ is the fused
        covariance of this step if nobody transmits and P_{i} if sensor i alone does, W the reward's
        weights of the states, c the tokens that a transmission costs.

    Assumes: claimed covariances that are true, and that what counts is the next step alone.

    Source: none; the greedy choice of sensors by predicted variance, here in proportion to the
    tokens that it costs.

    Example: ``information_gain:threshold=0.2`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2``.
    """

    threshold: float = parameter(0.05, validation.number, at_least=0.0)
    at_most: int | None = parameter(1, check_at_most)
    knowledge: ClassVar[Knowledge] = "centre"

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        relative = signals["variance_reduction"] / signals["silent_variance"]
        gain = relative / signals["token_cost"]
        return strongest(gain, gain >= self.threshold, self.at_most, signals["age"])
