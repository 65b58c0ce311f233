"""What was measured and not sent: the memory of the owner of N runs, and what it believes.

A memory state is the same plant on the same noise, tokens and past channel, with a filter that has
taken in every measurement that its owner has. The scheduler sees all sensors. A local sensor has
its own measurements and what it receives, by the option ``broadcast``:

- ``"none"``: nothing. It knows which of its packets arrived, and takes for the centre's estimate
  what that would be if nobody else ever sent.
- ``"estimate"``: the centre's prediction with its covariance. It joins its own estimate with that
  by covariance intersection, for it does not know what the two have in common.
- ``"packets"``: every packet that arrived, so it knows all that the centre knows.

What follows from the memory is in :mod:`fusion_gym.core.beliefs`.
"""

import copy
from collections.abc import Callable, Mapping
from typing import Any, Self, get_args

import numpy as np
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.arrays import Array, merge_runs, take_runs
from fusion_gym.core.beliefs import (
    Beliefs,
    Estimate,
    MemoryStates,
    OwnBeliefs,
    Owner,
    SchedulerBeliefs,
    arriving,
)
from fusion_gym.core.signals import memory_signals, missing_signals
from fusion_gym.core.task import Task
from fusion_gym.errors import refusal


class Memory:
    """What the owner of a task's runs remembers, moved along with them, and what it believes.

    ``owner`` is the scheduler, or every sensor by itself. ``states`` are the memory states after
    sensing, ``None`` where nothing is remembered from step to step.

    Raises:
        ConfigurationError: sensors by themselves, where packets hold the scheduler's estimate.
    """

    def __init__(self, task: Task, owner: Owner) -> None:
        validation.choice("owner", owner, get_args(Owner))
        self.task, self.owner = task, owner
        own = owner == "own"
        if own and task.packet == "estimate":
            raise refusal(
                "packet",
                task.packet,
                "'measurement' where sensors decide by themselves, for the estimate is the "
                "scheduler's, of all sensors",
            )
        distant = task.broadcast == "none" or (task.broadcast == "estimate" and not task.feedback)
        self._needs_single = own and distant
        self._needs_own = own and task.memory_system is not None
        self.keeps_every = not own and task.memory_system is not None
        keeps = self.keeps_every or self._needs_own or self._needs_single
        self.states = MemoryStates() if keeps else None
        self._beliefs: Beliefs | None = None

    def begin(
        self, noise: Array, fresh: Any, row: Array, runs: NDArray[np.int64], num_envs: int
    ) -> None:
        """Start and sense in the given ones of ``num_envs`` runs.

        ``noise`` (start_channels, R) and ``fresh`` are the start's normals and states, ``row``
        (noise_channels, R) the normals of the first sensing.
        """
        self._beliefs = None
        if self.states is None:
            return
        first, system = fresh, self.task.memory_system
        if system is not None and system is not self.task.system:
            first = system.start(noise)
        every = np.tile(np.arange(noise.shape[-1]), self.task.sensors)
        new = self._sensed(
            MemoryStates(
                every=first if self.keeps_every else None,
                own=take_runs(first, every) if self._needs_own else None,
                single=take_runs(fresh, every) if self._needs_single else None,
            ),
            row,
        )
        if len(runs) < num_envs:
            old, many = self.states, self._places(runs, num_envs)
            new = MemoryStates(
                every=merge_runs(old.every, new.every, runs),
                own=merge_runs(old.own, new.own, many),
                single=merge_runs(old.single, new.single, many),
            )
        self.states = new

    def beliefs(self, state: Any) -> Beliefs:
        """Return what the owner believes before anything is sent, of the runs' sensed state."""
        if self._beliefs is None:
            self._beliefs = self._make_beliefs(state)
        return self._beliefs

    def deliver(self, state: Any, delivered: Any, granted: NDArray[np.bool_]) -> Any:
        """Take in the network's answer (sensors, N) to the runs' sensed state.

        The owner remembers its own measurements and receives others' packets. Returns the
        delivered state; with ``packet="estimate"`` its centre goes on from x* where a packet
        arrived.
        """
        if self.task.packet == "estimate":
            mean, covariance = self.beliefs(state).best
            arrived = np.asarray(granted.any(0))
            delivered = self.task.system.adopt(delivered, mean[0], covariance[0], arrived)
        if self.states is not None:
            self.states = self._delivered(self.states, self.beliefs(state), granted)
        return delivered

    def sense(self, noise: Array) -> None:
        """Move the plant and measure, with noise (noise_channels, N)."""
        if self.states is not None:
            self.states = self._sensed(self.states, noise)
        self._beliefs = None

    def branch(self, runs: NDArray[np.int64] | None, num_envs: int) -> Self:
        """Return the memory of the given ones of ``num_envs`` runs, or of all, to move apart."""
        result = copy.copy(self)
        if runs is not None:
            result._beliefs = None
            if self.states is not None:
                many = self._places(runs, num_envs)
                result.states = MemoryStates(
                    every=take_runs(self.states.every, runs),
                    own=take_runs(self.states.own, many),
                    single=take_runs(self.states.single, many),
                )
        return result

    def with_states(self, states: MemoryStates | None) -> Self:
        """Return the memory of other runs, in these states."""
        result = copy.copy(self)
        result.states, result._beliefs = states, None
        return result

    def with_best(self, state: Any, best: Estimate) -> Self:
        """Return the memory of runs in a sensed state whose x* is known and not computed."""
        result = self.with_states(None)
        result._beliefs = result._make_beliefs(state, best)
        return result

    def signals(self, beliefs: Callable[[], Beliefs]) -> Mapping[str, Callable[[], Any]]:
        """Return the signals of what is believed, by name."""
        return memory_signals(self.owner, beliefs)

    @property
    def missing_signals(self) -> Mapping[str, str]:
        """The signals of what others believe, and why they are not there."""
        return missing_signals(self.owner)

    def _make_beliefs(self, state: Any, best: Estimate | None = None) -> Beliefs:
        kind = OwnBeliefs if self.owner == "own" else SchedulerBeliefs
        return kind(self.task, state, self.states or MemoryStates(), best)

    def _sensed(self, states: MemoryStates, noise: Array) -> MemoryStates:
        system, remembering = self.task.system, self.task.memory_system or self.task.system
        result = MemoryStates()
        if states.every is not None:
            result.every = remembering.sense(states.every, noise)
        if states.own is not None or states.single is not None:
            noise = np.tile(noise, self.task.sensors)
        if states.own is not None:
            result.own = remembering.sense(states.own, noise)
        if states.single is not None:
            result.single = system.sense(states.single, noise)
        return result

    def _delivered(
        self, states: MemoryStates, beliefs: Beliefs, granted: NDArray[np.bool_]
    ) -> MemoryStates:
        result, itself = MemoryStates(), np.eye(self.task.sensors, dtype=np.bool_)
        # Each sensor's own packet in its own runs (sensors, sensors · N).
        itself = np.repeat(itself, granted.shape[-1], axis=-1)
        if states.every is not None:
            result.every = beliefs.memory_posterior
        if states.own is not None:
            result.own = beliefs.memory_posterior
            if self.task.broadcast == "packets":
                system = self.task.memory_system
                assert system is not None
                received = np.tile(granted, self.task.sensors) | itself
                result.own = system.deliver(arriving(system, states.own, itself), received)
        if states.single is not None:
            sent = np.tile(granted, self.task.sensors) & itself
            result.single = self.task.system.deliver(states.single, sent)
        return result

    def _places(self, runs: NDArray[np.int64], num_envs: int) -> NDArray[np.int64]:
        """Where the runs (R,) of every sensor stand, (sensors · R,)."""
        return (np.arange(self.task.sensors)[:, None] * num_envs + runs).ravel()
