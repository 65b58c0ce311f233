"""Transmit when the centre's predicted variance is too large."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fusion_gym import validation
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.policies.base import Requests, Rule, check_at_most, parameter, strongest


@dataclass
class VarianceThreshold(Rule):
    r"""Request when the trace of the fused covariance without transmissions reaches ``threshold``.

    The rule uses no measurement.

    Args:
        threshold: θ >= 0, in squared units of the state.
        at_most: most requests in a step, by the largest reduction of the trace; None for no limit.

    Equation:
        $$
        \mathrm{tr}(W P_\varnothing)\ge\theta\ \Rightarrow\ \delta_i(t)=1\ \text{for the sensors
        of the largest}\ \ \mathrm{tr}(W P_\varnothing)-\mathrm{tr}(W P_{\{i\}})
        $$

        P_∅ is the fused covariance of this step without transmissions, P_{i} with a transmission
        of sensor i only, W the reward's weights of the states, θ ``threshold``; ``at_most`` sensors
        are requested.

    Assumes: claimed covariances that are true.

    Source: after S. Trimpe and R. D'Andrea, "Event-based state estimation with variance-based
    triggering", IEEE Trans. Automatic Control 59, 2014.

    Example: ``variance_threshold:threshold=0.25`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2``.
    """

    threshold: float = parameter(0.1, validation.number, at_least=0.0)
    at_most: int | None = parameter(1, check_at_most)
    knowledge: ClassVar[Knowledge] = "centre"

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        reduction = signals["variance_reduction"]
        due = np.broadcast_to(signals["silent_variance"] >= self.threshold, reduction.shape)
        return strongest(reduction, due, self.at_most, signals["age"])
