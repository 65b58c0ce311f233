"""What a user names as ``module:name``: imported, or one error that says what is wrong."""

import importlib
from types import ModuleType
from typing import Any

from fusion_gym.errors import ConfigurationError


def imported(field: str, text: str, module: str) -> ModuleType:
    """The module of this name, of what a user gave as ``text``.

    Raises:
        ConfigurationError: it cannot be imported.
    """
    try:
        return importlib.import_module(module)
    except Exception as error:  # whatever its own code raises
        reason = f"{type(error).__name__}: {error}"
        raise ConfigurationError(
            f"{field} = {text!r} is not allowed: the module {module!r} cannot be imported "
            f"({reason})"
        ) from error


def import_named(field: str, text: str) -> Any:
    """The object that ``module:name`` stands for.

    Raises:
        ConfigurationError: no such text, no such module, or the module has no such name.
    """
    module, _, name = text.partition(":")
    if not (name and all(part.isidentifier() for part in [*module.split("."), name])):
        raise ConfigurationError(f"{field} = {text!r} is not allowed: it must be 'module:name'")
    result = imported(field, text, module)
    if not hasattr(result, name):
        raise ConfigurationError(
            f"{field} = {text!r} is not allowed: the module {module!r} has no {name!r}"
        )
    return getattr(result, name)


def name_of(value: Any) -> str:
    """What :func:`import_named` would take for a function, as far as it has a name."""
    owner, name = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
    return f"{owner}:{name}" if owner and name else repr(value)
