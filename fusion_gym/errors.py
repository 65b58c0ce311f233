"""Errors in what a user hands in: one line with the field, its value and what is allowed."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

_SHOWN = 160  # characters of a value in a message


class ConfigurationError(ValueError):
    """A setting that cannot be used; the message names the field, its value and what is allowed.

    The message is one line, whatever values it shows.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(line.strip() for line in message.splitlines()))


class UnexpectedArgumentError(ConfigurationError, TypeError):
    """An argument that is not known: a ``TypeError`` too, as of any call with such an argument.

    Whoever tries out which options there are takes that for an answer: Stable-Baselines3 with
    ``render_mode``, TorchRL with ``frameskip``.
    """

    @classmethod
    def of(cls, owner: str, name: str, reason: str) -> UnexpectedArgumentError:
        """The argument ``name`` of ``owner``, in the words that Python has for it."""
        return cls(f"{owner} got an unexpected keyword argument {name!r}: {reason}")


class DivergenceError(FloatingPointError):
    """A number of a run that is not finite; the message names run, step and quantity."""


def refusal(field: str, value: Any, allowed: str, where: str = "") -> ConfigurationError:
    """The error of a field whose value is not what is allowed; ``where``, if not everywhere."""
    refused = f"{field} = {display(value)} is not allowed {where}".rstrip()
    return ConfigurationError(f"{refused}: it must be {allowed}")


def display(value: Any) -> str:
    """A value as Python writes it, arrays as lists, on one line, and cut where it is long."""
    try:
        text = " ".join(repr(_plain(value, itertools.count())).split())
    except Exception:  # whatever a class of the user's raises
        text = f"<{type(value).__name__}>"
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"


def _plain(value: Any, shown: Iterator[int]) -> Any:
    """Arrays as lists, also those within lists; of long ones as much as is ``shown``."""
    if next(shown) > _SHOWN:
        return ...
    if isinstance(value, np.ndarray):
        return (value[:_SHOWN] if value.ndim else value).tolist()
    if type(value) in (list, tuple):
        return type(value)(_plain(entry, shown) for entry in value[:_SHOWN])
    if type(value) is dict:
        entries = itertools.islice(value.items(), _SHOWN)
        return {key: _plain(entry, shown) for key, entry in entries}
    return value


def nearest(value: Any, known: Iterable[str]) -> str | None:
    """The known name that was probably meant."""
    return next(iter(difflib.get_close_matches(str(value), list(known), n=1)), None)
