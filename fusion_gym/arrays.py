"""Arrays of N runs with the batch axis last, and records of such arrays."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Lazy:
    """A value that is computed on first access."""

    def __init__(self, compute: Callable[[], Any]) -> None:
        self._compute = compute

    @functools.cached_property
    def value(self) -> Any:
        """The value."""
        return self._compute()

    def __getstate__(self) -> dict[str, Any]:
        return {"value": self.value}


def value_of(value: Any) -> Any:
    """Return the value of a :class:`Lazy`, and any other value as it is."""
    return value.value if isinstance(value, Lazy) else value


def take_runs(state: Any, runs: NDArray[np.int64]) -> Any:
    """Return the given runs of a state, in this order and possibly repeated.

    Args:
        state: Dataclasses, dictionaries and tuples of arrays (…, N), or functions that return them.
            Arrays (…, 1) are equal in all runs.
        runs: Numbers of the runs.
    """

    def taken(array: NDArray[Any]) -> NDArray[Any]:
        if array.shape[-1] == 1:
            return array.repeat(len(runs), axis=-1)
        return array.take(runs, axis=-1)

    return map_arrays(taken, state)


def merge_runs(old: Any, new: Any, runs: NDArray[np.int64]) -> Any:
    """Return ``old`` with ``new`` in the given runs, through dataclasses and tuples."""

    def merged(array: NDArray[Any], part: NDArray[Any]) -> NDArray[Any]:
        result = array.copy()
        result[..., runs] = part
        return result

    return map_arrays(merged, old, new)


def arrays_of(state: Any) -> list[NDArray[Any]]:
    """Return the arrays of a state, in the order of :func:`map_arrays`."""
    result: list[NDArray[Any]] = []
    map_arrays(result.append, state)
    return result


def map_arrays(function: Callable[..., Any], first: Any, *others: Any) -> Any:
    """Return a state of the form of ``first``, with a function of the arrays in each place."""
    if hasattr(first, "dtype"):
        return function(first, *others)
    if first is None:
        return None
    if isinstance(first, tuple):
        parts = [map_arrays(function, *each) for each in zip(first, *others, strict=True)]
        return type(first)(*parts) if hasattr(first, "_fields") else tuple(parts)
    if isinstance(first, dict):
        return {
            name: map_arrays(function, part, *(other[name] for other in others))
            for name, part in first.items()
        }
    if callable(first):
        return lambda: map_arrays(function, first(), *(other() for other in others))
    names = (field.name for field in dataclasses.fields(first))
    states = (first, *others)
    fields = ((getattr(state, name) for state in states) for name in names)
    return type(first)(*(map_arrays(function, *each) for each in fields))
