"""Moments in the life of some runs and of what is remembered beside them, to be branched."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import take_runs
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.beliefs import Beliefs
from fusion_gym.core.memory import Shadows
from fusion_gym.core.observation import Network


@dataclass
class Moment:
    """A state and what is remembered beside it, of some runs in the place of a batch's first."""

    batch: EpisodeBatch
    state: Any
    shadows: Shadows

    @classmethod
    def start(cls, batch: EpisodeBatch, draw: np.random.Generator) -> Moment:
        """One run at time 0."""
        noise = draw.standard_normal((batch.task.system.start_channels, 1))
        fresh = batch.task.system.start(noise)
        return cls(batch, fresh, batch.memory.start(noise, fresh))

    def taken(self, runs: NDArray[np.int64]) -> Moment:
        """These runs, in this order."""
        sensors, here = self.batch.task.sensors, self.runs
        many = (np.arange(sensors)[:, None] * here + runs).ravel()
        kept = self.shadows
        shadows = Shadows(
            take_runs(kept.every, runs), take_runs(kept.own, many), take_runs(kept.alone, many)
        )
        return Moment(self.batch, take_runs(self.state, runs), shadows)

    def repeated(self, runs: int) -> Moment:
        """The first run again and again."""
        return self.taken(np.zeros(runs, dtype=np.int64))

    def first(self) -> Moment:
        """The first run alone."""
        return self.repeated(1)

    def sensed(self, noise: NDArray[np.float64]) -> Moment:
        """After the next sensing."""
        state = self.batch.task.system.sense(self.state, noise)
        return Moment(self.batch, state, self.batch.memory.sense(self.shadows, noise))

    def delivered(self, granted: NDArray[np.bool_]) -> Moment:
        """After the delivery of what was granted."""
        state = self.batch.task.system.deliver(self.state, granted)
        return Moment(self.batch, state, self.batch.memory.deliver(self.beliefs(), granted))

    def beliefs(self) -> Beliefs:
        """Before anything is sent."""
        return self.batch.memory.beliefs(self.state, self.shadows)

    def observed(self) -> NDArray[np.float32]:
        """Observations (N, entries), with the network of the batch's first run."""
        batch, runs = self.batch, self.runs
        network = Network(
            np.repeat(batch.tokens[:1], runs),
            lambda: np.repeat(batch.admitted()[:, :1], runs, axis=1),
            np.repeat(batch.price[:1], runs),
            np.repeat((batch.task.horizon - batch.steps)[:1], runs),
        )
        return batch.layout.encode(self.state, network, self.beliefs)

    @property
    def runs(self) -> int:
        """How many there are."""
        return int(self.batch.task.system.truth(self.state).shape[-1])


def unseeing(batch: EpisodeBatch) -> Shadows:
    """What a batch remembers, without what no policy may know."""
    kept, task = batch.shadows or Shadows(), batch.task

    def blind(system: Any, state: Any) -> Any:
        return None if state is None else system.visible(state)

    return Shadows(
        blind(task.shadow, kept.every), blind(task.shadow, kept.own), blind(task.system, kept.alone)
    )
