"""A step of N runs as one program that JAX compiles.

The import switches JAX to 64 bits and to a persistent compilation cache. The cache's folder is
JAX's ``jax_compilation_cache_dir``, by default ``~/.cache/fusion-gym/jax``.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array, arrays_of, map_arrays
from fusion_gym.core.memory import Memory
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.rows import RowStep
from fusion_gym.core.runs import Branch, Position, advance, start_of
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
    """A step that JAX compiles.

    Args:
        task: The task.
        memory: A memory without states.
        layout: The layout of the observation.
    """

    def __init__(self, task: Task, memory: Memory, layout: ObservationLayout) -> None:
        super().__init__(task, memory, layout)
        self._program = jax.jit(self._trace)

    def __call__(self, rows: Array, requests: NDArray[Any], noise: Array) -> Array:
        """Return the rows after a step with requests (sensors, N) and noise (channels, N)."""
        return np.asarray(self._program(rows, requests, noise))

    def _trace(self, rows: Any, requests: Any, noise: Any) -> Any:
        arrays = arrays_of(self.position(rows))
        results = step_arrays(self, arrays, requests, noise)
        results[-1] = results[-1].T
        return jnp.concatenate([x.reshape(-1, len(rows)) for x in results], dtype=np.float64).T


refuse_in_forks(JittedStep, "__call__")


def start_arrays(step: RowStep, noise: Any, first: Any, price: Any, limit: Any) -> list[Any]:
    """Return the arrays of a row at a start, from noise, price and limit of steps."""
    task = step.runs[0]
    begun = map_arrays(jnp.asarray, start_of(task, noise)[0])
    steps: Any = jnp.zeros(len(price), dtype=np.int64)
    position = Position(advance(task, begun, first, steps), price, steps, limit)
    position = map_arrays(jnp.asarray, position)
    return [*arrays_of(position), *step.results, Branch(*step.runs, position).observe()]


def step_arrays(step: RowStep, arrays: Sequence[Any], requests: Any, noise: Any) -> list[Any]:
    """Return the arrays of a row after a step, from a position's arrays, requests and noise."""
    values = iter(arrays)
    branch = Branch(*step.runs, map_arrays(lambda _: next(values), step.template))
    outcome = branch.step(requests, noise)
    states = arrays_of(branch.position()), outcome, arrays_of(branch.delivered)
    return [*itertools.chain(*states), branch.observe()]
