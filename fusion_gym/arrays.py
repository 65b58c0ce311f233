"""Arrays of N runs with the batch axis last, and records of such arrays."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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

    return _mapped(taken, state)


def merge_runs(old: Any, new: Any, runs: NDArray[np.int64]) -> Any:
    """Return ``old`` with ``new`` in the given runs, through dataclasses and tuples."""

    def merged(array: NDArray[Any], part: NDArray[Any]) -> NDArray[Any]:
        result = array.copy()
        result[..., runs] = part
        return result

    return _mapped(merged, old, new)


def _mapped(function: Callable[..., Any], first: Any, *others: Any) -> Any:
    """Return a state of the form of ``first``, with a function of the arrays in each place."""
    if isinstance(first, np.ndarray):
        return function(first, *others)
    if first is None:
        return None
    if isinstance(first, tuple):
        parts = [_mapped(function, *each) for each in zip(first, *others, strict=True)]
        return type(first)(*parts) if hasattr(first, "_fields") else tuple(parts)
    if isinstance(first, dict):
        return {
            name: _mapped(function, part, *(other[name] for other in others))
            for name, part in first.items()
        }
    if callable(first):
        return lambda: _mapped(function, first(), *(other() for other in others))
    names = (field.name for field in dataclasses.fields(first))
    states = (first, *others)
    fields = ((getattr(state, name) for state in states) for name in names)
    return type(first)(*(_mapped(function, *each) for each in fields))
