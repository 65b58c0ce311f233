"""Marks in the types of a command's fields: the allowed values of its options.

    episodes: Annotated[int, Whole(at_least=1)] = 1000
    json: Annotated[Path | None, OutputFile(".json")] = None

The marks are checked before the command runs. ``None`` is an option without a value; in a list
every entry is checked.
"""

import errno
import os
import tempfile
import typing
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

from fusion_gym.validation import integer, number, refusal


@dataclass(frozen=True)
class Whole:
    """A whole number within limits."""

    at_least: int
    at_most: int | None = None

    def check(self, option: str, value: Any) -> None:
        """Check one number."""
        integer(option, value, at_least=self.at_least, at_most=self.at_most)


@dataclass(frozen=True)
class Between:
    """A finite number above one limit, and at most the other."""

    above: float
    at_most: float

    def check(self, option: str, value: Any) -> None:
        """Check one number."""
        number(option, value, above=self.above, at_most=self.at_most)


class OutputFolder:
    """A folder that can be written or created."""

    def check(self, option: str, value: Any) -> None:
        """Check that the folder can be written, without a trace."""
        writable_folder(option, Path(value))


class OutputFile:
    """A file with one of the given endings, which can be replaced or created."""

    def __init__(self, *endings: str) -> None:
        self.endings = endings

    def check(self, option: str, value: Any) -> None:
        """Check the ending of a path, unless it is a device, and that its folder can be written."""
        path = Path(value)
        device = os.path.exists(path) and not os.path.isfile(path)  # false without access
        if path.suffix.lower() not in self.endings and not device:
            raise refusal(option, str(path), f"a file that ends with {' or '.join(self.endings)}")
        writable_file(option, path)


Mark = Whole | Between | OutputFolder | OutputFile

# Larger numbers would exceed any time or memory.
Episodes = Annotated[int, Whole(1, 100_000_000)]
Steps = Annotated[int | None, Whole(1, 10**12)]
Seed = Annotated[int, Whole(0)]
TrainingSeed = Annotated[int | None, Whole(0, 2**32 - 1)]  # the limits of torch and numpy


def check_options(values: Any) -> None:
    """Check every field of a command by its marks."""
    hints = typing.get_type_hints(type(values), include_extras=True)
    for field in fields(values):
        value = getattr(values, field.name)
        for mark in getattr(hints[field.name], "__metadata__", ()):
            if isinstance(mark, Mark) and value is not None:
                for entry in value if isinstance(value, tuple) else (value,):
                    mark.check(field.name, entry)
            if isinstance(mark, OutputFile) and value is not None:
                _refuse_input(values, field.name, value)


def _refuse_input(values: Any, option: str, path: Path) -> None:
    """Refuse to replace a file that another option names."""
    for name in {field.name for field in fields(values)} - {option}:
        other = getattr(values, name)
        named = isinstance(other, str | Path) and os.path.exists(other) and os.path.exists(path)
        if named and path.samefile(other):
            raise refusal(option, str(path), f"another file than {name}")


def writable_folder(option: str, folder: Path) -> None:
    """Check, without a trace, that files can be written into a folder, which need not exist."""
    _try_out(option, folder, "a folder that can be written", lambda: _write_in(folder))


def writable_file(option: str, file: Path) -> None:
    """Check, without a trace, that a file can be replaced or created."""

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
