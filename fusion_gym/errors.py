"""Errors in user input: one line with the field, its value and the allowed values."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

_SHOWN = 160  # characters of a value in a message


class ConfigurationError(ValueError):
    """Report a value that is not allowed, in one line with its field and the allowed values.

    Args:
        message: The message; line breaks become spaces.

    Example:
        >>> import fusion_gym
        >>> fusion_gym.make_task("fusion_gym/TobitOscillator-v1", horizon=0)
        Traceback (most recent call last):
            ...
        fusion_gym.errors.ConfigurationError: horizon = 0 is not allowed: it must be ...
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(line.strip() for line in message.splitlines()))


class UnexpectedArgumentError(ConfigurationError, TypeError):
    """An unknown argument, also a ``TypeError``, as Stable-Baselines3 and TorchRL expect it."""

    @classmethod
    def for_argument(cls, owner: str, name: str, reason: str) -> UnexpectedArgumentError:
        """Return the error for the argument ``name`` of ``owner``, in Python's own words."""
        return cls(f"{owner} got an unexpected keyword argument {name!r}: {reason}")


class DivergenceError(FloatingPointError):
    """A number of a run that is not finite; the message names run, step and quantity."""


def forbidden(field: str, value: Any, reason: str, where: str = "") -> ConfigurationError:
    """Return the error of a field whose value is not allowed, in general or only ``where``."""
    refused = f"{field} = {display(value)} is not allowed {where}".rstrip()
    return ConfigurationError(f"{refused}: {reason}")


def refusal(field: str, value: Any, allowed: str, where: str = "") -> ConfigurationError:
    """Return the error of a field that must be something else."""
    return forbidden(field, value, f"it must be {allowed}", where)


def display(value: Any) -> str:
    """Return a value's ``repr`` in one line, with arrays as lists, cut at ``_SHOWN`` characters."""
    try:
        text = " ".join(repr(_plain(value, itertools.count())).split())
    except Exception:  # a user's class may raise any exception
        text = f"<{type(value).__name__}>"
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"


def _plain(value: Any, counter: Iterator[int]) -> Any:
    """Return a value with arrays as lists, cut after ``_SHOWN`` entries."""
    if next(counter) > _SHOWN:
        return ...
    if isinstance(value, np.ndarray):
        return (value[:_SHOWN] if value.ndim else value).tolist()
    if type(value) in (list, tuple):
        return type(value)(_plain(entry, counter) for entry in value[:_SHOWN])
    if type(value) is dict:
        entries = itertools.islice(value.items(), _SHOWN)
        return {key: _plain(entry, counter) for key, entry in entries}
    return value


def nearest(value: Any, known: Iterable[str]) -> str | None:
    """Return the closest known name, or ``None``."""
    return next(iter(difflib.get_close_matches(str(value), list(known), n=1)), None)
