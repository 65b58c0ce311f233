"""Calls that must end with one line of error."""

from collections.abc import Callable
from typing import Any

import pytest

from fusion_gym.validation import ConfigurationError


def refused(call: Callable[..., Any], *parts: str, kind: Any = ConfigurationError) -> str:
    """The line of the error, which has these parts."""
    with pytest.raises(kind) as caught:
        call()
    message = str(caught.value)
    assert [part for part in parts if part not in message] == [], message
    assert "\n" not in message
    return message
