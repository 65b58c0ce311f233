"""Checks of user input; an error names the field, its value and the allowed values.

Every check returns the value in the library's form (float64 arrays, Python ints) or raises a
:class:`ConfigurationError`.
"""

import copy
import operator
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym.arrays import Array
from fusion_gym.errors import ConfigurationError, UnexpectedArgumentError, display, nearest, refusal

# Range of numbers whose squares and reciprocals float64 represents.
SMALLEST, LARGEST = 1e-15, 1e15
LONGEST = 100  # entries of an axis of any length; matrices are multiplied entry by entry
MOST_SENSORS = 1000  # the network loops over them
MOST_RUNS = 1_000_000  # each has a generator and a block of noise
MOST_STEPS = 1000  # period of a schedule
MOST_PERIOD = 10**9  # of a periodic policy
DEEPEST, MOST_ENTRIES = 32, 100_000  # of nested values
LONGEST_TEXT, LONGEST_YAML = 100_000_000, 1_000_000  # characters of a file
CONTROL = r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]"  # not allowed in names, paths and words
LONGEST_HORIZON = 50_000  # scales and tables need one computation per step


def _numbers(field: str, value: ArrayLike, allowed: str) -> Array:
    """Return the value as a float64 array, possibly with infinities and NaN."""
    try:
        values = np.asarray(value)
    except ValueError:
        raise refusal(field, value, allowed) from None
    if values.dtype.kind not in "iuf":
        raise refusal(field, value, allowed)
    with np.errstate(over="ignore"):  # for floats longer than float64
        result = np.array(values, dtype=np.float64)
    if np.any((np.abs(result) > LARGEST) & np.isfinite(result)):
        raise refusal(field, value, f"at most {LARGEST:g} in magnitude")
    return result


def array(
    field: str, value: ArrayLike, shape: tuple[int | None, ...], longest: int = LONGEST
) -> Array:
    """Return a finite float64 array of this shape; ``None`` is any length from 1 to ``longest``."""
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
    """Return a finite square matrix of float64."""
    size = len(array(field, value, (None, None)))
    return array(field, value, (size, size))


def spread(field: str, value: ArrayLike, shape: tuple[int, ...], *, infinity: int = 0) -> Array:
    """Return a finite array broadcast to ``shape``, or with infinities of the sign ``infinity``."""
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


def array_shape(value: Any) -> tuple[int, ...] | None:
    """Return the shape of a value, or ``None`` for lists of different lengths."""
    try:
        return np.shape(value)
    except ValueError:
        return None


def by_row(value: ArrayLike, shape: tuple[int, ...]) -> ArrayLike:
    """Return one number per row as an array that broadcasts to ``shape``, other values as given."""
    single = array_shape(value) == shape[:1]
    return np.reshape(value, (-1, *[1] * (len(shape) - 1))) if single else value


def number(
    field: str,
    value: Any,
    *,
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
) -> float:
    """Return a finite real number within the limits.

    Args:
        field: name of the field in the error.
        value: the value.
        above: exclusive lower limit; None for none.
        at_least: lower limit; None for none.
        at_most: upper limit; None for none.

    Raises:
        ConfigurationError: the value is no such number.

    Example:
        >>> from fusion_gym import validation
        >>> validation.number("threshold", 2, at_least=0.0)
        2.0
    """
    limits = (">", operator.gt, above), (">=", operator.ge, at_least), ("<=", operator.le, at_most)
    given = [(sign, within, limit) for sign, within, limit in limits if limit is not None]
    listed = " and ".join(f"{sign} {limit}" for sign, _, limit in given)
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
    if not (np.isfinite(result) and all(within(result, limit) for _, within, limit in given)):
        raise refusal(field, value, allowed)
    return result


def integer(field: str, value: Any, *, at_least: int, at_most: int | None = None) -> int:
    """Return a whole number within the limits; ``True``, 2.0 and "2" are not allowed."""
    allowed = f"a whole number >= {at_least}" + ("" if at_most is None else f" and <= {at_most}")
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not whole or value < at_least or (at_most is not None and value > at_most):
        raise refusal(field, value, allowed)
    return int(value)


def nested(field: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield a value and all entries of its nested lists and mappings, each with its key."""
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
    """Check that options are not too deep or large, and can be copied."""
    for name, entry in value.items():
        for _ in nested(name, entry):
            pass
        try:
            copy.deepcopy(entry)
        except Exception:
            raise refusal(name, entry, "a value that can be copied") from None


def read_text(field: str, path: Path, name: str | None = None) -> str:
    """Return the UTF-8 text of a file; ``name`` replaces the path in an error message."""
    label = str(path) if name is None else name
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(LONGEST_TEXT + 1)
        if len(text) > LONGEST_TEXT:
            raise ValueError(f"it has more than {LONGEST_TEXT:,} characters")
        return text
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{field} = {label!r} is not UTF-8 text: {error}") from None
    except (OSError, ValueError) as error:  # an invalid path raises a ValueError
        reason = getattr(error, "strerror", None) or error
        raise ConfigurationError(f"{field} = {label!r} cannot be read: {reason}") from None


def entries(
    field: str, value: Any, kind: str, owner: str = "sensor", count: int | None = None
) -> list[Any]:
    """Return the entry of each sensor, or of each step, up to ``LONGEST_HORIZON``."""
    listed = isinstance(value, (list, tuple)) or (isinstance(value, np.ndarray) and value.ndim > 0)
    if not listed or len(value) not in ([count] if count else range(1, LONGEST_HORIZON + 1)):
        many = f"each {owner}" if count is None else f"each of the {count} {owner}s"
        raise refusal(field, value, f"a list with {kind} for {many}")
    return list(value)


def boolean(field: str, value: Any) -> bool:
    """Return ``True`` or ``False``."""
    if not isinstance(value, (bool, np.bool_)):
        raise refusal(field, value, "True or False")
    return bool(value)


def choice(field: str, value: Any, options: Iterable[str]) -> str:
    """Return a value that is one of ``options``; an error suggests the nearest option."""
    names = list(options)
    if isinstance(value, str) and value in names:
        return value
    near = nearest(value, names) if isinstance(value, str) else None
    hint = f" (did you mean {near!r}?)" if near else ""
    raise refusal(field, value, "one of " + ", ".join(map(repr, names)) + hint)


def keys(kind: str, value: Iterable[str], known: Iterable[str]) -> None:
    """Check that every key is known; an error suggests the nearest known key."""
    names = sorted(known)
    for key in value:
        if key not in names:
            raise ConfigurationError(f"unknown {kind} {display(key)}: {_known(key, names)}")


def reset_options(value: Any, known: Iterable[str]) -> None:
    """Check that the options of a reset are ``None`` or a mapping with known keys."""
    if value is not None and not isinstance(value, Mapping):
        raise refusal("options", value, "a dictionary of reset options, or None")
    keys("reset option", value or {}, known)


def arguments(owner: str, value: Iterable[str], known: Iterable[str]) -> None:
    """Raise an ``UnexpectedArgumentError`` if ``owner`` does not take a keyword argument."""
    names = sorted(known)
    for key in value:
        if key not in names:
            raise UnexpectedArgumentError.for_argument(
                owner, key, f"unknown option {key!r}: {_known(key, names)}"
            )


def _known(key: Any, names: list[str]) -> str:
    near = nearest(key, names)
    hint = f"did you mean {near!r}? " if near else ""
    return f"{hint}known are {', '.join(names) or 'none'}"


def covariance(field: str, value: ArrayLike, size: int, *, definite: bool = False) -> Array:
    """Return a symmetric positive (semi-)definite matrix of shape (size, size)."""
    matrix = array(field, value, (size, size))
    if not np.allclose(matrix, matrix.T, rtol=1e-10, atol=1e-14):
        raise refusal(field, matrix, "symmetric")
    smallest = float(np.linalg.eigvalsh(matrix)[0])
    scale = float(np.abs(matrix).max())
    if definite and smallest <= max(1e-14 * scale, SMALLEST**2):
        allowed = f"positive definite (its smallest eigenvalue is {smallest:.3g})"
        raise refusal(field, matrix, allowed)
    if smallest < -1e-12 * scale or (np.diagonal(matrix) < 0.0).any():
        allowed = f"positive semi-definite (its smallest eigenvalue is {smallest:.3g})"
        raise refusal(field, matrix, allowed)
    return (matrix + matrix.T) / 2


def positive(
    field: str, value: ArrayLike, shape: tuple[int, ...], least: float = SMALLEST
) -> Array:
    """Return an array broadcast to ``shape`` with entries > 0, at least ``least``."""
    result = spread(field, value, shape)
    if np.any(result <= 0):
        raise refusal(field, value, "> 0 everywhere")
    if np.any(result < least):
        raise refusal(field, value, f"> 0 everywhere, at least {least:g}")
    return result


def not_negative(field: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return an array broadcast to ``shape`` with entries >= 0."""
    result = spread(field, value, shape)
    if np.any(result < 0):
        raise refusal(field, value, ">= 0 everywhere")
    return result


def horizon(value: Any) -> int:
    """Return the steps of an episode, from 1 to 50,000."""
    return integer("horizon", value, at_least=1, at_most=LONGEST_HORIZON)


def runs(value: Any) -> int:
    """Return the number of runs of a vector environment, from 1 to a million."""
    return integer("num_envs", value, at_least=1, at_most=MOST_RUNS)


def parameter_shape(value: ArrayLike) -> tuple[int, ...]:
    """Return the shape of a parameter: () for one number, (l,) for one per sensor."""
    values = np.asarray(value)
    return values.shape if values.ndim == 1 else ()


def adaptive_thresholds(rho_bar: ArrayLike, rho_initial: ArrayLike, adaptation: ArrayLike) -> None:
    """Check 0 <= ρ₀ <= ρ̄ <= 1 and λ > 0 of unknown_input, equations (5)-(7).

    Args:
        rho_bar: ρ̄, one number or one per sensor.
        rho_initial: ρ₀, one number or one per sensor.
        adaptation: λ, one number or one per sensor.

    Raises:
        ConfigurationError: A number is outside its limits.
    """
    limit = not_negative("rho_bar", rho_bar, parameter_shape(rho_bar))
    if np.any(limit > 1.0):
        raise refusal("rho_bar", rho_bar, ">= 0 and <= 1")
    initial = not_negative("rho_initial", rho_initial, parameter_shape(rho_initial))
    if initial.ndim == limit.ndim == 1 and len(initial) != len(limit):
        allowed = f"a number, or as many as rho_bar = {display(rho_bar)} has"
        raise refusal("rho_initial", rho_initial, allowed)
    if np.any(initial > limit):
        raise refusal("rho_initial", rho_initial, f"<= rho_bar = {display(rho_bar)}")
    positive("adaptation", adaptation, parameter_shape(adaptation))
