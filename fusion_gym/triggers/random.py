"""Random requests at a rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.systems import Signals
from fusion_gym.triggers.base import PerSensor, Requests, Trigger, column, shape_of

_STREAM = 0x72616E646F6D  # keeps the requests apart from the noise of the same seed
_BLOCK = 64  # steps drawn at a time


@dataclass
class Random(Trigger):
    """Each sensor requests with probability ``rate``, independently at every step."""

    rate: PerSensor = 0.2

    def __post_init__(self) -> None:
        for rate in np.atleast_1d(np.asarray(self.rate, dtype=object)):
            validation.number("rate", rate, at_least=0.0, at_most=1.0)
        self.reset(0)

    def reset(self, num_envs: int, seed: int = 0) -> None:
        """Begin again: run i draws from a stream of its own, that of ``seed + i``."""
        self._generators = [np.random.default_rng([seed + run, _STREAM]) for run in range(num_envs)]
        self._drawn: NDArray[np.float64] | None = None
        self._used = 0

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        sensors, runs = shape_of(signals)
        if len(self._generators) != runs:
            self.reset(runs)
        if self._drawn is None or self._used == _BLOCK:
            drawn = [generator.random((_BLOCK, sensors)) for generator in self._generators]
            self._drawn, self._used = np.stack(drawn, axis=-1), 0
        self._used += 1
        return self._drawn[self._used - 1] < column("rate", self.rate, sensors)
