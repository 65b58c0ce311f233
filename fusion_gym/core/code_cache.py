"""The folders of compiled code and values in the user's home, which nobody else may write."""

import contextlib
import dataclasses
import functools
import hashlib
import io
import os
import pickle
import platform
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy

_PACKAGE = Path(__file__).parent.parent
_SECONDS = 30 * 86_400.0  # after which unused code is removed


def folder_of(kind: str) -> Path | None:
    """Return ``~/.cache/fusion-gym/KIND``, or ``None`` with a warning if it cannot be trusted."""
    try:
        folder = Path.home() / ".cache" / "fusion-gym" / kind
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        reason = "" if _own(folder) else f"{folder} is not the user's alone"
    except (OSError, RuntimeError) as error:  # RuntimeError: no home
        reason = str(error)
    if reason:
        warnings.warn(
            f"compiled code is not stored, so each start compiles: {reason}", stacklevel=2
        )
        return None
    with contextlib.suppress(OSError):
        for file in folder.iterdir():
            if time.time() - max(file.stat().st_atime, file.stat().st_mtime) > _SECONDS:
                file.unlink()
    return folder


def read_code(folder: Path | None, key: str) -> bytes | None:
    """Return the whole content of a file of the user, or ``None``; it counts as used now."""
    with contextlib.suppress(OSError):
        if folder is not None and _own(file := folder / key):
            content = file.read_bytes()
            os.utime(file)
            if hashlib.sha256(content[32:]).digest() == content[:32]:
                return content[32:]
    return None


def write_code(folder: Path | None, key: str, content: bytes) -> None:
    """Store the content of a file, with its hash, where there is a folder."""
    with contextlib.suppress(OSError):
        if folder is not None:
            part = folder / f"{key}.{os.getpid()}"
            part.write_bytes(hashlib.sha256(content).digest() + content)
            part.chmod(0o600)
            part.replace(folder / key)


def _own(path: Path) -> bool:
    """Whether the user alone may write a file or folder."""
    status = path.stat()
    return not hasattr(os, "getuid") or (
        status.st_uid == os.getuid() and not status.st_mode & 0o022
    )


def stored(kind: str, parts: Any, compute: Callable[[], Any]) -> Any:
    """Return a value that parts determine, from the disk if it has been computed before.

    A value that code outside of this package determines is computed each time.
    """
    versions = np.__version__, scipy.__version__, platform.python_version(), platform.machine()
    name = key_of(parts, repr((kind, versions)))
    folder = _value_folder(kind) if name else None
    if content := read_code(folder, name or ""):
        return pickle.loads(content)
    value = compute()
    write_code(folder, name or "", pickle.dumps(value))
    return value


@functools.cache
def _value_folder(kind: str) -> Path | None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # without a folder, values are computed as before
        return folder_of(kind)


@functools.cache
def _sources() -> bytes:
    """Return what the code of a task depends on: the content of the package's files."""
    files = sorted(_PACKAGE.rglob("*.py"))
    return b"".join(hashlib.sha256(file.read_bytes()).digest() for file in files)


class _Parts(pickle.Pickler):
    """A pickler of dataclasses by their fields, without what they have cached."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file)
        self.fast = True  # independent of which objects are the same
        self.modules: set[str] = set()

    def reducer_override(self, part: Any) -> Any:
        """Note the module of a class or function, and reduce a dataclass to its fields."""
        self.modules.add(getattr(part, "__module__", None) or type(part).__module__)
        if isinstance(part, type) or not dataclasses.is_dataclass(part):
            return NotImplemented
        return type(part), tuple(getattr(part, own.name) for own in dataclasses.fields(part))


def key_of(parts: Any, surroundings: str) -> str | None:
    """Return a hash of parts, or ``None`` if code outside of this package determines them."""
    pickler = _Parts(file := io.BytesIO())
    try:
        pickler.dump(parts)
    except Exception:  # a part cannot be pickled
        return None
    if any(
        name.partition(".")[0]
        not in ("fusion_gym", "numpy", "builtins", "types", "functools", "copyreg", "collections")
        for name in pickler.modules
    ):
        return None
    return hashlib.sha256(surroundings.encode() + _sources() + file.getvalue()).hexdigest()
