"""Greedy choice by the predicted reduction of variance per token."""

from dataclasses import dataclass
from typing import ClassVar

from fusion_gym import validation
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.policies.base import Requests, Rule, check_at_most, parameter, strongest


@dataclass
class InformationGain(Rule):
    r"""Request where the relative reduction of the fused trace per token is >= ``threshold``.

    The reduction is the effect of a single delivery from this sensor, relative to the trace without
    deliveries. It does not depend on the measurement.

    Args:
        threshold: θ >= 0, the least relative reduction per token.
        at_most: most requests in a step, by the highest gain; None for no limit.

    Equation:
        $$
        g_i=\frac{\mathrm{tr}(W P_\varnothing)-\mathrm{tr}(W P_{\{i\}})}{c_i\ \mathrm{tr}(W
        P_\varnothing)},\qquad \delta_i(t)=1\Rightarrow g_i\ge\theta
        $$

        The rule requests the ``at_most`` sensors of the highest gain that reach θ (``threshold``).
        P_∅ is the fused covariance of this step without transmissions, P_{i} with a transmission
        of sensor i only, W the reward's weights of the states, c the tokens of a transmission.

    Assumes: claimed covariances that are true, and that only the next step counts.

    Source: none; the greedy choice of sensors by predicted variance, here per token.

    Example: ``information_gain:threshold=0.2`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2``.
    """

    threshold: float = parameter(0.05, validation.number, at_least=0.0)
    at_most: int | None = parameter(1, check_at_most)
    knowledge: ClassVar[Knowledge] = "centre"

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        relative = signals["variance_reduction"] / signals["silent_variance"]
        gain = relative / signals["token_cost"]
        return strongest(gain, gain >= self.threshold, self.at_most, signals["age"])
