"""The folders of compiled code in the user's home, which nobody else may write."""

import contextlib
import hashlib
import os
import time
import warnings
from pathlib import Path

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
