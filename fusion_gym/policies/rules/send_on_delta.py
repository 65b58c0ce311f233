"""Send on delta: transmit when the measurement has moved."""

from __future__ import annotations

from dataclasses import dataclass

from fusion_gym import linalg
from fusion_gym.core.system import Signals
from fusion_gym.policies.base import (
    PerSensor,
    Requests,
    Trigger,
    check_not_negative,
    column,
    shape_of,
)


@dataclass
class SendOnDelta(Trigger):
    """Request when |y - last delivered y| >= ``threshold``, in the unit of the measurement.

    Source: M. Miskowicz, "Send-on-delta concept: an event-based data reporting strategy",
    Sensors 6, 2006.
    """

    threshold: PerSensor = 1.0

    def __post_init__(self) -> None:
        check_not_negative("threshold", self.threshold)

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        moved = signals["measurement"] - signals["held"]
        threshold = column("threshold", self.threshold, shape_of(signals)[0])
        return linalg.dot(moved, moved) >= threshold * threshold
