"""Files that a user names, and what they hold, or one line that says what is wrong."""

from typing import Any, TypeVar

import pydantic

from fusion_gym.errors import display
from fusion_gym.validation import ConfigurationError

Shape = TypeVar("Shape")


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
