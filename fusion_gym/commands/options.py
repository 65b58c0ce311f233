"""Marks in the types of a command's fields: the allowed values of its options.

    episodes: Annotated[int, whole(1)] = 1000
    json: Annotated[Path | None, OutputFile(".json")] = None

The marks are checked before the command runs. ``None`` is an option without a value; in a list
every entry is checked.
"""

import errno
import os
import tempfile
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Self

from fusion_gym import declaration
from fusion_gym.declaration import Mark
from fusion_gym.validation import integer, number, refusal


def whole(at_least: int, at_most: int | None = None) -> Mark:
    """Return the mark of a whole number within limits."""
    return Mark(integer, at_least=at_least, at_most=at_most)


def between(above: float, at_most: float) -> Mark:
    """Return the mark of a finite number above one limit, and at most the other."""
    return Mark(number, above=above, at_most=at_most)


class OutputFile(Mark):
    """The mark of a file with one of the given endings, which can be replaced or created."""

    def __new__(cls, *endings: str) -> Self:
        """Return a check of the ending, unless it is a device, and that its folder is writable."""
        return super().__new__(cls, writable_file, endings=endings)


# Larger numbers would exceed any time or memory.
Episodes = Annotated[int, whole(1, 100_000_000)]
Steps = Annotated[int | None, whole(1, 10**12)]
Seed = Annotated[int, whole(0)]
TrainingSeed = Annotated[int | None, whole(0, 2**32 - 1)]  # the limits of torch and numpy


def check_options(values: Any) -> None:
    """Check every field of a command by its type, and that no output replaces an input."""
    declaration.check(values)
    for name, hint in declaration.hints(type(values)).items():
        marks = getattr(hint, "__metadata__", ())
        if any(isinstance(mark, OutputFile) for mark in marks):
            _refuse_input(values, name, getattr(values, name))


def _refuse_input(values: Any, option: str, path: Path | None) -> None:
    """Refuse to replace a file that another option names."""
    for name in {field.name for field in fields(values)} - {option}:
        other = getattr(values, name)
        named = isinstance(other, str | Path) and os.path.exists(other)
        if named and path is not None and os.path.exists(path) and path.samefile(other):
            raise refusal(option, str(path), f"another file than {name}")


def writable_folder(option: str, path: str | Path) -> None:
    """Check, without a trace, that files can be written into a folder, which need not exist."""
    folder = Path(path)
    _try_out(option, folder, "a folder that can be written", lambda: _write_in(folder))


OUTPUT_FOLDER = Mark(writable_folder)


def writable_file(option: str, file: Path, endings: tuple[str, ...]) -> None:
    """Check, without a trace, that a file of these endings can be replaced or created."""
    device = os.path.exists(file) and not os.path.isfile(file)  # false without access
    if file.suffix.lower() not in endings and not device:
        raise refusal(option, str(file), f"a file that ends with {' or '.join(endings)}")

    def write() -> None:
        if file.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if file.is_symlink() and not file.exists():
            raise FileNotFoundError(errno.ENOENT, f"a link to {os.readlink(file)}, which is absent")
        if file.is_file() or not file.exists():  # a pipe or a terminal cannot be tested
            _write_in(file.resolve().parent)

    _try_out(option, file, "a file that can be written", write)


def _try_out(option: str, path: Path, allowed: str, write: Callable[[], object]) -> None:
    try:
        write()
    except (OSError, ValueError) as error:  # a ValueError for an invalid path
        reason = getattr(error, "strerror", None) or str(error)
        raise refusal(option, str(path), f"{allowed} ({reason})") from None


def _write_in(folder: Path) -> None:
    """Write a nameless file into the folder, or into its nearest existing parent."""
    while not folder.is_symlink() and not folder.exists() and folder != folder.parent:
        folder = folder.parent
    with tempfile.TemporaryFile(dir=folder, buffering=0) as file:
        file.write(b"\n")
