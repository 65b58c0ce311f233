"""Random requests at a rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_gym import validation
from fusion_gym.core.system import Signals
from fusion_gym.policies.base import PerSensor, Requests, Trigger, column, shape_of
from fusion_gym.policies.chance import Chance

_STREAM = 0x72616E646F6D  # keeps the requests apart from the noise of the same seed


@dataclass
class Random(Trigger):
    """Each sensor requests with probability ``rate``, independently at every step."""

    rate: PerSensor = 0.2

    def __post_init__(self) -> None:
        for rate in np.atleast_1d(np.asarray(self.rate, dtype=object)):
            validation.number("rate", rate, at_least=0.0, at_most=1.0)
        self._chance = Chance(_STREAM)

    def reset(self, num_envs: int, seed: int = 0) -> None:
        """Begin again: run i draws from a stream of its own, that of ``seed + i``."""
        self._chance.reset(num_envs, seed)

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        sensors, runs = shape_of(signals)
        return self._chance.draw(sensors, runs) < column("rate", self.rate, sensors)
