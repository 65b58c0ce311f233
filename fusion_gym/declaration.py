"""Declarations of options: the type, default and docstring of a dataclass field (PEP 257)."""

import ast
import functools
import inspect
import itertools
import re
import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from fusion_gym import validation
from fusion_gym.importing import name_of

# Types that are shown by name, because their definitions are long.
_NAMES = {name: type(name, (), {}) for name in ("ArrayLike", "Array")}


def hints(kind: type) -> dict[str, Any]:
    """Return the types of a dataclass's fields, or none if a name in them is unknown."""
    try:
        return get_type_hints(kind, localns=_NAMES, include_extras=True)
    except NameError:  # a class inside a function
        return {}


def meanings(kind: type) -> dict[str, str]:
    """Return the docstrings of a dataclass's fields, inherited ones included."""
    result = {}
    for owner in reversed(kind.__mro__):
        try:
            (source,) = ast.parse(textwrap.dedent(inspect.getsource(owner))).body
        except (OSError, TypeError, SyntaxError):  # a class without source
            continue
        for field, below in itertools.pairwise(getattr(source, "body", ())):
            match field, below:
                case (
                    ast.AnnAssign(target=ast.Name(id=name)),
                    ast.Expr(value=ast.Constant(value=str(text))),
                ):
                    result[name] = " ".join(text.split())
    return result


def choices(hint: Any) -> tuple[Any, ...]:
    """Return all values of a ``Literal`` or ``Annotated[str, table]`` type except ``None``."""
    for table in _tables(hint):
        return tuple(table)
    parts = [part for part in _parts(hint) if part is not NoneType]
    return get_args(parts[0]) if len(parts) == 1 and get_origin(parts[0]) is Literal else ()


def type_text(hint: Any) -> str:
    """Return a type as Python text, with all values of a ``Literal`` or a table."""
    if _tables(hint):
        names = " | ".join(map(repr, choices(hint)))
        return " | ".join(names if part is str else type_text(part) for part in _parts(hint))
    if len(parts := _parts(hint)) > 1:
        return " | ".join(map(type_text, parts))
    (hint,) = parts
    if get_origin(hint) is Literal:
        return " | ".join(map(repr, get_args(hint)))
    text = "None" if hint is NoneType else inspect.formatannotation(hint)
    return re.sub(r"[\w.]+\.(?=\w)", "", text)


def plain_options(value: Any) -> Any:
    """Return settings as plain lists, numbers and strings, ready for JSON."""
    if isinstance(value, dict):
        return {key: plain_options(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_options(entry) for entry in value]
    if callable(value):
        return name_of(value)
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value


@dataclass(frozen=True)
class OptionGroup:
    """A base of options, which are checked by their declarations."""

    def __post_init__(self) -> None:
        check(self)


MarkT = TypeVar("MarkT")
_hints_of = functools.cache(hints)  # cached, because every options object is checked


class Mark(functools.partial[Any]):
    """A check in the type of a field, ``Annotated[int, Mark(integer, at_least=1)]``.

    It takes the field's name and its value, or every entry of a tuple.
    """


class Scaling:
    """A mark of an option that affects the scale of the reward, besides plant and sensors."""


class NumpyOnly:
    """A mark of an option of which NumPy alone runs some values.

    Args:
        *values: These values; without any, all but the default.
    """

    def __init__(self, *values: Any) -> None:
        self.values = values


def marked(kind: type, mark: type[MarkT]) -> dict[str, MarkT]:
    """Return the marks of fields, from the first class that declares each: others set defaults."""
    result: dict[str, MarkT] = {}
    for owner in reversed(kind.__mro__):
        for name in inspect.get_annotations(owner):
            for entry in _metadata(_hints_of(owner).get(name)):
                if isinstance(entry, mark):
                    result.setdefault(name, entry)
    return result


def check(options: Any) -> None:
    """Check what is declared as ``Literal``, ``bool``, a name of a table, or with a mark."""
    for name, optional, checks in _checks(options.__class__):
        value = getattr(options, name)
        for own in () if value is None and optional else checks:
            several = isinstance(own, Mark) and isinstance(value, tuple)
            for entry in value if several else (value,):
                own(name, entry)


@functools.cache
def _checks(kind: type) -> list[tuple[str, bool, list[Any]]]:
    """Return the fields with checks, whether each may be ``None``, and the checks."""
    result, first = [], marked(kind, Mark)
    for name, hint in _hints_of(kind).items():
        parts, tables = _parts(hint), _tables(hint)
        checks: list[Any] = [mark for mark in _metadata(hint) if isinstance(mark, Mark)]
        checks = checks or [mark for key, mark in first.items() if key == name]
        if not checks and all(isinstance(table, Mapping) for table in tables):
            if allowed := tables[0] if tables else choices(hint):
                checks = [functools.partial(validation.choice, options=allowed)]
            elif set(parts) <= {bool, NoneType}:
                checks = [validation.boolean]
        if checks:
            result.append((name, NoneType in parts, checks))
    return result


def _metadata(hint: Any) -> tuple[Any, ...]:
    return hint.__metadata__ if get_origin(hint) is Annotated else ()


def _tables(hint: Any) -> list[Any]:
    return [table for table in _metadata(hint) if isinstance(table, Iterable)]


def _parts(hint: Any) -> tuple[Any, ...]:
    """Return the members of a union, or the type as the only member."""
    inner = hint.__origin__ if get_origin(hint) is Annotated else hint
    return get_args(inner) if get_origin(inner) in (Union, UnionType) else (inner,)
