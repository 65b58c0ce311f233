"""Files that a user names, and what they hold, or one line that says what is wrong."""

from pathlib import Path
from typing import Any, TypeVar

import pydantic

from fusion_gym.errors import display
from fusion_gym.validation import ConfigurationError

Shape = TypeVar("Shape")


def read_text(option: str, path: Path, name: str | None = None) -> str:
    """A file's text; ``name`` is what the user calls it, if that is not its path.

    Raises:
        ConfigurationError: it cannot be read, or is no text in UTF-8.
    """
    label = str(path) if name is None else name
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{option} = {label!r} is no text in UTF-8: {error}") from None
    except (OSError, ValueError) as error:  # a ValueError of a path that no system knows
        reason = getattr(error, "strerror", None) or error
        raise ConfigurationError(f"{option} = {label!r} cannot be read: {reason}") from None


def checked(shape: type[Shape], content: Any, source: str) -> Shape:
    """The content as what ``shape`` says.

    Raises:
        ConfigurationError: an unknown key, or a value that is not allowed; names ``source`` and the
            first such field.
    """
    try:
        return pydantic.TypeAdapter(shape).validate_python(content)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "the whole file"
        text = "" if first["type"] == "missing" else f" = {display(first['input'])}"
        raise ConfigurationError(
            f"{source}: {place}{text} is not allowed: {first['msg']}"
        ) from None
