"""Transmit until the centre's predicted variance is small enough."""

from dataclasses import dataclass
from typing import ClassVar

from fusion_gym import validation
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.policies.base import Requests, Rule, check_at_most, parameter, strongest


@dataclass
class CentreVariance(Rule):
    r"""Request the fewest sensors, by greedy choice, that bring the fused trace below a threshold.

    The trace is the trace of the fused covariance after the step, in squared units of the state.
    While it is at least θ, the rule adds the sensor that lowers it most. The rule uses no
    measurement, so without a token limit it is a schedule.

    Unlike the rule ``variance_threshold`` it uses the unweighted trace and the joint effect of
    several packets.

    Args:
        threshold: θ >= 0, in squared units of the state.
        at_most: most sensors requested in a step; None for no limit.

    Equation:
        $$
        S_0=\varnothing,\qquad
        S_{k+1}=S_k\cup\{\arg\min_{s}\ \mathrm{tr}\,P_{S_k\cup\{s\}}\}\quad\text{while}\quad
        \mathrm{tr}\,P_{S_k}\ge\theta
        $$

        The rule requests the last of these sets. P_S is the fused covariance of this step after the
        packets of S, θ is ``threshold``; at most ``at_most`` sensors are added.

    Assumes: claimed covariances that are true.

    Source: the threshold is from S. Trimpe and R. D'Andrea, "Event-based state estimation with
    variance-based triggering", IEEE Trans. Automatic Control 59, 2014; the greedy choice is from
    this library.

    Example: ``centre_variance:threshold=2.5`` in ``fusion_gym/MarkovJumpTracking-v1``.
    """

    threshold: float = parameter(1.6, validation.number, at_least=0.0)
    at_most: int | None = parameter(None, check_at_most)
    knowledge: ClassVar[Knowledge] = "centre"

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        before = signals["greedy_variance"]
        return strongest(before, before >= self.threshold, self.at_most, signals["age"])
