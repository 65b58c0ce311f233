"""Random requests at a rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_gym import validation
from fusion_gym.systems import Signals
from fusion_gym.triggers.base import PerSensor, Requests, Trigger, column, shape_of


@dataclass
class Random(Trigger):
    """Each sensor requests with probability ``rate``, independently at every step."""

    rate: PerSensor = 0.2

    def __post_init__(self) -> None:
        for rate in np.atleast_1d(np.asarray(self.rate, dtype=object)):
            validation.number("rate", rate, at_least=0.0, at_most=1.0)
        self.reset(0)

    def reset(self, num_envs: int, seed: int = 0) -> None:
        """Begin the stream of ``seed`` again."""
        self._generator = np.random.default_rng(seed)

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        shape = shape_of(signals)
        return self._generator.random(shape) < column("rate", self.rate, shape[0])
