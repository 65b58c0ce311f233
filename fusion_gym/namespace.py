"""One source for NumPy and JAX: the namespace of an array, and updates that both allow.

A function begins with ``xp = namespace(a)`` and calls ``xp.where`` and the like. NumPy's arrays are
updated in place, JAX's are replaced, so callers continue with the returned array.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

_NDARRAY = np.ndarray
_FAULTY = (26.0, 28.0)  # jax.scipy.special.erfcx returns 0 in a part of this interval


def namespace(array: Any, other: Any = None) -> Any:
    """Return ``jax.numpy`` if one of the arrays is JAX's, and otherwise ``numpy``."""
    if type(array) is _NDARRAY and (other is None or type(other) is _NDARRAY):
        return np
    for item in (array, other):
        find = getattr(item, "__array_namespace__", None)
        if find is not None and (xp := find()) is not np:
            return xp
    return np


def as_array(value: Any) -> Any:
    """Return a JAX array as it is, and any other value as a NumPy array of float64."""
    return np.asarray(value, dtype=np.float64) if namespace(value) is np else value


def set_at(array: Any, index: tuple[Any, ...], value: Any) -> Any:
    """Return ``array`` with ``array[index] = value``.

    Under JAX padding replaces a scatter, which XLA cannot fuse.

    Args:
        array: The array; NumPy's is changed in place.
        index: An ellipsis, then whole numbers and slices with step 1 for the last axes.
        value: Broadcasts to ``array[index]``.
    """
    if type(array) is _NDARRAY:
        array[index] = value
        return array
    xp, value = namespace(array), namespace(array).broadcast_to(value, array[index].shape)
    index, lead = index[1:], array.ndim - len(index) + 1
    sizes = array.shape[lead:]
    spans = [
        part.indices(size)[:2] if isinstance(part, slice) else (part % size, part % size + 1)
        for part, size in zip(index, sizes, strict=True)
    ]
    # a mask of all runs would be a constant that grows with them
    widths = [1 if span == (0, size) else size for span, size in zip(spans, sizes, strict=True)]
    mask = np.zeros(widths, dtype=np.bool_)
    mask[tuple(slice(*span) for span in spans)] = True
    for axis, part in enumerate(index):
        if not isinstance(part, slice):
            value = xp.expand_dims(value, lead + axis)
    pads = [(0, 0)] * lead + [(a, size - b) for (a, b), size in zip(spans, sizes, strict=True)]
    return xp.where(mask, xp.pad(value, pads), array)


def update_at(function: np.ufunc, array: Any, index: tuple[Any, ...], value: Any) -> Any:
    """Return ``array`` with ``array[index] = function(array[index], value)``.

    Args:
        function: A function of two arguments such as ``numpy.add``.
        array: The array; NumPy's is changed in place.
        index: As in :func:`set_at`.
        value: Broadcasts to ``array[index]``.
    """
    part = array[index]
    if type(array) is _NDARRAY:
        function(part, value, out=part)
        return array
    return set_at(array, index, getattr(namespace(array), function.__name__)(part, value))


def in_lanes(
    mask: Any,
    function: Callable[..., Sequence[Any]],
    arguments: Sequence[Any],
    results: Sequence[Any],
    default: Sequence[float],
) -> Sequence[Any]:
    """Return ``results`` with ``function(*arguments)`` where ``mask`` holds.

    NumPy evaluates the function on these elements only, JAX on all if the mask holds anywhere.

    Args:
        mask: Bool, of the shape of the arguments and results.
        function: Element by element on one-dimensional arguments.
        arguments: Arrays.
        results: Arrays; NumPy's are changed in place.
        default: Arguments of the other elements under JAX, at which the function is finite.
    """
    xp = namespace(mask)
    if xp is np:
        if mask.any():
            values = function(*(argument[mask] for argument in arguments))
            for result, value in zip(results, values, strict=True):
                result[mask] = value
        return results
    from jax import lax

    def every(values: Sequence[Any]) -> tuple[Any, ...]:
        pairs = zip(arguments, default, strict=True)
        inputs = [xp.where(mask, argument, number).ravel() for argument, number in pairs]
        new = (value.reshape(mask.shape) for value in function(*inputs))
        return tuple(xp.where(mask, a, b) for a, b in zip(new, values, strict=True))

    return lax.cond(mask.any(), every, tuple, tuple(results))


def in_runs(
    mask: Any,
    function: Callable[..., Sequence[Any]],
    arguments: Sequence[Any],
    results: Sequence[Any],
) -> Sequence[Any]:
    """Return ``results`` with ``function(*arguments)`` in the runs of ``mask``.

    NumPy evaluates the function on these runs only, JAX on all if the mask holds anywhere.

    Args:
        mask: (…, N) bool; a run is selected if any of its entries holds.
        function: Run by run on arrays (…, N).
        arguments: Arrays (…, N) or (…, 1).
        results: Arrays (…, N); NumPy's are changed in place.
    """
    xp = namespace(mask)
    if xp is np:
        if mask.any():
            runs = np.flatnonzero(mask.reshape(-1, mask.shape[-1]).any(0))
            parts = (part if part.shape[-1] == 1 else part.take(runs, -1) for part in arguments)
            for result, value in zip(results, function(*parts), strict=True):
                result[..., runs] = value
        return results
    from jax import lax

    def every(values: Sequence[Any]) -> tuple[Any, ...]:
        pairs = zip(function(*arguments), values, strict=True)
        return tuple(xp.where(selected, new, old) for new, old in pairs)

    selected = mask.reshape(-1, mask.shape[-1]).any(0)
    return lax.cond(selected.any(), every, tuple, tuple(results))


def runs_of(mask: Any) -> Any:
    """Return the numbers of the runs of ``mask`` (N,), or the mask itself under JAX."""
    return np.flatnonzero(mask) if type(mask) is _NDARRAY else mask


def at_runs(array: Any, runs: Any) -> Any:
    """Return the part of :func:`runs_of` with a contiguous batch axis; under JAX the whole."""
    some = type(runs) is _NDARRAY and type(array) is _NDARRAY
    return array.take(runs, axis=-1) if some else array


def put_runs(array: Any, runs: Any, values: Any) -> Any:
    """Return ``array`` with the ``values`` of :func:`at_runs`; NumPy's is changed in place."""
    if isinstance(runs, slice):
        return values
    if type(runs) is _NDARRAY:
        array[..., runs] = values
        return array
    return namespace(values, array).where(runs, values, array)


def repeat(step: Callable[..., tuple[Any, Any]], state: Any, most: int) -> Any:
    """Return the state after ``step``, at most ``most`` times.

    Args:
        step: From a state, a tuple of arrays, to whether it goes on and the next state.
        state: The first state; NumPy's arrays may be changed in place.
        most: Largest number of steps.
    """
    if namespace(*state[:2]) is np:
        for _ in range(most):
            goes_on, state = step(state)
            if not goes_on:
                break
        return state
    from jax import lax

    def next_one(carry: Any) -> Any:
        return carry[0] + 1, *step(carry[2])

    first = 0, namespace(*state[:2]).asarray(True), state
    return lax.while_loop(lambda carry: carry[1] & (carry[0] < most), next_one, first)[2]


def take(table: Any, place: Any) -> Any:
    """Return the entries (…, N) of a table (…, T) at the places (N,)."""
    if type(place) is _NDARRAY:
        return table.take(place, -1)
    return namespace(place).take(table, place, axis=-1)


def active_rows(mask: Any) -> NDArray[np.int64]:
    """Return the rows of ``mask`` (rows, N) that hold anywhere; under JAX all rows."""
    return np.flatnonzero(mask.any(-1)) if namespace(mask) is np else np.arange(len(mask))


def ranked_sum(values: Any, place: Any) -> Any:
    """Return for each entry (rows, N) the sum of a run's entries up to its place, a permutation."""
    xp = namespace(values, place)
    if xp is not np:
        ordered = xp.take_along_axis(values, xp.argsort(place, axis=0), axis=0)
        return xp.take_along_axis(xp.cumsum(ordered, axis=0), place, axis=0)
    total, place = np.empty(values.shape), place * values.shape[1] + np.arange(values.shape[1])
    total.reshape(-1)[place] = values
    return np.cumsum(total, axis=0).take(place)


def ndtr(z: Any) -> Any:
    """Return the standard normal distribution function."""
    return _special(z).ndtr(z)


def erfcx(x: Any) -> Any:
    """Return the scaled complementary error function exp(x²) erfc(x)."""
    result = _special(x).erfcx(x)
    xp = namespace(x)
    if xp is np:
        return result
    far = xp.where((x > _FAULTY[0]) & (x < _FAULTY[1]), x, _FAULTY[1])
    small, series = 0.5 / far**2, 1.0
    for k in (9.0, 7.0, 5.0, 3.0, 1.0):
        series = 1.0 - k * small * series
    series = series / (far * np.sqrt(np.pi))
    return xp.where((x > _FAULTY[0]) & (x < _FAULTY[1]), series, result)


def _special(array: Any) -> Any:
    if namespace(array) is np:
        # Imported here, because scipy.special takes a fifth of a second to load.
        import scipy.special

        return scipy.special
    import jax.scipy.special

    return jax.scipy.special
