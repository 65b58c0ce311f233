"""A step of N runs as one program that JAX compiles.

The import switches JAX to 64 bits and to a persistent compilation cache. The cache's folder is
JAX's ``jax_compilation_cache_dir``, by default ``~/.cache/fusion-gym/jax``.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array, arrays_of, map_arrays
from fusion_gym.core import code_cache
from fusion_gym.core.rows import RowStep
from fusion_gym.core.runs import Branch, Position, advance, start_of
from fusion_gym.importing import require

require("an environment under JAX", "jax", "jax")
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
from jax._src.xla_bridge import backends_are_initialized  # noqa: E402

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_cpu_enable_async_dispatch", False)  # threads cost more than a step
_chosen = getattr(jax.config, "jax_compilation_cache_dir", None)
if _chosen is None and (folder := code_cache.folder_of("jax")):
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


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


class JittedStep(RowStep):
    """A step that JAX compiles, with the arguments of :class:`RowStep`."""

    def __init__(self, *parts: Any) -> None:
        super().__init__(*parts)
        self._program = jax.jit(self._trace)

    def __call__(self, rows: Array, requests: NDArray[Any], noise: Array) -> Array:
        """Return the rows after a step with requests (sensors, N) and noise (channels, N)."""
        return np.asarray(self._program(rows, requests, noise))

    def _trace(self, rows: Any, requests: Any, noise: Any) -> Any:
        arrays = arrays_of(self.moved(rows))
        results = step_arrays(self, arrays, requests, noise)
        results[-1] = results[-1].T
        return jnp.concatenate([x.reshape(-1, len(rows)) for x in results], dtype=np.float64).T


refuse_in_forks(JittedStep, "__call__")


def begin(step: RowStep, noise: Any, first: Any, price: Any, limit: Any) -> Branch:
    """Return a run at the start of an episode, from noise, price and limit of steps."""
    task = step.runs[0]
    begun, announcement = start_of(task, noise)
    begun = map_arrays(jnp.asarray, begun)
    steps: Any = jnp.zeros(len(price), dtype=np.int64)
    position = Position(advance(task, begun, first, steps), price, steps, limit)
    position = map_arrays(jnp.asarray, position)
    measured = (task.plant.measurement(part.plant) for part in (begun, position.state))
    memory = step.begin_memory(announcement, *measured)
    memory.states = map_arrays(jnp.asarray, memory.states)
    return Branch(task, memory, step.runs[2], position)


def start_arrays(step: RowStep, *inputs: Any) -> list[Any]:
    """Return the arrays of a row at the start of :func:`begin`."""
    branch = begin(step, *inputs)
    moved = branch.position(), branch.memory.states
    return [*arrays_of(moved), *step.results, branch.observe()]


def step_arrays(step: RowStep, arrays: Sequence[Any], requests: Any, noise: Any) -> list[Any]:
    """Return the arrays of a row after a step, from a position's arrays, requests and noise."""
    values, (task, memory, layout) = iter(arrays), step.runs
    position, states = map_arrays(lambda _: next(values), step.template)
    branch = Branch(task, memory.with_states(states), layout, position)
    outcome = branch.step(requests, noise)
    moved = branch.position(), branch.memory.states
    return [*arrays_of(moved), *outcome, *arrays_of(branch.delivered), branch.observe()]
