"""Arrays of N runs with the batch axis last, and records of such arrays."""

import dataclasses
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def take_runs(state: Any, runs: NDArray[np.int64]) -> Any:
    """Return the given runs of a state, in this order and possibly repeated.

    Args:
        state: Dataclasses, dictionaries and tuples of arrays (…, N), or functions that return them.
        runs: Numbers of the runs.
    """
    if isinstance(state, np.ndarray):
        return state.take(runs, axis=-1)
    if state is None:
        return None
    if isinstance(state, tuple):
        return _tuple_like(state, (take_runs(part, runs) for part in state))
    if isinstance(state, dict):
        return {name: take_runs(part, runs) for name, part in state.items()}
    if callable(state):
        return lambda: take_runs(state(), runs)
    return type(state)(
        *(take_runs(getattr(state, field.name), runs) for field in dataclasses.fields(state))
    )


def merge_runs(old: Any, new: Any, runs: NDArray[np.int64]) -> Any:
    """Return ``old`` with ``new`` in the given runs, through dataclasses and tuples."""
    if isinstance(old, np.ndarray):
        result = old.copy()
        result[..., runs] = new
        return result
    if old is None:
        return None
    if isinstance(old, dict):
        return {name: merge_runs(part, new[name], runs) for name, part in old.items()}
    if isinstance(old, tuple):
        return _tuple_like(old, (merge_runs(a, b, runs) for a, b in zip(old, new, strict=True)))
    return type(old)(
        *(
            merge_runs(getattr(old, field.name), getattr(new, field.name), runs)
            for field in dataclasses.fields(old)
        )
    )


def _tuple_like(like: Any, parts: Iterable[Any]) -> Any:
    return type(like)(*parts) if hasattr(like, "_fields") else tuple(parts)
