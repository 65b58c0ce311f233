"""What an option may be: marks in the types of a command's fields, checked before anything runs.

    episodes: Annotated[int, Whole(at_least=1)] = 1000
    json: Annotated[Path | None, OutputFile(".json")] = None

``None`` stands for an option that is not given; of a list every entry is checked.
"""

import errno
import os
import tempfile
import typing
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

from fusion_gym.validation import integer, number, refusal


class Mark(ABC):
    """What is allowed of an option."""

    @abstractmethod
    def check(self, option: str, value: Any) -> None:
        """Look at one value.

        Raises:
            ConfigurationError: it is not allowed.
        """


@dataclass(frozen=True)
class Whole(Mark):
    """A whole number within limits."""

    at_least: int
    at_most: int | None = None

    def check(self, option: str, value: Any) -> None:
        """Look at one number."""
        integer(option, value, at_least=self.at_least, at_most=self.at_most)


@dataclass(frozen=True)
class Between(Mark):
    """A finite number above one limit, and at most the other."""

    above: float
    at_most: float

    def check(self, option: str, value: Any) -> None:
        """Look at one number."""
        number(option, value, above=self.above, at_most=self.at_most)


class OutputFolder(Mark):
    """A folder that can be written, or made."""

    def check(self, option: str, value: Any) -> None:
        """Try it out, and leave nothing behind."""
        writable_folder(option, Path(value))


class OutputFile(Mark):
    """A file that can be replaced, or made; its ending says that it holds what is written."""

    def __init__(self, *endings: str) -> None:
        self.endings = endings

    def check(self, option: str, value: Any) -> None:
        """Look at its ending, unless it is a device; try its folder out, and leave nothing."""
        path = Path(value)
        device = os.path.exists(path) and not os.path.isfile(path)  # false where it cannot be seen
        if path.suffix.lower() not in self.endings and not device:
            raise refusal(option, str(path), f"a file that ends with {' or '.join(self.endings)}")
        writable_file(option, path)


# Beyond these numbers nothing ends, or finds room.
Episodes = Annotated[int, Whole(1, 100_000_000)]
Steps = Annotated[int | None, Whole(1, 10**12)]
Seed = Annotated[int, Whole(0)]
_TRAINING = Whole(0, 2**32 - 1)  # as torch and numpy take it
TrainingSeed = Annotated[int | None, _TRAINING]


def check_options(values: Any) -> None:
    """Check every field of a command by its marks.

    Raises:
        ConfigurationError: the first that is not allowed.
    """
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
            raise refusal(option, str(path), f"another file than that of {name}")


def writable_folder(option: str, folder: Path) -> None:
    """Try whether files can be written into a folder, which need not be there yet.

    Nothing is left behind, neither the folder nor a file.

    Raises:
        ConfigurationError: they cannot.
    """
    _try_out(option, folder, "a folder that can be written", lambda: _write_in(folder))


def writable_file(option: str, file: Path) -> None:
    """Try whether a file can be replaced, or made; neither it nor its folder need be there yet.

    Nothing is left behind, and what the file holds is kept.

    Raises:
        ConfigurationError: it cannot.
    """

    def write() -> None:
        if file.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if file.is_symlink() and not file.exists():
            raise FileNotFoundError(errno.ENOENT, f"a link to {os.readlink(file)}, which is absent")
        if file.is_file() or not file.exists():  # nothing can be tried of a pipe or a terminal
            _write_in(file.resolve().parent)

    _try_out(option, file, "a file that can be written", write)


def _try_out(option: str, path: Path, allowed: str, write: Callable[[], object]) -> None:
    try:
        write()
    except (OSError, ValueError) as error:  # a ValueError of a path that no system knows
        reason = getattr(error, "strerror", None) or str(error)
        raise refusal(option, str(path), f"{allowed} ({reason})") from None


def _write_in(folder: Path) -> None:
    """Write a file without a name into the folder, or into the nearest one above that is there."""
    while not folder.is_symlink() and not folder.exists() and folder != folder.parent:
        folder = folder.parent
    with tempfile.TemporaryFile(dir=folder, buffering=0) as file:
        file.write(b"\n")
