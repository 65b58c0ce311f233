"""Time-triggered policies: they look at the clock alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_gym import validation
from fusion_gym.core.system import Signals
from fusion_gym.policies.base import Requests, Trigger, shape_of


@dataclass
class Periodic(Trigger):
    """Every sensor requests once in ``period`` steps.

    ``staggered`` spreads the sensors over the period; otherwise all request together.
    """

    period: int = 4
    staggered: bool = True

    def __post_init__(self) -> None:
        validation.integer("period", self.period, at_least=1)
        validation.boolean("staggered", self.staggered)

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        sensors, _ = shape_of(signals)
        phase = np.arange(sensors) * self.period // sensors if self.staggered else np.zeros(sensors)
        return (signals["step"] - phase[:, None]) % self.period == 0


@dataclass
class RoundRobin(Trigger):
    """One sensor after another, the next one every ``period`` steps."""

    period: int = 1

    def __post_init__(self) -> None:
        validation.integer("period", self.period, at_least=1)

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        sensors, _ = shape_of(signals)
        step = signals["step"]
        turn = (step // self.period) % sensors
        return (np.arange(sensors)[:, None] == turn) & (step % self.period == 0)
