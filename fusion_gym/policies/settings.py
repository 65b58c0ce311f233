"""Settings of a command line: ``key=value,key=value``."""

import ast
import contextlib
from collections.abc import Iterable
from typing import Any

from fusion_gym.entries import Arguments
from fusion_gym.validation import ConfigurationError


def parse_value(text: str) -> Any:
    """Return the number, keyword, list or ``0.1/0.2/0.3`` of a text, or else the text."""
    plain = {"true": True, "false": False, "none": None, "null": None}
    if text.strip().lower() in plain:
        return plain[text.strip().lower()]
    if "/" in text:
        parts = tuple(parse_value(part) for part in text.split("/"))
        if all(isinstance(part, (int, float)) for part in parts):
            return parts
    for read in (ast.literal_eval, float):
        # {[]: 1} raises a TypeError, too many brackets the last two.
        with contextlib.suppress(ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
            return read(text)
    return text


def parse_settings(kind: str, entries: Iterable[str]) -> Arguments:
    """Return ``["key=value", …]`` as a dictionary, with :func:`parse_value`."""
    result: Arguments = {}
    for entry in entries:
        key, equals, value = entry.partition("=")
        key = key.strip()
        if not equals or not key:
            raise ConfigurationError(f"{kind} {entry!r} is not allowed: write key=value")
        if key in result:
            raise ConfigurationError(f"{kind} {key!r} appears twice")
        result[key] = parse_value(value)
    return result
