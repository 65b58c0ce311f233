"""Store searched schedules in a file, by a hash of everything that determines them."""

import dataclasses
import hashlib
import json
import os
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.core.system import System
from fusion_gym.version import __version__

Patterns = NDArray[np.bool_]

_FORMAT = 2


class Schedule(NamedTuple):
    """Requests (period, sensors) bool from the start of an episode, and their mean ``trace``."""

    requests: Patterns
    trace: float


def schedule_key(system: System[Any], packets: int, period: int, steps: int | None) -> str:
    """Return a hash of the system's type, of its numbers and of the arguments of the search."""
    digest = hashlib.sha256()
    key_fields = (_FORMAT, __version__, packets, period, steps)
    digest.update(repr(key_fields).encode())
    _feed(digest, system)
    return digest.hexdigest()


def load_schedule(
    cache: str | None, key: str, packets: int, shape: tuple[int, int]
) -> Schedule | None:
    """Return the schedule of the file, if it has a plausible one."""
    if cache is None:
        return None
    entry = _read(Path(cache)).get(key)
    if not isinstance(entry, dict):
        return None
    try:
        requests = np.array(entry["requests"])
        trace = validation.number("trace", entry["trace"], above=0.0)
    except (TypeError, KeyError, ValueError):
        return None
    if requests.shape != shape or not np.isin(requests, (0, 1)).all() or requests.sum() != packets:
        return None
    return Schedule(requests.astype(np.bool_), trace)


def store_schedule(cache: str, key: str, schedule: Schedule) -> None:
    """Write the schedule into the file, which is replaced as a whole or not at all."""
    path = Path(cache)
    entry = {"requests": schedule.requests.astype(int).tolist(), "trace": schedule.trace}
    entries = _read(path)
    if entries.get(key) == entry:
        return
    text = json.dumps({"periodic_optimum": entries | {key: entry}}, indent=1) + "\n"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=path.name)
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(text)
            os.replace(name, path)
        finally:
            Path(name).unlink(missing_ok=True)
    except OSError as error:
        raise validation.refusal("cache", cache, f"a file that can be written ({error})") from None


def _feed(digest: Any, value: Any) -> None:
    if dataclasses.is_dataclass(value):
        digest.update(type(value).__qualname__.encode())
        for field in dataclasses.fields(value):
            digest.update(field.name.encode())
            _feed(digest, getattr(value, field.name))
    elif isinstance(value, np.ndarray):
        digest.update(f"{value.shape}{value.dtype}".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, (tuple, list)):
        digest.update(f"[{len(value)}".encode())
        for entry in value:
            _feed(digest, entry)
    else:
        digest.update(f"{type(value).__name__}={value!r};".encode())


def _read(path: Path) -> dict[str, Any]:
    """Return the entries of the file; none if it is missing, broken or of another kind."""
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))["periodic_optimum"]
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    return entries if isinstance(entries, dict) else {}
