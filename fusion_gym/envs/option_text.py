"""Options as text: name, type with its values, default, and meaning."""

from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np

from fusion_gym.core.task import CommonOptions
from fusion_gym.declaration import choices, hints, meanings, plain_options, type_text


class Option(NamedTuple):
    """An option with its type, default, meaning and, where they are few, its values."""

    type: str
    default: Any
    meaning: str = ""
    choices: tuple[str, ...] = ()


# Options of every environment in addition to its dataclass.
FOR_ALL = {
    "system": Option("str | None", None, "Path of a YAML file of options."),
    "max_episode_steps": Option(
        "int | None",
        None,
        "Steps until truncation; unlike ``horizon`` it does not scale reward and observation.",
    ),
}


def options_in(kind: type[CommonOptions]) -> dict[str, Option]:
    """Return every option by name: first the environment's own, then the common ones."""
    value, common = kind(), {field.name for field in fields(CommonOptions)}
    types, texts = hints(kind), meanings(kind)
    result = {}
    for field in sorted(fields(kind), key=lambda field: field.name in common):
        name, hint = field.name, types.get(field.name, field.type)
        text = hint if isinstance(hint, str) else type_text(hint)
        result[name] = Option(text, getattr(value, name), texts.get(name, ""), choices(hint))
    return result | {name: option for name, option in FOR_ALL.items() if name not in result}


def list_options(
    options: Mapping[str, Option], value: Mapping[str, Any] | None = None
) -> Iterator[str]:
    """Yield the lines of each option, with its entry of ``value`` if there is one."""
    for name, option in options.items():
        default = short(option.default)
        if value is not None and name in value:
            yield f"{name}: {option.type} = {short(value[name])}  (default: {default})"
        else:
            yield f"{name}: {option.type} = {default}"
        yield f"    {option.meaning}"


def short(value: Any) -> str:
    """Return a value as text, floats with four significant digits."""
    value = plain_options(value)
    if isinstance(value, list):
        return f"({', '.join(map(short, value))}{',' if len(value) == 1 else ''})"
    return f"{value:.4g}" if isinstance(value, float) and np.isfinite(value) else repr(value)
