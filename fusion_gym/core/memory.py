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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Self, cast, get_args

import numpy as np
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.arrays import Array, Lazy, merge_runs, take_runs, value_of
from fusion_gym.core.beliefs import (
    Beliefs,
    Estimate,
    MemoryColumns,
    MemoryPart,
    MemoryStates,
    OwnBeliefs,
    Owner,
    SchedulerBeliefs,
)
from fusion_gym.core.signals import memory_signals, missing_signals
from fusion_gym.core.task import Task
from fusion_gym.errors import refusal
from fusion_gym.namespace import namespace


class Memory:
    """The memory of a task's runs, which moves with them.

    Args:
        task: The task.
        owner: ``"scheduler"``, or ``"own"`` for every local sensor.

    A state that no transmission changes has one column for all runs with the same noise, and the
    ``covariance_fields`` of its estimator have one column for all runs that begin together.

    Attributes:
        parts: Parts of the memory, by name.
        places: Columns (N,) of the runs in the private parts' states; ``None`` is one per run.

    Raises:
        ConfigurationError: The owner is local, and packets hold the scheduler's estimate or may be
            late.
    """

    def __init__(self, task: Task, owner: Owner) -> None:
        validation.choice("owner", owner, get_args(Owner))
        self.task, self.owner = task, owner
        own = owner == "own"
        if own and task.options.packet == "estimate":
            why = "with local sensors, because the estimate belongs to the scheduler"
            raise refusal("packet", task.options.packet, f"'measurement' {why}")
        if own:
            reason = "their model of the centre has only packets that arrive at once"
            task.refuse_delay(reason, "with the memory of local sensors")
        self.parts: dict[str, MemoryPart] = {}
        broadcast = task.broadcast
        if task.memory_estimator is not None:
            if own:
                self._add("own", task.memory_estimator, private=broadcast != "packets")
            else:
                self.parts["every"] = MemoryPart(task.memory_estimator, copies=1, private=True)
        if own and (broadcast == "none" or (broadcast == "estimate" and not task.feedback)):
            self._add("single", task.estimator, private=False)
        self.keeps_every = "every" in self.parts
        self.states = {}
        self.places: NDArray[np.int64] | None = None
        self._first: NDArray[np.int64] | None = None  # a run of each column
        self._beliefs: Beliefs | None = None

    @property
    def states(self) -> MemoryStates:
        """The parts' states after sensing, by name."""
        states: MemoryStates = value_of(self._states)
        return states

    @states.setter
    def states(self, states: Any) -> None:
        self._states = states

    def _add(self, name: str, estimator: Any, private: bool) -> None:
        """Add a part for each sensor where the estimator allows it, else one with copies."""
        alone = [estimator.select_sensor(i) for i in range(self.task.sensors)]
        if (private or name == "single") and None not in alone:
            for sensor, own in enumerate(alone):
                self.parts[f"{name} {sensor}"] = MemoryPart(own, 1, private, sensor)
        else:
            self.parts[name] = MemoryPart(estimator, self.task.sensors, private)

    def begin(
        self,
        first: Array,
        announcement: Any,
        measurement: Array,
        runs: NDArray[np.int64],
        keys: Sequence[Any],
        num_envs: int,
    ) -> None:
        """Start in the R runs ``runs``, and observe.

        Args:
            first: Measurements (sensors, m, R) at time 0.
            announcement: The plant's announcement of the start.
            measurement: Measurements (sensors, m, R) of the first sensing.
            runs: Numbers of the runs (R,).
            keys: Keys of the runs' noise (R,).
            num_envs: Number of all runs.
        """
        together, old = len(runs) == num_envs, self.whole(num_envs)
        self.places = self._first = self._beliefs = None
        if together and len(column := {key: place for place, key in enumerate(keys)}) < num_envs:
            self._first = np.sort(list(column.values()))
            self.places = np.searchsorted(self._first, [column[key] for key in keys])
        self.states = {}
        for name, part in self.parts.items():
            start = part.estimator.start(part.rows(first), announcement)
            columns = np.arange(len(runs))
            if part.shared and self._first is not None:
                columns = self._first
            state = take_runs(start, np.tile(columns, part.copies))
            if together and part.shared and part.copies == 1:
                fields = part.estimator.covariance_fields
                first_run = np.zeros(1, dtype=np.int64)
                values = {field: take_runs(getattr(state, field), first_run) for field in fields}
                state = replace(state, **values)
            self.states[name] = state
        self.observe(measurement)
        if not together:
            for name, state in self.states.items():
                places = self.parts[name].places(runs, num_envs)
                self.states[name] = merge_runs(old[name], state, places)

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
        states, self._beliefs = {}, None
        for name, state in self.states.items():
            part, own = self.parts[name], self.parts[name].rows(measurement)
            if part.shared and self._first is not None:
                own = own[..., self._first]
            if part.copies > 1:
                own = namespace(own).tile(own, part.copies)
            states[name] = part.estimator.observe(part.estimator.predict(state), own)
        self.states = states

    def forget(self) -> None:
        """Forget the beliefs of the step before."""
        self._beliefs = None

    def whole(self, num_envs: int) -> MemoryStates:
        """Return the states with a column for each of the ``num_envs`` runs."""
        return self._columns.whole(num_envs)

    def branch(self, runs: NDArray[np.int64] | None, num_envs: int) -> Self:
        """Return an independent memory of ``runs`` of the ``num_envs`` runs, by default of all."""
        if runs is None:
            return copy.copy(self)
        return self.with_states(
            {
                name: take_runs(state, self.parts[name].places(runs, num_envs))
                for name, state in self.whole(num_envs).items()
            }
        )

    def with_states(self, states: MemoryStates | Lazy) -> Self:
        """Return a memory of other runs with these states, a column for each run."""
        result = copy.copy(self)
        result.states = states
        result.places = result._first = result._beliefs = None
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
        """Names of the signals that are not computed, and the reasons for their absence."""
        return missing_signals(self.owner, len(self.task.network.delay) > 1)

    def _make_beliefs(
        self, estimate: Any, arrival: Array | None, best: Estimate | None = None
    ) -> Beliefs:
        kind = OwnBeliefs if self.owner == "own" else SchedulerBeliefs
        return kind(self.task, estimate, self._columns, arrival, best)

    @property
    def _columns(self) -> MemoryColumns:
        return MemoryColumns(self.parts, self.states, self.places)

    def _updated(self, beliefs: Beliefs, arrived: NDArray[np.bool_]) -> MemoryStates:
        result, own = {}, cast(OwnBeliefs, beliefs)
        for name, state in self.states.items():
            part = self.parts[name]
            if part.private:
                result[name] = beliefs.posteriors[name]
                continue
            if name.startswith("single"):
                result[name] = own.delivered(arrived, name)
                continue
            packets = namespace(arrived).tile(arrived, part.copies) | part.itself(state)
            result[name] = beliefs.update(part.estimator, state, packets)
        return result
