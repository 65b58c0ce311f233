"""Checks of what a user hands in: one clear error, with the field, its value and what is allowed.

Every check returns the value in the form the library works with (float64 arrays, Python ints)
and raises :class:`ConfigurationError` otherwise.
"""

import copy
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym.arrays import Array
from fusion_gym.errors import ConfigurationError, UnexpectedArgumentError, display, nearest, refusal

# Filters square what they are given and divide by it: from here to there float64 can hold that.
SMALLEST, LARGEST = 1e-15, 1e15
LONGEST = 100  # entries of an axis of any length; matrices are multiplied entry by entry
MOST_SENSORS = 1000  # the network serves them in a loop
MOST_RUNS = 1_000_000  # each has a generator and a block of noise
MOST_STEPS = 1000  # ahead, of a policy that plans
MOST_PERIOD = 10**9  # of a policy that requests by the clock
DEEPEST, MOST_ENTRIES = 32, 100_000  # of nested values
LONGEST_TEXT, LONGEST_YAML = 100_000_000, 1_000_000  # characters of a file
CONTROL = r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]"  # in no name, path or word
LONGEST_HORIZON = 50_000  # scales and tables are worked out step by step


def _numbers(field: str, value: ArrayLike, allowed: str) -> Array:
    """The value as a float64 array; text, booleans, complex numbers and ragged lists are none.

    Infinity and what is no number are left to the caller.
    """
    try:
        values = np.asarray(value)
    except ValueError:
        raise refusal(field, value, allowed) from None
    if values.dtype.kind not in "iuf":
        raise refusal(field, value, allowed)
    with np.errstate(over="ignore"):  # a longer kind of float than float64
        result = np.array(values, dtype=np.float64)
    if np.any((np.abs(result) > LARGEST) & np.isfinite(result)):
        raise refusal(field, value, f"at most {LARGEST:g} in magnitude")
    return result


def array(
    field: str, value: ArrayLike, shape: tuple[int | None, ...], longest: int = LONGEST
) -> Array:
    """A finite float64 array of this shape; ``None`` in it is any length from 1 to ``longest``.

    Raises:
        ConfigurationError: not numeric, not finite, or of another shape.
    """
    result = _numbers(field, value, "an array of numbers")
    required = "(" + ", ".join("any" if size is None else str(size) for size in shape) + ")"
    matches = len(shape) == result.ndim and all(
        1 <= have <= longest if size is None else have == size
        for size, have in zip(shape, result.shape, strict=False)
    )
    if not matches:
        limit = f" (any up to {longest})" if max(result.shape, default=0) > longest else ""
        raise refusal(field, value, f"an array of shape {required}{limit}, not {result.shape}")
    if not np.all(np.isfinite(result)):
        raise refusal(field, value, "finite")
    return result


def square(field: str, value: ArrayLike) -> Array:
    """A finite square matrix of float64.

    Raises:
        ConfigurationError: not numeric, not finite, or not square.
    """
    size = len(array(field, value, (None, None)))
    return array(field, value, (size, size))


def spread(field: str, value: ArrayLike, shape: tuple[int, ...], *, infinity: int = 0) -> Array:
    """Like :func:`array`, but a value that broadcasts to ``shape`` (one number for all) will do.

    ``infinity`` of 1 or -1 allows infinity of that sign as well.

    Raises:
        ConfigurationError: not numeric, not finite, or not broadcastable to ``shape``.
    """
    allowed = f"a number or an array of shape {shape}"
    values = _numbers(field, value, allowed)
    try:
        result = np.broadcast_to(values, shape).copy()
    except ValueError:
        raise refusal(field, value, allowed) from None
    valid = np.isfinite(result) | (np.isinf(result) & (np.sign(result) == infinity))
    if not valid.all():
        extra = {0: "", 1: " or infinity", -1: " or minus infinity"}[infinity]
        raise refusal(field, value, f"finite{extra}")
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
    limits = {">": above, ">=": at_least, "<=": at_most}
    listed = " and ".join(f"{sign} {limit}" for sign, limit in limits.items() if limit is not None)
    allowed = f"a finite number {listed}".rstrip()
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise refusal(field, value, allowed)
    try:
        result = float(value)
    except OverflowError:
        result = np.inf
    if LARGEST < abs(result) < np.inf:
        raise refusal(field, value, f"{allowed}, at most {LARGEST:g} in magnitude")
    if above == 0.0 and 0.0 < result < SMALLEST:
        raise refusal(field, value, f"{allowed}, at least {SMALLEST:g}")
    outside = (
        not np.isfinite(result)
        or (above is not None and result <= above)
        or (at_least is not None and result < at_least)
        or (at_most is not None and result > at_most)
    )
    if outside:
        raise refusal(field, value, allowed)
    return result


def integer(field: str, value: Any, *, at_least: int, at_most: int | None = None) -> int:
    """A whole number within the stated limits (``True``, 2.0 and "2" are not whole numbers).

    Raises:
        ConfigurationError: not an integer or outside the limits.
    """
    allowed = f"a whole number >= {at_least}" + ("" if at_most is None else f" and <= {at_most}")
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise refusal(field, value, allowed)
    if value < at_least or (at_most is not None and value > at_most):
        raise refusal(field, value, allowed)
    return int(value)


def nested(field: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield a value and all that lists and mappings within it hold, each with the key above it.

    Raises:
        ConfigurationError: too deep, as what holds itself, or too large.
    """
    left, count = [(field, value, 0)], 0
    while left:
        key, part, depth = left.pop()
        count += 1
        if depth > DEEPEST or count > MOST_ENTRIES:
            allowed = f"nested at most {DEEPEST} times, with at most {MOST_ENTRIES:,} entries"
            raise refusal(field, value, allowed)
        yield key, part
        if isinstance(part, Mapping):
            left += [(str(name), entry, depth + 1) for name, entry in part.items()]
        elif isinstance(part, (list, tuple, set, frozenset)):
            left += [(key, entry, depth + 1) for entry in part]


def limit_options(value: Mapping[str, Any]) -> None:
    """Check that options are neither deep nor large, and can be copied.

    Raises:
        ConfigurationError: one is not; names it.
    """
    for name, entry in value.items():
        for _ in nested(name, entry):
            pass
        try:
            copy.deepcopy(entry)
        except Exception:
            raise refusal(name, entry, "a value that can be copied") from None


def read_text(field: str, path: Path, name: str | None = None) -> str:
    """Return a file's text; ``name`` is what the user calls it, if that is not its path.

    Raises:
        ConfigurationError: it cannot be read, or is no text in UTF-8.
    """
    label = str(path) if name is None else name
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(LONGEST_TEXT + 1)
        if len(text) > LONGEST_TEXT:
            raise ValueError(f"it has more than {LONGEST_TEXT:,} characters")
        return text
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{field} = {label!r} is no text in UTF-8: {error}") from None
    except (OSError, ValueError) as error:  # a ValueError of a path that no system knows
        reason = getattr(error, "strerror", None) or error
        raise ConfigurationError(f"{field} = {label!r} cannot be read: {reason}") from None


def boolean(field: str, value: Any) -> bool:
    """``True`` or ``False``.

    Raises:
        ConfigurationError: anything else.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise refusal(field, value, "True or False")
    return bool(value)


def choice(field: str, value: Any, options: Iterable[str]) -> str:
    """One of the named options.

    Raises:
        ConfigurationError: not among them; the message lists them and the nearest match.
    """
    names = list(options)
    if isinstance(value, str) and value in names:
        return value
    near = nearest(value, names) if isinstance(value, str) else None
    hint = f" (did you mean {near!r}?)" if near else ""
    raise refusal(field, value, "one of " + ", ".join(map(repr, names)) + hint)


def keys(kind: str, value: Iterable[str], known: Iterable[str]) -> None:
    """Every given key is known.

    Raises:
        ConfigurationError: names the first unknown key, the nearest match and all known keys.
    """
    names = sorted(known)
    for key in value:
        if key not in names:
            raise ConfigurationError(f"unknown {kind} {display(key)}: {_known(key, names)}")


def reset_options(value: Any, known: Iterable[str]) -> None:
    """The options of a reset are a mapping, or None, and every key is known.

    Raises:
        ConfigurationError: anything else.
    """
    if value is not None and not isinstance(value, Mapping):
        raise refusal("options", value, "a dictionary of reset options, or None")
    keys("reset option", value or {}, known)


def arguments(owner: str, value: Iterable[str], known: Iterable[str]) -> None:
    """Every given keyword argument is one that ``owner`` takes.

    Raises:
        UnexpectedArgumentError: names the first that is not, the nearest match and all known ones.
    """
    names = sorted(known)
    for key in value:
        if key not in names:
            raise UnexpectedArgumentError.of(
                owner, key, f"unknown option {key!r}: {_known(key, names)}"
            )


def _known(key: Any, names: list[str]) -> str:
    near = nearest(key, names)
    hint = f"did you mean {near!r}? " if near else ""
    return f"{hint}known are {', '.join(names) or 'none'}"


def covariance(field: str, value: ArrayLike, size: int, *, definite: bool = False) -> Array:
    """A symmetric positive semi-definite (or, on demand, definite) matrix of shape (size, size).

    Raises:
        ConfigurationError: another shape, not symmetric, or a negative (zero) eigenvalue.
    """
    matrix = array(field, value, (size, size))
    if not np.allclose(matrix, matrix.T, rtol=1e-10, atol=1e-14):
        raise refusal(field, matrix, "symmetric")
    smallest = float(np.linalg.eigvalsh(matrix)[0])
    scale = float(np.abs(matrix).max())
    if definite and smallest <= max(1e-14 * scale, SMALLEST**2):
        raise refusal(
            field, matrix, f"positive definite (its smallest eigenvalue is {smallest:.3g})"
        )
    if smallest < -1e-12 * scale or (np.diagonal(matrix) < 0.0).any():
        raise refusal(
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
        raise refusal(field, value, "> 0 everywhere")
    if np.any(result < SMALLEST):
        raise refusal(field, value, f"> 0 everywhere, at least {SMALLEST:g}")
    return result


def not_negative(field: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    """A number or array, broadcast to ``shape``, of entries >= 0.

    Raises:
        ConfigurationError: not numeric, another shape, or a negative entry.
    """
    result = spread(field, value, shape)
    if np.any(result < 0):
        raise refusal(field, value, ">= 0 everywhere")
    return result


def horizon(value: Any) -> int:
    """The steps of an episode, from 1 to 50,000.

    Raises:
        ConfigurationError: anything else.
    """
    return integer("horizon", value, at_least=1, at_most=LONGEST_HORIZON)


def runs(value: Any) -> int:
    """The runs of a vector environment, from 1 to a million.

    Raises:
        ConfigurationError: anything else.
    """
    return integer("num_envs", value, at_least=1, at_most=MOST_RUNS)


def one_or_each(value: ArrayLike) -> tuple[int, ...]:
    """The shape of a parameter that is one number for all sensors, (), or one for each, (l,)."""
    values = np.asarray(value)
    return values.shape if values.ndim == 1 else ()


def adaptive_thresholds(rho_bar: ArrayLike, rho_initial: ArrayLike, adaptation: ArrayLike) -> None:
    """0 <= ρ₀ <= ρ̄ <= 1 and λ > 0, each one number or one a sensor.

    Raises:
        ConfigurationError: anything else.

    Source: unknown_input, equations (5)-(7).
    """
    limit = not_negative("rho_bar", rho_bar, one_or_each(rho_bar))
    if np.any(limit > 1.0):
        raise refusal("rho_bar", rho_bar, ">= 0 and <= 1")
    initial = not_negative("rho_initial", rho_initial, one_or_each(rho_initial))
    if initial.ndim == limit.ndim == 1 and len(initial) != len(limit):
        raise refusal(
            "rho_initial", rho_initial, f"a number, or as many as rho_bar = {display(rho_bar)} has"
        )
    if np.any(initial > limit):
        raise refusal("rho_initial", rho_initial, f"<= rho_bar = {display(rho_bar)}")
    positive("adaptation", adaptation, one_or_each(adaptation))
