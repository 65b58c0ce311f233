"""Folders of results: a lock for one process, and a check of the inputs of a result."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from fusion_gym.entries import Plain
from fusion_gym.output.files import remove_partials
from fusion_gym.validation import ConfigurationError


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
        if now.get(key, _ABSENT) != then.get(key, _ABSENT):
            raise ConfigurationError(
                f"{key} = {now.get(key, _ABSENT)!r} differs from {label}, which has "
                f"{then.get(key, _ABSENT)!r}"
            )


class _Absent:
    def __repr__(self) -> str:
        return "nothing"


_ABSENT = _Absent()


def _flat(values: Mapping[str, Any], above: str = "") -> Plain:
    """Return nested values by their dotted names."""
    result: Plain = {}
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            result |= _flat(value, f"{above}{key}.")
        else:
            result[f"{above}{key}"] = value
    return result
