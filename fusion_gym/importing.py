"""What a user names as ``module:name``: imported, or one error that says what is wrong.

A file may name code where the user trusts it: with ``--trust``, or in :func:`trust_files`.
"""

import contextlib
import importlib
import importlib.util
import re
from collections.abc import Iterator
from contextvars import ContextVar
from types import ModuleType
from typing import Any

from fusion_gym.validation import ConfigurationError, nested

TRUST: ContextVar[bool] = ContextVar("trust", default=False)
_ENVIRONMENTS = ("env", "environment", "id", "error")  # whose texts name code by any colon
_POLICY = re.compile(r"(?:^|base=)\s*(?!(?:model|zoo):)[^\W\d][\w.]*:\s*[^\W\d]\w*\s*(?::|$)")


@contextlib.contextmanager
def trust_files(trust: bool = True) -> Iterator[None]:
    """Allow files to name code of the user's, as ``--trust`` does, while this is entered."""
    token = TRUST.set(trust or TRUST.get())
    try:
        yield
    finally:
        TRUST.reset(token)


def refuse_code(content: Any, source: str) -> None:
    """Refuse a file's content that names code to import, unless files are trusted.

    Raises:
        ConfigurationError: an ``error``, an environment or a policy of the form ``module:name``.
    """
    for key, part in () if TRUST.get() else nested("file", content):
        text = part if isinstance(part, str) else ""
        if ":" in (key + text if key in _ENVIRONMENTS else key) or _POLICY.search(text):
            why = "it names code that would run; if you trust the file, add --trust"
            python = "(in Python: fusion_gym.importing.trust_files)"
            raise ConfigurationError(f"{source}: {key} = {part!r} is not allowed: {why} {python}")


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


def require(user: str, extra: str, *packages: str) -> None:
    """Check that packages of an extra are installed.

    Raises:
        ConfigurationError: one is absent; names what needs it.
    """
    for package in packages:
        if importlib.util.find_spec(package) is None:
            absent = f"{user} needs {package}, which is absent"
            raise ConfigurationError(f"{absent}: pip install 'fusion-gym[{extra}]'")


def name_of(value: Any) -> str:
    """What :func:`import_named` would take for a function, as far as it has a name."""
    owner, name = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
    return f"{owner}:{name}" if owner and name else repr(value)
