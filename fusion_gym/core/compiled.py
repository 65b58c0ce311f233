"""A step of N runs as one program that JAX compiles.

The import switches JAX to 64 bits and to a persistent compilation cache. The cache's folder is
JAX's ``jax_compilation_cache_dir``, by default ``~/.cache/fusion-gym/jax``.
"""

from __future__ import annotations

import dataclasses
import math
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.core.memory import Memory
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.runs import Branch, Outcome, Position
from fusion_gym.core.task import Task
from fusion_gym.importing import require

require("an environment under JAX", "jax", "jax")
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
from jax._src.xla_bridge import backends_are_initialized  # noqa: E402

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_cpu_enable_async_dispatch", False)  # threads cost more than a step
if getattr(jax.config, "jax_compilation_cache_dir", None) is None:
    folder = Path.home() / ".cache" / "fusion-gym" / "jax"
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)

# A program whose arrays have at most 512 bytes runs in one thread, twice as fast at one run.
_ROWS = 64


def register_state(state: Any) -> None:
    """Register the dataclasses of states with JAX, through tuples and dataclasses."""
    if isinstance(state, tuple):
        for part in state:
            register_state(part)
    elif dataclasses.is_dataclass(state):
        names = [field.name for field in dataclasses.fields(state)]
        if jax.tree_util.all_leaves([state]):
            jax.tree_util.register_dataclass(type(state), names, [])
        for name in names:
            register_state(getattr(state, name))


def refuse_in_forks(owner: type, *methods: str) -> None:
    """Make methods raise in a fork of a process that has run JAX, whose threads are absent."""

    def refuse(*_: Any, **__: Any) -> None:
        raise RuntimeError(
            "JAX may hang in a fork of a process that has run it: use the start method 'spawn' or "
            "backend='numpy'"
        )

    def forked() -> None:
        for method in methods if backends_are_initialized() else ():
            setattr(owner, method, refuse)

    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=forked)


class Result(NamedTuple):
    """The outcome of a step, and the observations (entries, N) after it."""

    outcome: Outcome
    observation: NDArray[np.float32]


class CompiledStep:
    """A step and its observation, with few arrays of float64 in and out.

    JAX takes longer to pass many arrays than to compute a step of one run, so the entries of a
    position are rows of few arrays, of which NumPy's positions have views. A copy begins at
    :meth:`pack`.

    Args:
        task: The task.
        memory: A memory without states.
        layout: The layout of the observation.
    """

    def __init__(self, task: Task, memory: Memory, layout: ObservationLayout) -> None:
        self._runs, self._program = (task, memory, layout), jax.jit(self._trace)

    def __reduce__(self) -> Any:
        return type(self), self._runs

    def __deepcopy__(self, memo: Any) -> CompiledStep:
        return self  # what it has compiled fits the copy

    def pack(self, position: Position) -> Any:
        """Return the rows of a position, a list of arrays (rows, N)."""
        register_state(position)
        self._position = _Rows(position)
        return self._position.pack(np, position)

    def __call__(
        self, rows: list[Any], requests: NDArray[Any], noise: Array
    ) -> tuple[list[Any], Result]:
        """Return the rows and the results after a step."""
        rows, result = self._program(rows, requests, noise)
        return rows, self._result.unpack(result)

    def position(self, rows: list[Any]) -> Position:
        """Return the position of rows."""
        return self._position.unpack(rows)

    def _trace(self, rows: Any, requests: Any, noise: Any) -> tuple[list[Any], list[Any]]:
        runs = Branch(*self._runs, self._position.unpack(rows))
        outcome = runs.step(requests, noise)
        result = Result(outcome, runs.observe().T)
        self._result = _Rows(result)
        return self._position.pack(jnp, runs.position()), self._result.pack(jnp, result)


refuse_in_forks(CompiledStep, "__call__")


class _Rows:
    """The shapes and types of a tree of arrays (…, N), and its form as few arrays (rows, N)."""

    def __init__(self, tree: Any) -> None:
        leaves, self._tree = jax.tree.flatten(tree)
        self._leaves: list[tuple[int, slice, tuple[int, ...], Any]] = []
        array = end = 0
        for leaf in leaves:
            rows = math.prod(leaf.shape[:-1])
            if end and end + rows > _ROWS:
                array, end = array + 1, 0
            self._leaves.append((array, slice(end, end + rows), leaf.shape[:-1], leaf.dtype))
            end += rows

    def pack(self, xp: Any, tree: Any) -> list[Any]:
        arrays: list[list[Any]] = [[] for _ in range(self._leaves[-1][0] + 1)]
        for (array, *_), leaf in zip(self._leaves, jax.tree.leaves(tree), strict=True):
            arrays[array].append(leaf.reshape(-1, leaf.shape[-1]))
        return [xp.concatenate(rows, dtype=np.float64) for rows in arrays]

    def unpack(self, arrays: list[Any]) -> Any:
        runs = arrays[0].shape[-1]
        if isinstance(arrays[0], jax.Array) and not isinstance(arrays[0], jax.core.Tracer):
            arrays = [np.asarray(array) for array in arrays]
        leaves = []
        for array, rows, shape, kind in self._leaves:
            leaf = arrays[array][rows].reshape(*shape, runs)
            leaves.append(leaf if kind == np.float64 else leaf.astype(kind))
        return jax.tree.unflatten(self._tree, leaves)
