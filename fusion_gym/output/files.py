"""Files that are whole: each is written under another name and moved to its own at the end."""

import json
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fusion_gym.validation import ConfigurationError, read_text

# What reading a damaged archive raises; RuntimeError where a part says that it is encrypted.
DAMAGED = (
    *(OSError, EOFError, KeyError, TypeError, ValueError, RuntimeError),
    *(struct.error, zipfile.BadZipFile, zlib.error),
)
_PARTIAL = re.compile(r"\.\d+\.part(\.\w+)?$")  # with the process that writes it


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A file beside ``path`` to be written, which replaces ``path`` at the end of the block.

    Whoever reads ``path`` finds what was there before or all of what is new, whenever the process
    is killed; where the block fails, nothing is left of it. Folders are made. The partial file has
    the suffix of ``path``, and in its name the process, so that two never write the same one. A
    link's target is replaced, and what is no plain file (``/dev/stdout``) is written to directly.

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
    except OSError as error:  # that of a full disk names no file
        error.filename = str(path)
        raise
    finally:
        partial.unlink(missing_ok=True)


def remove_partials(folder: Path) -> None:
    """Remove what killed processes left half-written; nobody else may be writing there.

    In the folders within, too, but there only tables, JSON and episodes.
    """
    for partial in (*folder.glob("*"), *folder.glob("*/*.part.[cjn]*")):
        if _PARTIAL.search(partial.name):
            partial.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Replace a text file in one move."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write(path: Path | None, report: Mapping[str, Any]) -> None:
    """Replace a JSON file, if one is wanted, in one move."""
    if path is not None:
        write_text(path, json.dumps(report, indent=1) + "\n")


def read_json(path: Path, name: str) -> dict[str, Any]:
    """The object that a JSON file holds; ``name`` is what an error calls it.

    Raises:
        ConfigurationError: it cannot be read, or holds no JSON object; one line says which.
    """
    text = read_text(name, path)
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(f"{name} = {str(path)!r} holds no JSON: {error}") from None
    if not isinstance(content, dict):
        raise ConfigurationError(f"{name} = {str(path)!r} holds no JSON object")
    return content
