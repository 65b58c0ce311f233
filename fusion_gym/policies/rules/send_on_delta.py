"""Send on delta: transmit when the measurement has moved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from fusion_gym import linalg
from fusion_gym.core.system import Knowledge, Signals
from fusion_gym.policies.base import PerSensor, Requests, Rule, not_negative, parameter, shape_of


@dataclass
class SendOnDelta(Rule):
    """Request when |y - last delivered y| >= ``threshold``, in the unit of the measurement.

    Assumes: a centre that holds the last delivered value: the threshold then bounds how far it
    is off.

    Source: M. Miskowicz, "Send-on-delta concept: an event-based data reporting strategy",
    Sensors 6, 2006.
    """

    threshold: PerSensor = parameter(1.0, not_negative)
    knowledge: ClassVar[Knowledge] = "own"

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        moved = signals["measurement"] - signals["held"]
        threshold = self.column("threshold", shape_of(signals)[0])
        return linalg.dot(moved, moved) >= threshold * threshold
