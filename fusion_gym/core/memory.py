"""What was measured and not sent: the shadows of a run.

A shadow is the same plant on the same noise, tokens and past channel, with a filter that has taken
in every measurement that its owner has. The coordinator sees all sensors. A sensor by itself has
its own measurements and what it hears, by the option ``broadcast``:

- ``"none"``: nothing. It knows which of its packets arrived, and takes for the centre's estimate
  what that would be if nobody else ever sent.
- ``"estimate"``: the centre's prediction with its covariance. It joins its own estimate with that
  by covariance intersection, for it does not know what the two have in common.
- ``"packets"``: every packet that arrived, so it knows all that the centre knows.

What follows from the shadows is in :mod:`fusion_gym.core.beliefs`.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array, merge_runs, take_runs
from fusion_gym.core.beliefs import (
    Beliefs,
    CoordinatorBeliefs,
    Estimate,
    OwnBeliefs,
    Shadows,
    arriving,
)
from fusion_gym.core.task import Task
from fusion_gym.errors import refusal

Owner = Literal["coordinator", "own"]


class Memory:
    """Moves the shadows of a task's runs and says what is believed by them; it holds no runs.

    ``owner`` says whose: the coordinator's, or every sensor's by itself.

    Raises:
        ConfigurationError: sensors by themselves, where packets hold the coordinator's estimate.
    """

    def __init__(self, task: Task, owner: Owner) -> None:
        self.task, self.owner, sensors = task, owner, task.sensors
        own = owner == "own"
        if own and task.packet == "estimate":
            raise refusal(
                "packet",
                task.packet,
                "'measurement' where sensors decide by themselves, for the estimate is the "
                "coordinator's, of all sensors",
            )
        distant = task.broadcast == "none" or (task.broadcast == "estimate" and not task.feedback)
        self._needs_alone = own and distant
        self._needs_own = own and task.shadow is not None
        self.keeps_every = not own and task.shadow is not None
        self._itself = np.eye(sensors, dtype=np.bool_)

    @property
    def keeps(self) -> bool:
        """Whether there is anything to keep from step to step."""
        return self.keeps_every or self._needs_own or self._needs_alone

    def start(self, noise: Array, fresh: Any) -> Shadows:
        """Of runs that begin with this noise (start_channels, N) in the states ``fresh``."""
        first, system = fresh, self.task.shadow
        if system is not None and system is not self.task.system:
            first = system.start(noise)
        every = np.tile(np.arange(noise.shape[-1]), self.task.sensors)
        return Shadows(
            every=first if self.keeps_every else None,
            own=take_runs(first, every) if self._needs_own else None,
            alone=take_runs(fresh, every) if self._needs_alone else None,
        )

    def sense(self, shadows: Shadows, noise: Array) -> Shadows:
        """After the plant has moved and the sensors have measured, noise (noise_channels, N)."""
        system, remembering = self.task.system, self.task.shadow or self.task.system
        result = Shadows()
        if shadows.every is not None:
            result.every = remembering.sense(shadows.every, noise)
        if shadows.own is not None or shadows.alone is not None:
            noise = np.tile(noise, self.task.sensors)
        if shadows.own is not None:
            result.own = remembering.sense(shadows.own, noise)
        if shadows.alone is not None:
            result.alone = system.sense(shadows.alone, noise)
        return result

    def beliefs(self, state: Any, shadows: Shadows, best: Estimate | None = None) -> Beliefs:
        """What is believed before anything is sent; computed when it is first looked at.

        ``best`` is x*, where it is known already.
        """
        kind = OwnBeliefs if self.owner == "own" else CoordinatorBeliefs
        return kind(self.task, state, shadows, best)

    def deliver(self, beliefs: Beliefs, granted: NDArray[np.bool_]) -> Shadows:
        """After the network's answer (sensors, N): its own is remembered, others' packets heard."""
        result, shadows = Shadows(), beliefs.shadows
        if shadows.every is not None:
            result.every = beliefs.remembered
        if shadows.own is not None:
            result.own = beliefs.remembered
            if self.task.broadcast == "packets":
                itself, system = self._own(granted), self.task.shadow
                assert system is not None
                heard = np.tile(granted, self.task.sensors) | itself
                result.own = system.deliver(arriving(system, shadows.own, itself), heard)
        if shadows.alone is not None:
            sent = np.tile(granted, self.task.sensors) & self._own(granted)
            result.alone = self.task.system.deliver(shadows.alone, sent)
        return result

    def take(self, shadows: Shadows, runs: NDArray[np.int64], num_envs: int) -> Shadows:
        """Those of the given runs, in this order and possibly again and again."""
        many = self._places(runs, num_envs)
        return Shadows(
            every=take_runs(shadows.every, runs),
            own=take_runs(shadows.own, many),
            alone=take_runs(shadows.alone, many),
        )

    def merge(self, old: Shadows, new: Shadows, runs: NDArray[np.int64], num_envs: int) -> Shadows:
        """The shadows of ``num_envs`` runs with those of the given runs replaced."""
        many = self._places(runs, num_envs)
        return Shadows(
            every=merge_runs(old.every, new.every, runs),
            own=merge_runs(old.own, new.own, many),
            alone=merge_runs(old.alone, new.alone, many),
        )

    def _places(self, runs: NDArray[np.int64], num_envs: int) -> NDArray[np.int64]:
        """Where the runs (R,) of every sensor stand, (sensors · R,)."""
        return (np.arange(self.task.sensors)[:, None] * num_envs + runs).ravel()

    def _own(self, granted: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Each sensor's own packet in its own runs (sensors, sensors · N)."""
        return np.repeat(self._itself, granted.shape[-1], axis=-1)
