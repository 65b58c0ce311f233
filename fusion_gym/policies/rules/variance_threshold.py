"""Transmit when the centre's own uncertainty is too large."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fusion_gym import validation
from fusion_gym.core.system import Knowledge, Signals
from fusion_gym.policies.base import Requests, Rule, check_at_most, parameter, strongest


@dataclass
class VarianceThreshold(Rule):
    """Request when the fused covariance without any transmission would have a trace >= threshold.

    ``threshold`` is in squared units of the state. The ``at_most`` sensors that would reduce the
    trace most are requested (None: all). It looks at no measurement.

    Assumes: claimed covariances that are true; what was measured plays no part.

    Source: after S. Trimpe and R. D'Andrea, "Event-based state estimation with variance-based
    triggering", IEEE Trans. Automatic Control 59, 2014.
    """

    threshold: float = parameter(0.1, validation.number, at_least=0.0)
    at_most: int | None = parameter(1, check_at_most)
    knowledge: ClassVar[Knowledge] = "centre"

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        reduction = signals["variance_reduction"]
        due = np.broadcast_to(signals["silent_variance"] >= self.threshold, reduction.shape)
        return strongest(reduction, due, self.at_most, signals["age"])
