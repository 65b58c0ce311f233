"""Rules that draw uniform random numbers, with one stream for each run."""

from typing import ClassVar

import numpy as np

from fusion_gym.arrays import Array
from fusion_gym.policies.base import Rule

_BLOCK = 64  # steps drawn at a time


class ChanceRule(Rule):
    """A rule that draws uniform numbers in [0, 1), independent of the noise of the same seeds.

    Run i has the stream of ``seed + i`` and the rule's number ``stream``, so its draws depend
    neither on the other runs nor on any signal.
    """

    stream: ClassVar[int]

    def reset(self, runs: int, seed: int = 0) -> None:
        """Restart the random streams; run i draws from the stream of ``seed + i``."""
        seeds = range(seed, seed + runs)
        self._generators = [np.random.default_rng([seed, self.stream]) for seed in seeds]
        self._drawn: Array | None = None
        self._used = 0

    def draw(self, sensors: int, runs: int) -> Array:
        """Return the numbers (sensors, N) of the next step."""
        if len(self._generators) != runs:
            self.reset(runs)
        if self._drawn is None or self._used == _BLOCK:
            drawn = [generator.random((_BLOCK, sensors)) for generator in self._generators]
            self._drawn, self._used = np.stack(drawn, axis=-1), 0
        self._used += 1
        return self._drawn[self._used - 1]
