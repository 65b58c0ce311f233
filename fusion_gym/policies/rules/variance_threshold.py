"""Transmit when the centre's own uncertainty is too large."""

from __future__ import annotations

from dataclasses import dataclass

from fusion_gym import validation
from fusion_gym.core.system import Signals
from fusion_gym.policies.base import Requests, Trigger, check_at_most, shape_of, strongest


@dataclass
class VarianceThreshold(Trigger):
    """Request when the fused covariance without any transmission would have a trace >= threshold.

    ``threshold`` is in squared units of the state. The ``at_most`` sensors that would reduce the
    trace most are requested (None: all). It looks at no measurement.

    Source: after S. Trimpe and R. D'Andrea, "Event-based state estimation with variance-based
    triggering", IEEE Trans. Automatic Control 59, 2014.
    """

    threshold: float = 0.1
    at_most: int | None = 1

    def __post_init__(self) -> None:
        validation.number("threshold", self.threshold, at_least=0.0)
        check_at_most(self.at_most)

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        due = (signals["silent_variance"] >= self.threshold)[None].repeat(
            shape_of(signals)[0], axis=0
        )
        return strongest(signals["variance_reduction"], due, self.at_most, signals["age"])
