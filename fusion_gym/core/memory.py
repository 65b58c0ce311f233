"""The memory of N runs: measurements that were taken and not sent, and the beliefs they imply.

A memory state belongs to the same plant, noise, tokens and past channel, with a filter that has
processed every measurement of its owner. The scheduler has all measurements. A local sensor has its
own measurements and the broadcasts:

- ``"none"``: It knows which of its packets arrived, and models a centre with its packets only.
- ``"estimate"``: It receives the centre's prediction with its covariance, and joins it with its own
  estimate by covariance intersection, because their cross-correlation is unknown.
- ``"packets"``: It receives every packet that arrived and knows everything that the centre knows.

:mod:`fusion_gym.core.beliefs` has the beliefs.
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
    """The memory of a task's runs, which moves with them.

    Args:
        task: The task.
        owner: ``"scheduler"``, or ``"own"`` for every local sensor.

    Attributes:
        states: Memory states after sensing, ``None`` without any.

    Raises:
        ConfigurationError: The owner is local and packets hold the scheduler's estimate.
    """

    def __init__(self, task: Task, owner: Owner) -> None:
        validation.choice("owner", owner, get_args(Owner))
        self.task, self.owner = task, owner
        own = owner == "own"
        if own and task.packet == "estimate":
            why = "with local sensors, because the estimate belongs to the scheduler"
            raise refusal("packet", task.packet, f"'measurement' {why}")
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
        """Start and sense in the R runs ``runs``.

        Args:
            noise: Normals (start_channels, R) of the start.
            fresh: The system's states of the start.
            row: Normals (noise_channels, R) of the first sensing.
            runs: Numbers of the runs (R,).
            num_envs: Number of all runs.
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
        """Return the owner's beliefs before any transmission in the runs' sensed state."""
        if self._beliefs is None:
            self._beliefs = self._make_beliefs(state)
        return self._beliefs

    def deliver(self, state: Any, delivered: Any, granted: NDArray[np.bool_]) -> Any:
        """Update the memory after grants (sensors, N) in the runs' sensed state.

        With ``packet="estimate"`` the centre of the returned state has x* where a packet arrived.

        Args:
            state: The runs' sensed state.
            delivered: The system's state after its delivery.
            granted: (sensors, N) bool.
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
        """Return an independent memory of ``runs`` of the ``num_envs`` runs, by default of all."""
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
        """Return a memory of other runs with these states."""
        result = copy.copy(self)
        result.states, result._beliefs = states, None
        return result

    def with_best(self, state: Any, best: Estimate) -> Self:
        """Return a memory of runs in a sensed state with known x*."""
        result = self.with_states(None)
        result._beliefs = result._make_beliefs(state, best)
        return result

    def signals(self, beliefs: Callable[[], Beliefs]) -> Mapping[str, Callable[[], Any]]:
        """Return the signals of the beliefs by name."""
        return memory_signals(self.owner, beliefs)

    @property
    def missing_signals(self) -> Mapping[str, str]:
        """Names of the signals of another owner's beliefs, and the reasons for their absence."""
        return missing_signals(self.owner)

    def _make_beliefs(self, state: Any, best: Estimate | None = None) -> Beliefs:
        kind = OwnBeliefs if self.owner == "own" else SchedulerBeliefs
        return kind(self.task, state, self.states or MemoryStates(), best)

    def _sensed(self, states: MemoryStates, noise: Array) -> MemoryStates:
        system, memory_system = self.task.system, self.task.memory_system or self.task.system
        result = MemoryStates()
        if states.every is not None:
            result.every = memory_system.sense(states.every, noise)
        if states.own is not None or states.single is not None:
            noise = np.tile(noise, self.task.sensors)
        if states.own is not None:
            result.own = memory_system.sense(states.own, noise)
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
        """Return the positions (sensors · R,) of the runs (R,) of every sensor."""
        return (np.arange(self.task.sensors)[:, None] * num_envs + runs).ravel()
