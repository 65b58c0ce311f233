"""Steps of N runs from rows of numbers to rows of numbers, for the backends that compile them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array, arrays_of, map_arrays
from fusion_gym.core.beliefs import MemoryStates
from fusion_gym.core.memory import Memory
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.runs import Branch, Outcome, Position, State, advance, start_of
from fusion_gym.core.task import Task
from fusion_gym.namespace import namespace


class RowStep:
    """A step between rows (N, entries), and the places of a row's arrays.

    A row has the arrays of a position and of the memory, of the outcome of the step to it and of
    the state after the delivery, and its observation.

    Args:
        task: The task.
        memory: The memory; its states are not used.
        layout: The layout of the observation.
    """

    def __init__(self, task: Task, memory: Memory, layout: ObservationLayout) -> None:
        self.runs, plant, network = (task, memory, layout), task.plant, task.network
        self.start_noise = np.zeros((plant.start_channels + network.start_channels, 1))
        self.noise = np.zeros((plant.noise_channels + network.noise_channels, 1))
        number, steps = np.zeros(1), np.zeros(1, dtype=np.int64)
        with np.errstate(all="ignore"):
            start, announcement = start_of(task, self.start_noise)
            state = advance(task, start, self.noise, steps)
            measured = (plant.measurement(part.plant) for part in (start, state))
            memory = self.begin_memory(announcement, *measured)
            self.template = Position(state, number, steps, steps), memory.states
            branch = Branch(task, memory, layout, self.template[0])
            branch.deliver(np.zeros((task.sensors, 1), np.bool_))
            self._delivered = branch.delivered
        flags: Any = np.zeros((task.sensors, 1), np.bool_)
        errors: Any = np.zeros((len(plant.state_names), 1))
        observation = np.zeros((len(layout.names), 1), np.float32)
        self.inputs = arrays_of(self.template)
        outcome = [*[number] * 4, *[flags] * 3, errors, errors, *[flags[0]] * 2]
        self.results = [*outcome, *arrays_of(self._delivered)]
        self.arrays = [*self.inputs, *self.results, observation]
        *self._places, self._entries = _places(self.arrays)
        first = len(self.inputs)
        own, self._after = self._places[first : first + len(outcome)], first + len(outcome)
        self._span = slice(own[0].start, own[-1].stop)
        self._fields = [  # whether a field of the outcome is a flag, and its place
            (array.dtype == np.bool_, place if array.ndim > 1 else place.start)
            for array, place in zip(outcome, _places(outcome), strict=True)
        ]

    def __reduce__(self) -> Any:
        return type(self), self.runs

    def __deepcopy__(self, memo: Any) -> RowStep:
        return self  # what it has compiled fits the copy

    @property
    def width(self) -> int:
        """Number of entries of a row."""
        return int(self._entries.stop)

    def begin_memory(self, announcement: Any, first: Any, measurement: Any) -> Memory:
        """Return the memory of one run after the plant's announcement and two measurements."""
        memory = self.runs[1].with_states({})
        memory.begin(first, announcement, measurement, np.arange(1), [0], 1)
        return memory

    def begin_run(self, noise: Any, first: Any, price: Any, limit: Any) -> Branch:
        """Return a run at the start of an episode, from noise, price and limit of steps."""
        task, memory, layout = self.runs
        asarray, (start, announcement) = namespace(noise).asarray, start_of(task, noise)
        start, steps = map_arrays(asarray, start), asarray(np.zeros(len(price), np.int64))
        position = Position(advance(task, start, first, steps), price, steps, limit)
        position = map_arrays(asarray, position)
        measured = (task.plant.measurement(part.plant) for part in (start, position.state))
        memory = self.begin_memory(announcement, *measured)
        memory.states = map_arrays(asarray, memory.states)
        return Branch(task, memory, layout, position)

    def start_arrays(self, *inputs: Any) -> list[Any]:
        """Return the arrays of a row at the start of :meth:`begin_run`."""
        branch = self.begin_run(*inputs)
        moved = branch.position(), branch.memory.states
        return [*arrays_of(moved), *self.results, branch.observe()]

    def step_arrays(self, arrays: Sequence[Any], requests: Any, noise: Any) -> list[Any]:
        """Return the arrays of a row after a step, from a position's arrays, requests and noise."""
        values, (task, memory, layout) = iter(arrays), self.runs
        position, states = map_arrays(lambda _: next(values), self.template)
        branch = Branch(task, memory.with_states(states), layout, position)
        outcome = branch.step(requests, noise)
        moved = branch.position(), branch.memory.states
        return [*arrays_of(moved), *outcome, *arrays_of(branch.delivered), branch.observe()]

    def pack(self, position: Position, memory: MemoryStates) -> Array:
        """Return the rows of a position and of the memory's states."""
        rows = np.zeros((len(position.steps), self.width))
        for place, array in zip(self._places, arrays_of((position, memory)), strict=False):
            rows[:, place] = array.reshape(-1, len(rows)).T
        return rows

    def moved(self, rows: Array) -> tuple[Position, MemoryStates]:
        """Return the position and the memory's states of rows."""
        moved: tuple[Position, MemoryStates] = self._unpack(rows, self.template, 0)
        return moved

    def delivered(self, rows: Array) -> State:
        """Return the states after the delivery of rows."""
        state: State = self._unpack(rows, self._delivered, self._after)
        return state

    def _unpack(self, rows: Array, template: Any, first: int) -> Any:
        values, places = rows.T, iter(self._places[first:])

        def part(array: NDArray[Any]) -> NDArray[Any]:
            own = values[next(places)].reshape(*array.shape[:-1], -1)
            return own.astype(array.dtype) if array.dtype != own.dtype else own

        return map_arrays(part, template)

    def outcome(self, rows: Array, run: int | None = None) -> Outcome:
        """Return the outcome of the step to rows, or to one row without the batch axis."""
        row = slice(None) if run is None else run
        numbers = rows[row, self._span].T.copy()  # or a stored reward would keep the rows
        flags: Any = numbers.astype(np.bool_)
        return Outcome._make([(flags if flag else numbers)[at] for flag, at in self._fields])

    def observation(self, rows: Array) -> NDArray[np.float32]:
        """Return new observations (N, entries) of rows."""
        return rows[:, self._entries].astype(np.float32)


def _places(arrays: Sequence[NDArray[Any]]) -> list[slice]:
    """Return the place of each array (…, 1) in a row."""
    ends = itertools.accumulate((array.size for array in arrays), initial=0)
    return [slice(*span) for span in itertools.pairwise(ends)]
