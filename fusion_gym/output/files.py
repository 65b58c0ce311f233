"""Atomic writes of files, and folders of results with a lock and a check of their inputs."""

import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from fusion_gym.entries import Plain
from fusion_gym.validation import ConfigurationError, read_text

_PARTIAL = re.compile(r"\.\d+\.part(\.\w+)?$")  # with the id of the writing process


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a partial file, which replaces ``path`` at the end of the block.

    A reader of ``path`` finds the old file or the complete new file, even if the process is killed.
    If the block fails, the partial file is removed. Missing folders are created. The name of the
    partial file contains the process id, so two processes never share it. For a link its target is
    replaced; a path that is no plain file (``/dev/stdout``) is written directly.

    Args:
        path: the file to replace.

    Raises:
        OSError: the folder or the file cannot be written.
    """
    path = path.resolve()
    if path.exists() and not path.is_file() and not path.is_dir():
        yield path
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        yield partial
        partial.replace(path)
    except OSError as error:  # the error of a full disk names no file
        error.filename = str(path)
        raise
    finally:
        partial.unlink(missing_ok=True)


def remove_partials(folder: Path) -> None:
    """Remove the partial files of killed processes; no other process may write in the folder."""
    for partial in (*folder.glob("*"), *folder.glob("*/*.part.[cjn]*")):
        if _PARTIAL.search(partial.name):
            partial.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Replace a text file atomically."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write(path: Path | None, report: Mapping[str, Any]) -> None:
    """Replace a JSON file atomically; do nothing without a path."""
    if path is not None:
        write_text(path, json.dumps(report, indent=1) + "\n")


def read_json(path: Path, name: str) -> Plain:
    """Return the object in a JSON file; ``name`` is the file's name in error messages."""
    text = read_text(name, path)
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(f"{name} = {str(path)!r} holds no JSON: {error}") from None
    if not isinstance(content, dict):
        raise ConfigurationError(f"{name} = {str(path)!r} holds no JSON object")
    return content


@contextmanager
def lock_folder(folder: Path, name: str) -> Iterator[None]:
    """Lock a folder for this process, create it if needed, and remove old partial files."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / ".lock")
        lock.acquire(timeout=0)
    except Timeout:
        raise ConfigurationError(
            f"{name} = {str(folder)!r} is in use by another process: wait for its end, or give "
            f"another --{name}"
        ) from None
    except OSError as error:
        raise ConfigurationError(
            f"{name} = {str(folder)!r} cannot be written: {error.strerror or error}"
        ) from None
    try:
        remove_partials(folder)
        yield
    finally:
        lock.release()


def folder_refusal(folder: Path, results: str) -> ConfigurationError:
    """Return the error of a folder with earlier results."""
    return ConfigurationError(
        f"output = {str(folder)!r} already holds {results}: continue with --resume, or give "
        "another --output"
    )


def fingerprint(inputs: Mapping[str, Any]) -> str:
    """Return a hash of plain inputs, the same in every process."""
    plain = json.dumps(inputs, sort_keys=True, default=list)
    return hashlib.sha256(plain.encode()).hexdigest()[:16]


def check_inputs(arguments: Mapping[str, Any], earlier: Any, label: str) -> None:
    """Check that an earlier result has the same inputs; an error names the first difference."""
    now = _flat(json.loads(json.dumps(arguments, default=list)))
    then = _flat(earlier) if isinstance(earlier, Mapping) else {}
    if not then:
        raise ConfigurationError(f"{label} has no record of its inputs")
    for key in dict.fromkeys([*now, *then]):
        if key not in now or key not in then or now[key] != then[key]:
            ours, earlier = (repr(part[key]) if key in part else "nothing" for part in (now, then))
            raise ConfigurationError(f"{key} = {ours} differs from {label}, which has {earlier}")


def _flat(values: Mapping[str, Any], above: str = "") -> Plain:
    """Return nested values by their dotted names."""
    result: Plain = {}
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            result |= _flat(value, f"{above}{key}.")
        else:
            result[f"{above}{key}"] = value
    return result
