"""The memory of N runs: measurements that were taken and not sent, and the beliefs they imply.

A memory state is the state of an estimator that has processed every measurement of its owner. The
scheduler has all measurements. A local sensor has its own measurements and the broadcasts:

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
)
from fusion_gym.core.estimator import Estimator
from fusion_gym.core.signals import memory_signals, missing_signals
from fusion_gym.core.task import Task
from fusion_gym.errors import refusal


class Memory:
    """The memory of a task's runs, which moves with them.

    Args:
        task: The task.
        owner: ``"scheduler"``, or ``"own"`` for every local sensor.

    Attributes:
        estimators: Estimators of the memory states, by name.
        states: Memory states after sensing, by name.

    Raises:
        ConfigurationError: The owner is local, and packets hold the scheduler's estimate or may be
            late.
    """

    def __init__(self, task: Task, owner: Owner) -> None:
        validation.choice("owner", owner, get_args(Owner))
        self.task, self.owner = task, owner
        own = owner == "own"
        if own and task.packet == "estimate":
            why = "with local sensors, because the estimate belongs to the scheduler"
            raise refusal("packet", task.packet, f"'measurement' {why}")
        if own and len(task.network.delay) > 1:
            raise refusal("delay", task.network.delay, "none with the memory of local sensors")
        self.estimators: dict[str, Estimator[Any]] = {}
        if task.memory_estimator is not None:
            self.estimators["own" if own else "every"] = task.memory_estimator
        if own and (
            task.broadcast == "none" or (task.broadcast == "estimate" and not task.feedback)
        ):
            self.estimators["single"] = task.estimator
        self.keeps_every = "every" in self.estimators
        self.states: MemoryStates = {}
        self._beliefs: Beliefs | None = None

    def begin(
        self,
        first: Array,
        announcement: Any,
        measurement: Array,
        runs: NDArray[np.int64],
        num_envs: int,
    ) -> None:
        """Start in the R runs ``runs``, and observe.

        Args:
            first: Measurements (sensors, m, R) at time 0.
            announcement: The plant's announcement of the start.
            measurement: Measurements (sensors, m, R) of the first sensing.
            runs: Numbers of the runs (R,).
            num_envs: Number of all runs.
        """
        fresh, every = {}, np.arange(len(runs))
        for name, estimator in self.estimators.items():
            start = estimator.start(first, announcement)
            fresh[name] = take_runs(start, np.tile(every, self._copies(name)))
        new, old = self._observed(fresh, measurement), self.states
        if len(runs) < num_envs:
            for name, state in new.items():
                new[name] = merge_runs(old[name], state, self._places(name, runs, num_envs))
        self.states, self._beliefs = new, None

    def beliefs(self, estimate: Any, arrival: Array | None) -> Beliefs:
        """Return the owner's beliefs before any transmission.

        Args:
            estimate: The estimator's state after observing.
            arrival: Probability (sensors, N) that a packet sent now arrives; ``None`` is 1.
        """
        if self._beliefs is None:
            self._beliefs = self._make_beliefs(estimate, arrival)
        return self._beliefs

    def update(self, beliefs: Callable[[], Beliefs], arrived: NDArray[np.bool_]) -> None:
        """Update the memory after the packets (sensors, N) that arrive.

        Args:
            beliefs: Function that returns the beliefs before the transmission.
            arrived: (sensors, N) bool.
        """
        if self.states:
            self.states = self._updated(beliefs(), arrived)

    def observe(self, measurement: Array) -> None:
        """Predict, and take the new measurements (sensors, m, N)."""
        self.states, self._beliefs = self._observed(self.states, measurement), None

    def forget(self) -> None:
        """Forget the beliefs of the step before."""
        self._beliefs = None

    def branch(self, runs: NDArray[np.int64] | None, num_envs: int) -> Self:
        """Return an independent memory of ``runs`` of the ``num_envs`` runs, by default of all."""
        result = copy.copy(self)
        if runs is not None:
            result._beliefs = None
            result.states = {
                name: take_runs(state, self._places(name, runs, num_envs))
                for name, state in self.states.items()
            }
        return result

    def with_states(self, states: MemoryStates) -> Self:
        """Return a memory of other runs with these states."""
        result = copy.copy(self)
        result.states, result._beliefs = states, None
        return result

    def with_best(self, estimate: Any, arrival: Array | None, best: Estimate) -> Self:
        """Return a memory of runs with known x*."""
        result = self.with_states({})
        result._beliefs = result._make_beliefs(estimate, arrival, best)
        return result

    def signals(self, beliefs: Callable[[], Beliefs]) -> Mapping[str, Callable[[], Any]]:
        """Return the signals of the beliefs by name."""
        return memory_signals(self.owner, beliefs)

    @property
    def missing_signals(self) -> Mapping[str, str]:
        """Names of the signals of another owner's beliefs, and the reasons for their absence."""
        return missing_signals(self.owner)

    def _make_beliefs(
        self, estimate: Any, arrival: Array | None, best: Estimate | None = None
    ) -> Beliefs:
        kind = OwnBeliefs if self.owner == "own" else SchedulerBeliefs
        return kind(self.task, estimate, self.states, arrival, best)

    def _observed(self, states: MemoryStates, measurement: Array) -> MemoryStates:
        """Return the states after their own measurements (sensors, m, N)."""
        result = {}
        for name, state in states.items():
            estimator, copies = self.estimators[name], self._copies(name)
            own = np.tile(measurement, copies) if copies > 1 else measurement
            result[name] = estimator.observe(estimator.predict(state), own)
        return result

    def _updated(self, beliefs: Beliefs, arrived: NDArray[np.bool_]) -> MemoryStates:
        # Each sensor's own packet in its own runs (sensors, sensors · N).
        itself = np.repeat(np.eye(self.task.sensors, dtype=np.bool_), arrived.shape[-1], axis=-1)
        result = {}
        for name, state in self.states.items():
            if name == "single":
                packets = np.tile(arrived, self.task.sensors) & itself
            elif name == "own" and self.task.broadcast == "packets":
                packets = np.tile(arrived, self.task.sensors) | itself
            else:
                result[name] = beliefs.memory_posterior
                continue
            result[name] = beliefs.update(self.estimators[name], state, packets)
        return result

    def _copies(self, name: str) -> int:
        return 1 if name == "every" else self.task.sensors

    def _places(self, name: str, runs: NDArray[np.int64], num_envs: int) -> NDArray[np.int64]:
        """Return the positions (copies · R,) of the runs (R,) in a memory state."""
        return (np.arange(self._copies(name))[:, None] * num_envs + runs).ravel()
