"""Import of user code by ``module:name``, with one error that states the cause.

A file may name code only if the user trusts it: with ``--trust``, or in :func:`trust_files`.
"""

import contextlib
import importlib
import importlib.util
import re
from collections.abc import Iterator
from contextvars import ContextVar
from types import ModuleType
from typing import Any

from fusion_gym.errors import forbidden
from fusion_gym.validation import ConfigurationError, nested

TRUST: ContextVar[bool] = ContextVar("trust", default=False)
_ENVIRONMENTS = ("env", "env_id", "environment", "error", "id")  # their values name code with ":"
_POLICY = re.compile(r"(?:^|base=)\s*(?!(?:model|zoo):)[^\W\d][\w.]*:\s*[^\W\d]\w*\s*(?::|$)")


@contextlib.contextmanager
def trust_files(trust: bool = True) -> Iterator[None]:
    """Allow files to name code inside this context, as ``--trust`` does."""
    token = TRUST.set(trust or TRUST.get())
    try:
        yield
    finally:
        TRUST.reset(token)


def refuse_code(content: Any, source: str) -> None:
    """Raise a ``ConfigurationError`` if an untrusted file names code to import."""
    for key, part in () if TRUST.get() else nested("file", content):
        text = part if isinstance(part, str) else ""
        if ":" in (key + text if key in _ENVIRONMENTS else key) or _POLICY.search(text):
            why = "it names code that would run; if you trust the file, add --trust"
            python = "(in Python: fusion_gym.importing.trust_files)"
            raise ConfigurationError(f"{source}: {key} = {part!r} is not allowed: {why} {python}")


def imported(field: str, text: str, module: str) -> ModuleType:
    """Return the module, or raise a ``ConfigurationError`` with the user's ``text``."""
    try:
        return importlib.import_module(module)
    except Exception as error:  # a user's module may raise any exception
        reason = f"{type(error).__name__}: {error}"
        reason = f"the module {module!r} cannot be imported ({reason})"
        raise forbidden(field, text, reason) from error


def import_named(field: str, text: str) -> Any:
    """Return the object of ``module:name``, or raise a ``ConfigurationError``."""
    module, _, name = text.partition(":")
    if not (name and all(part.isidentifier() for part in [*module.split("."), name])):
        raise ConfigurationError(f"{field} = {text!r} is not allowed: it must be 'module:name'")
    result = imported(field, text, module)
    if not hasattr(result, name):
        raise forbidden(field, text, f"the module {module!r} has no {name!r}")
    return getattr(result, name)


def require(user: str, extra: str, *packages: str) -> None:
    """Check that the packages of an extra are installed."""
    for package in packages:
        if importlib.util.find_spec(package) is None:
            absent = f"{user} needs {package}, which is absent"
            raise ConfigurationError(f"{absent}: install fusion-gym with its extra {extra!r}")


def name_of(value: Any) -> str:
    """Return the ``module:name`` of a function, or else its ``repr``."""
    owner, name = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
    return f"{owner}:{name}" if owner and name else repr(value)
