"""Time-triggered policies: they look at the clock alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fusion_gym import validation
from fusion_gym.core.system import Knowledge, Signals
from fusion_gym.policies.base import Requests, Rule, parameter, shape_of


@dataclass
class Periodic(Rule):
    """Every sensor requests once in ``period`` steps.

    ``staggered`` spreads the sensors over the period; otherwise all request together.

    Assumes: nothing; it looks at the clock alone.

    Source: none; what an event trigger is usually compared with.
    """

    period: int = parameter(4, validation.integer, at_least=1)
    staggered: bool = parameter(True, validation.boolean)
    knowledge: ClassVar[Knowledge] = "clock"

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        sensors, _ = shape_of(signals)
        phase = np.arange(sensors) * self.period // sensors if self.staggered else np.zeros(sensors)
        return (signals["step"] - phase[:, None]) % self.period == 0


@dataclass
class RoundRobin(Rule):
    """One sensor after another, the next one every ``period`` steps.

    Assumes: nothing; it looks at the clock alone.

    Source: round_robin_tobit, equation (4), for the protocol in which one sensor a step may
    transmit.
    """

    period: int = parameter(1, validation.integer, at_least=1)
    knowledge: ClassVar[Knowledge] = "clock"

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        sensors, _ = shape_of(signals)
        step = signals["step"]
        turn = (step // self.period) % sensors
        return (np.arange(sensors)[:, None] == turn) & (step % self.period == 0)
