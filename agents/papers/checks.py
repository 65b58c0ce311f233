"""Checks of the parameters of figures."""

from collections.abc import Callable
from typing import Any

import numpy as np

from fusion_gym.validation import number, refusal


def numbers_within(**limits: float) -> Callable[[str, Any], tuple[float, ...]]:
    """Return a check for one number, or up to nine different ones, within limits."""

    def check(name: str, value: Any) -> tuple[float, ...]:
        entries = value if isinstance(value, list | tuple) else (value,)
        if not 1 <= len(entries) <= 9:
            raise refusal(name, value, "a number, or up to nine separated by commas")
        result = tuple(number(name, entry, **limits) for entry in entries)
        if len(set(result)) < len(result):
            raise refusal(name, value, "different numbers")
        return result

    return check


def number_or_none(**limits: float) -> Callable[[str, Any], float | None]:
    """Return a check for a number within limits, or None."""
    return lambda name, value: None if value is None else number(name, value, **limits)


def policy_of(rule: str = "NAME") -> Callable[[str, Any], str]:
    """Return a check for a policy with parameters, optionally of one rule."""

    def check(name: str, value: Any) -> str:
        if not isinstance(value, str) or rule not in ("NAME", value.partition(":")[0]):
            raise refusal(name, value, f"{rule!r}, or {rule + ':key=value,…'!r}")
        return value

    return check


def policy_list(name: str, value: Any) -> tuple[str, ...]:
    """Check one policy, or a list of them."""
    entries = (value,) if isinstance(value, str) else tuple(np.atleast_1d(value).tolist())
    if not all(isinstance(entry, str) for entry in entries):
        raise refusal(name, value, "a policy, or a list of them")
    return entries
