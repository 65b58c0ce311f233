"""Steps of N runs from rows of numbers to rows of numbers, for the backends that compile them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array, arrays_of, map_arrays
from fusion_gym.core.memory import Memory
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.runs import Branch, Outcome, Position, State, advance, start_of
from fusion_gym.core.task import Task


class RowStep:
    """A step between rows (N, entries), and the places of a row's arrays.

    A row has the arrays of a position, of the outcome of the step to it and of the state after the
    delivery, and its observation.

    Args:
        task: The task.
        memory: A memory without states.
        layout: The layout of the observation.
    """

    def __init__(self, task: Task, memory: Memory, layout: ObservationLayout) -> None:
        self.runs, plant, network = (task, memory, layout), task.plant, task.network
        self.start_noise = np.zeros((plant.start_channels + network.start_channels, 1))
        self.noise = np.zeros((plant.noise_channels + network.noise_channels, 1))
        number, steps = np.zeros(1), np.zeros(1, dtype=np.int64)
        with np.errstate(all="ignore"):
            state = advance(task, start_of(task, self.start_noise)[0], self.noise, steps)
            self.template = Position(state, number, steps, steps)
            branch = Branch(*self.runs, self.template)
            branch.deliver(np.zeros((task.sensors, 1), np.bool_))
        self._delivered, flags = branch.delivered, np.zeros((task.sensors, 1), np.bool_)
        errors: Any = np.zeros((len(plant.state_names), 1))
        observation = np.zeros((len(layout.names), 1), np.float32)
        self.moved = arrays_of(self.template)
        outcome = [*[number] * 4, *[flags] * 3, errors, errors, *[flags[0]] * 2]
        self.results = [*outcome, *arrays_of(self._delivered)]
        self.arrays = [*self.moved, *self.results, observation]
        *self._places, self._entries = _places(self.arrays)
        first = len(self.moved)
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

    def pack(self, position: Position) -> Array:
        """Return the rows of a position."""
        rows = np.zeros((len(position.steps), self.width))
        for place, array in zip(self._places, arrays_of(position), strict=False):
            rows[:, place] = array.reshape(-1, len(rows)).T
        return rows

    def position(self, rows: Array) -> Position:
        """Return the position of rows."""
        position: Position = self._unpack(rows, self.template, 0)
        return position

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

    def result(self, rows: Array) -> tuple[Outcome, NDArray[np.float32]]:
        """Return the outcome and the observations (entries, N) of rows."""
        numbers = rows.T[self._span].copy()  # or a stored reward would keep the rows
        both: tuple[Any, Any] = numbers, numbers != 0.0
        outcome = Outcome(*[both[flag][place] for flag, place in self._fields])
        return outcome, self.observation(rows)

    def observation(self, rows: Array) -> NDArray[np.float32]:
        """Return the observations (entries, N) of rows."""
        return rows[:, self._entries].astype(np.float32).T


def _places(arrays: Sequence[NDArray[Any]]) -> list[slice]:
    """Return the place of each array (…, 1) in a row."""
    ends = itertools.accumulate((array.size for array in arrays), initial=0)
    return [slice(*span) for span in itertools.pairwise(ends)]
