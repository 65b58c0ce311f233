"""Options as text: what each is called, of which type it is, and what it is by default."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping
from dataclasses import Field, fields
from typing import Any, NamedTuple

import numpy as np

from fusion_gym.core.options import CommonOptions, plain


class Option(NamedTuple):
    """Type, as it is annotated, and default of an option."""

    type: str
    default: Any


# What every environment takes beside the fields of its options.
FOR_ALL = {"system": Option("str | None", None), "max_episode_steps": Option("int | None", None)}


def options_in(kind: type[CommonOptions]) -> dict[str, Option]:
    """Every option by its name: the environment's own, then those that all have."""
    chosen, common = kind(), {field.name for field in fields(CommonOptions)}
    ordered = sorted(fields(kind), key=lambda field: field.name in common)
    found = {field.name: Option(_type(field), getattr(chosen, field.name)) for field in ordered}
    return found | {name: option for name, option in FOR_ALL.items() if name not in found}


def listed(options: Mapping[str, Option], given: Mapping[str, Any] | None = None) -> Iterator[str]:
    """A line for each option; of one that is ``given`` what it is, and its default behind it."""
    for name, (kind, default) in options.items():
        if given is not None and name in given:
            yield f"{name}: {kind} = {short(given[name])}  (default: {short(default)})"
        else:
            yield f"{name}: {kind} = {short(default)}"


def short(value: Any) -> str:
    """A value as it would be written, its numbers with four digits."""
    value = plain(value)
    if isinstance(value, list):
        return f"({', '.join(map(short, value))}{',' if len(value) == 1 else ''})"
    return f"{value:.4g}" if isinstance(value, float) and np.isfinite(value) else repr(value)


def _type(field: Field[Any]) -> str:
    kind: Any = field.type
    return kind if isinstance(kind, str) else inspect.formatannotation(kind)
