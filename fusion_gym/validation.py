"""Checks of what a user hands in: one clear error, with the field, its value and what is allowed.

Every check returns the value in the form the library works with (float64 arrays, Python ints)
and raises :class:`ConfigurationError` otherwise.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym.arrays import Array


class ConfigurationError(ValueError):
    """A setting that cannot be used; the message names the field, its value and what is allowed."""


def _refuse(field: str, value: Any, allowed: str) -> ConfigurationError:
    text = repr(value.tolist() if isinstance(value, np.ndarray) else value)
    return ConfigurationError(f"{field} = {text} is not allowed: it must be {allowed}")


def _numbers(field: str, value: ArrayLike, allowed: str) -> Array:
    """The value as a float64 array; text, booleans, complex numbers and ragged lists are none."""
    try:
        given = np.asarray(value)
    except ValueError:
        raise _refuse(field, value, allowed) from None
    if given.dtype.kind not in "iuf":
        raise _refuse(field, value, allowed)
    return np.array(given, dtype=np.float64)


def array(field: str, value: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """A finite float64 array of the given shape; ``None`` in the shape stands for any length >= 1.

    Raises:
        ConfigurationError: not numeric, not finite, or of another shape.
    """
    result = _numbers(field, value, "an array of numbers")
    wanted = "(" + ", ".join("any" if size is None else str(size) for size in shape) + ")"
    matches = len(shape) == result.ndim and all(
        have >= 1 if size is None else have == size
        for size, have in zip(shape, result.shape, strict=False)
    )
    if not matches:
        raise _refuse(field, value, f"an array of shape {wanted}, not {result.shape}")
    if not np.all(np.isfinite(result)):
        raise _refuse(field, value, "finite")
    return result


def spread(field: str, value: ArrayLike, shape: tuple[int, ...], *, infinity: int = 0) -> Array:
    """Like :func:`array`, but a value that broadcasts to ``shape`` (one number for all) will do.

    ``infinity`` of 1 or -1 allows infinity of that sign as well.

    Raises:
        ConfigurationError: not numeric, not finite, or not broadcastable to ``shape``.
    """
    allowed = f"a number or an array of shape {shape}"
    given = _numbers(field, value, allowed)
    try:
        result = np.broadcast_to(given, shape).copy()
    except ValueError:
        raise _refuse(field, value, allowed) from None
    valid = np.isfinite(result) | (np.isinf(result) & (np.sign(result) == infinity))
    if not valid.all():
        extra = {0: "", 1: " or infinity", -1: " or minus infinity"}[infinity]
        raise _refuse(field, value, f"finite{extra}")
    return result


def number(
    field: str,
    value: Any,
    *,
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
) -> float:
    """A finite real number within the stated limits.

    Raises:
        ConfigurationError: not a number, not finite, or outside the limits.
    """
    limits = [
        text
        for limit, text in (
            (above, f"> {above}"),
            (at_least, f">= {at_least}"),
            (at_most, f"<= {at_most}"),
        )
        if limit is not None
    ]
    allowed = "a finite number" + (" " + " and ".join(limits) if limits else "")
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise _refuse(field, value, allowed)
    result = float(value)
    outside = (
        not np.isfinite(result)
        or (above is not None and result <= above)
        or (at_least is not None and result < at_least)
        or (at_most is not None and result > at_most)
    )
    if outside:
        raise _refuse(field, value, allowed)
    return result


def integer(field: str, value: Any, *, at_least: int, at_most: int | None = None) -> int:
    """A whole number within the stated limits (``True``, 2.0 and "2" are not whole numbers).

    Raises:
        ConfigurationError: not an integer or outside the limits.
    """
    allowed = f"a whole number >= {at_least}" + ("" if at_most is None else f" and <= {at_most}")
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise _refuse(field, value, allowed)
    if value < at_least or (at_most is not None and value > at_most):
        raise _refuse(field, value, allowed)
    return int(value)


def boolean(field: str, value: Any) -> bool:
    """``True`` or ``False``.

    Raises:
        ConfigurationError: anything else.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise _refuse(field, value, "True or False")
    return bool(value)


def choice(field: str, value: Any, options: Iterable[str]) -> str:
    """One of the named options.

    Raises:
        ConfigurationError: not among them; the message lists them and the nearest match.
    """
    names = list(options)
    if isinstance(value, str) and value in names:
        return value
    near = difflib.get_close_matches(str(value), names, n=1)
    hint = f" (did you mean {near[0]!r}?)" if near else ""
    raise _refuse(field, value, "one of " + ", ".join(map(repr, names)) + hint)


def keys(kind: str, given: Iterable[str], known: Iterable[str]) -> None:
    """Every given key is known.

    Raises:
        ConfigurationError: names the first unknown key, the nearest match and all known keys.
    """
    names = sorted(known)
    for key in given:
        if key not in names:
            near = difflib.get_close_matches(str(key), names, n=1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            listed = ", ".join(names) or "none"
            raise ConfigurationError(f"unknown {kind} {key!r}: {hint}known are {listed}")


def covariance(field: str, value: ArrayLike, size: int, *, definite: bool = False) -> Array:
    """A symmetric positive semi-definite (or, on demand, definite) matrix of shape (size, size).

    Raises:
        ConfigurationError: another shape, not symmetric, or a negative (zero) eigenvalue.
    """
    matrix = array(field, value, (size, size))
    if not np.allclose(matrix, matrix.T, rtol=1e-10, atol=1e-14):
        raise _refuse(field, matrix, "symmetric")
    smallest = float(np.linalg.eigvalsh(matrix)[0])
    scale = max(float(np.abs(matrix).max()), 1e-300)
    if definite and smallest <= 1e-14 * scale:
        raise _refuse(
            field, matrix, f"positive definite (its smallest eigenvalue is {smallest:.3g})"
        )
    if smallest < -1e-12 * scale:
        raise _refuse(
            field, matrix, f"positive semi-definite (its smallest eigenvalue is {smallest:.3g})"
        )
    return (matrix + matrix.T) / 2


def positive(field: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    """A number or array, broadcast to ``shape``, of entries > 0.

    Raises:
        ConfigurationError: not numeric, another shape, or an entry <= 0.
    """
    result = spread(field, value, shape)
    if np.any(result <= 0):
        raise _refuse(field, value, "> 0 everywhere")
    return result


def not_negative(field: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    """A number or array, broadcast to ``shape``, of entries >= 0.

    Raises:
        ConfigurationError: not numeric, another shape, or a negative entry.
    """
    result = spread(field, value, shape)
    if np.any(result < 0):
        raise _refuse(field, value, ">= 0 everywhere")
    return result


def one_or_each(value: ArrayLike) -> tuple[int, ...]:
    """The shape of a parameter that is one number for all sensors, (), or one for each, (l,)."""
    given = np.asarray(value)
    return given.shape if given.ndim == 1 else ()


def adaptive_thresholds(rho_bar: ArrayLike, rho_initial: ArrayLike, adaptation: ArrayLike) -> None:
    """0 <= ρ₀ <= ρ̄ <= 1 and λ > 0, each one number or one a sensor.

    Raises:
        ConfigurationError: anything else.

    Source: unknown_input, equations (5)-(7).
    """
    limit = not_negative("rho_bar", rho_bar, one_or_each(rho_bar))
    if np.any(limit > 1.0):
        raise _refuse("rho_bar", rho_bar, ">= 0 and <= 1")
    initial = not_negative("rho_initial", rho_initial, one_or_each(rho_initial))
    if initial.ndim == limit.ndim == 1 and len(initial) != len(limit):
        raise _refuse(
            "rho_initial", rho_initial, f"a number, or as many as rho_bar = {rho_bar!r} has"
        )
    if np.any(initial > limit):
        raise _refuse("rho_initial", rho_initial, f"<= rho_bar = {rho_bar!r}")
    positive("adaptation", adaptation, one_or_each(adaptation))
