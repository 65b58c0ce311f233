"""Costs of a rule's episodes, with the rule, the step and the memory in one loop in machine code.

JAX traces the rule, whose parameters differ between the runs; LLVM compiles the loop.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array, arrays_of, map_arrays
from fusion_gym.core.batch import draw_episodes
from fusion_gym.core.compiled import RowStep
from fusion_gym.core.knowledge import covers
from fusion_gym.core.memory import Memory
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.runs import Branch
from fusion_gym.core.task import Task
from fusion_gym.errors import ConfigurationError
from fusion_gym.lowering import Buffer, LoweringError
from fusion_gym.namespace import namespace
from fusion_gym.policies.base import owner_of, refused_signals

_FEWEST = 300_000  # steps of all runs, below which NumPy takes less time than a compilation
_TOGETHER = 64  # runs whose rows stay in the cache of the processor
_REAL = np.dtype(np.float64)


class RuleLoop:
    """Episodes of a rule without variables.

    Args:
        task: The task.
        rule: The rule, a dataclass.
        sizes: Numbers per run, 1 or one for each sensor, of each field of the rule that differs
            between the runs.

    Attributes:
        sizes: The argument.

    Raises:
        LoweringError: The step or the rule has a primitive that is not lowered, or too many
            instructions.
        ConfigurationError: JAX is absent, and the code is not in the cache.
    """

    def __init__(self, task: Task, rule: Any, sizes: Mapping[str, int]) -> None:
        from fusion_gym.core.compiled import compile_function

        owner = owner_of(rule) or "scheduler"
        self._step = RowStep(task, Memory(task, owner), ObservationLayout(task, owner))
        self._task, self._rule, self.sizes = task, rule, dict(sizes)
        self._refused = refused_signals(rule, task)
        self._local = not covers(rule.knowledge, "centre")
        values = tuple(np.zeros((size, 1)) for size in sizes.values())
        requests = np.zeros((task.sensors, 1), np.bool_)
        self._template: Any = self._step.template, values, requests, np.zeros((2, 1))
        arrays = arrays_of(self._template)
        self._width = sum(array.size for array in arrays)
        own = (field.name for field in dataclasses.fields(rule) if field.name != "task")
        others = {name: getattr(rule, name) for name in own if name not in sizes}
        key, row = (task, type(rule), others, self.sizes), Buffer(_REAL, arrays, self._width)
        step, limit = self._step, np.zeros(1, np.int64)
        inputs: Any = step.start_noise, step.noise, np.zeros(1), limit, *values
        sources = [Buffer(array.dtype, [array]) for array in inputs]
        self._start = compile_function((*key, "start"), self._begin, sources, [row])
        sources = [row, Buffer(_REAL, [step.noise])]
        self._move = compile_function((*key, "step"), self._advance, sources, [row])

    def costs(self, values: Mapping[str, Array], seeds: NDArray[np.int64], prices: Array) -> Array:
        """Return error and tokens (2, N), means over the steps of an episode.

        Args:
            values: Values (…, N) of the fields.
            seeds: Seeds (N,).
            prices: Price of a token (N,).
        """
        horizon, result = self._task.horizon, np.empty((2, len(seeds)))
        different, places = np.unique(seeds, return_inverse=True)
        starts, noise = draw_episodes(self._task, different)
        for first in range(0, len(seeds), _TOGETHER):
            part = slice(first, first + _TOGETHER)
            some, price = places[part], np.ascontiguousarray(prices[part], _REAL)
            normals, runs = noise.take(some, axis=-1), len(some)
            rows, limit = np.empty((2, runs, self._width)), np.full(runs, horizon)
            own = [np.ascontiguousarray(values[field][:, part], _REAL) for field in self.sizes]
            inputs = starts.take(some, axis=-1), normals[0], price, limit, *own
            before, after = (row.ctypes.data for row in rows)
            self._start(runs, *(array.ctypes.data for array in inputs), before)
            for step in range(1, horizon + 1):
                address = normals.ctypes.data + step * normals.strides[0]
                self._move(runs, before, address, after)
                before, after = after, before
            result[:, part] = rows[horizon % 2, :, -2:].T / horizon
        return result

    def _begin(self, start: Any, noise: Any, price: Any, limit: Any, *values: Any) -> list[Any]:
        """Return the arrays of a row at the start."""
        branch = self._step.begin_run(start, noise, price, limit)
        return self._arrays(branch, values, namespace(price).zeros((2, 1)))

    def _advance(self, arrays: list[Any], noise: Any) -> list[Any]:
        """Return the arrays of a row after a step, from those before and noise."""
        parts, (task, memory, layout) = iter(arrays), self._step.runs
        (position, states), values, requests, sums = map_arrays(
            lambda _: next(parts), self._template
        )
        branch = Branch(task, memory.with_states(states), layout, position)
        outcome = branch.step(requests, noise)
        costs = namespace(sums).stack([-outcome.reward_error, outcome.cost])
        return self._arrays(branch, values, sums + costs)

    def _arrays(self, branch: Branch, values: Any, sums: Any) -> list[Any]:
        changes = {name: value[:, 0] for name, value in zip(self.sizes, values, strict=True)}
        rule = dataclasses.replace(self._rule, **changes)
        requests = rule(branch.signals().limit(self._refused, self._local))
        requests = namespace(sums).broadcast_to(requests, (self._task.sensors, 1))
        return arrays_of(((branch.position(), branch.memory.states), values, requests, sums))


def make_loop(task: Task, rule: Any, sizes: Mapping[str, int], run_steps: int) -> RuleLoop | None:
    """Return the loop of a rule, or ``None`` where NumPy is faster or alone runs it.

    Args:
        task: The task.
        rule: The rule, a dataclass.
        sizes: As of :class:`RuleLoop`.
        run_steps: Steps of all runs.
    """
    foreign = task.noise is not None or task.network.rule.by_channel
    if run_steps < _FEWEST or foreign or not rule.stateless:
        return None
    try:
        task.refuse_numpy_only()
        return RuleLoop(task, rule, sizes)
    except (ConfigurationError, LoweringError):
        return None
