"""Declarations of options: the type, default and docstring of a dataclass field (PEP 257)."""

import ast
import functools
import inspect
import itertools
import re
import textwrap
from collections.abc import Mapping
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from fusion_gym import validation

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
    if get_origin(hint) is Annotated:
        return tuple(hint.__metadata__[0])
    parts = [part for part in _parts(hint) if part is not NoneType]
    return get_args(parts[0]) if len(parts) == 1 and get_origin(parts[0]) is Literal else ()


def type_text(hint: Any) -> str:
    """Return a type as Python text, with all values of a ``Literal`` or a table."""
    if get_origin(hint) is Annotated:
        names = " | ".join(map(repr, choices(hint)))
        return " | ".join(names if part is str else type_text(part) for part in _parts(hint))
    if len(parts := _parts(hint)) > 1:
        return " | ".join(map(type_text, parts))
    if get_origin(hint) is Literal:
        return " | ".join(map(repr, get_args(hint)))
    text = "None" if hint is NoneType else inspect.formatannotation(hint)
    return re.sub(r"[\w.]+\.(?=\w)", "", text)


_hints_of = functools.cache(hints)  # cached, because every options object is checked


class Mark(functools.partial[Any]):
    """A check in the type of a field, ``Annotated[int, Mark(integer, at_least=1)]``.

    It takes the field's name and its value, or every entry of a tuple.
    """


def check(options: Any) -> None:
    """Check what is declared as ``Literal``, ``bool``, a name of a table, or with a mark."""
    for name, hint in _hints_of(options.__class__).items():
        value, parts = getattr(options, name), _parts(hint)
        marks = hint.__metadata__ if get_origin(hint) is Annotated else ({},)
        if value is None and NoneType in parts:
            continue
        for mark in marks:
            if isinstance(mark, Mark):
                for entry in value if isinstance(value, tuple) else (value,):
                    mark(name, entry)
        if not isinstance(marks[0], Mapping):
            continue
        if allowed := choices(hint):
            validation.choice(name, value, allowed)
        elif set(parts) <= {bool, NoneType}:
            validation.boolean(name, value)


def _parts(hint: Any) -> tuple[Any, ...]:
    """Return the members of a union, or the type as the only member."""
    inner = hint.__origin__ if get_origin(hint) is Annotated else hint
    return get_args(inner) if get_origin(inner) in (Union, UnionType) else (inner,)
