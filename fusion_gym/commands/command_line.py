"""The options of every command: declare, read and check them, report errors and end the command.

Marks in the types of a command's fields are the allowed values of its options:

    episodes: Annotated[int, whole(1)] = 1000
    json: Annotated[Path | None, OutputFile(".json")] = None

The marks are checked before the command runs. ``None`` is an option without a value; in a list
every entry is checked.
"""

import contextlib
import errno
import inspect
import io
import itertools
import os
import re
import shlex
import sys
import tempfile
import textwrap
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, TypeVar, get_args

import tyro

from fusion_gym import declaration
from fusion_gym.declaration import Mark
from fusion_gym.docstrings import plain_marks
from fusion_gym.entries import Options
from fusion_gym.importing import trust_files
from fusion_gym.output.ending import flush, report_errors
from fusion_gym.output.progress import quietly
from fusion_gym.policies.registry import parse_settings
from fusion_gym.validation import CONTROL, ConfigurationError, integer, number, refusal


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
    for name in declaration.marked(type(values), OutputFile):
        path = getattr(values, name)
        for option in {item.name for item in fields(values)} - {name}:
            other = getattr(values, option)
            named = isinstance(other, str | Path) and os.path.exists(other)
            if named and path is not None and os.path.exists(path) and path.samefile(other):
                raise refusal(name, str(path), f"another file than {option}")


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


Words = tuple[tuple[str, ...], ...]  # words of a repeatable option
SetOptions = Annotated[
    Words, tyro.conf.UseAppendAction, tyro.conf.arg(name="set", metavar="OPTION=VALUE …")
]
PolicyNames = Annotated[
    Words, tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME[:key=value,…] …")
]
_Kind = TypeVar("_Kind", bound="Command")


def program_of(kind: type["Command"]) -> str:
    """Return the words that run a command."""
    return kind.program or f"fusion-gym {kind.__name__.lower()}"


@dataclass(frozen=True)
class Command(ABC):
    """A command, whose fields are its options and whose docstring and field texts are its help."""

    program: ClassVar[str] = ""  # the words that run a command outside fusion-gym

    @classmethod
    def main(cls) -> None:
        """Read the command line, check the options and run the command.

        Raises:
            SystemExit: as :func:`report_errors`; status 130 after an interrupt.
        """
        command: Command | None = None
        if os.getcwd() not in sys.path:  # an installed script lacks the user's own modules
            sys.path.append(os.getcwd())
        with report_errors(lambda: command.interrupted() if command else "interrupted"):
            command = read_command(cls)
            words = {word.replace("-", "_") for word in sys.argv}
            for item in fields(command):
                if f"__{item.name}" in words and getattr(command, item.name) == ():
                    raise refusal(item.name, (), "one value or more")
            with (
                trust_files(getattr(command, "trust", False)),
                quietly(isinstance(command, Long) and command.quiet),
            ):
                check_options(command)
                command.run()

    @abstractmethod
    def run(self) -> None:
        """Run the command.

        Raises:
            ConfigurationError: an option that is not allowed.
            KeyboardInterrupt: the work was interrupted.
        """

    def interrupted(self) -> str:
        """Return the message after an interrupt."""
        return "interrupted"


@dataclass(frozen=True)
class Long(Command):
    """A command with long work, which shows its progress and how to resume."""

    quiet: bool = field(default=False, kw_only=True)
    """Show only results and errors, without progress and remarks."""
    trust: bool = field(default=False, kw_only=True)
    """Run code of files: objects named as module:name, and code in the file of model:PATH."""

    keeps: ClassVar[bool] = True  # whether an interrupt keeps finished parts

    def interrupted(self) -> str:
        """Return the command line that resumes the work, if a part is saved."""
        if not self.keeps:
            return "interrupted: nothing is saved"
        return f"interrupted; continue with: {self.again()}"

    def again(self) -> str:
        """Return the words of the command line, with ``--resume`` where it exists."""
        more = ["--resume"] if "resume" in {item.name for item in fields(self)} else []
        words = [word for word in sys.argv[1:] if word not in more]
        return f"{program_of(type(self))} {shlex.join([*words, *more])}"


@dataclass(frozen=True)
class EnvironmentOptions:
    """The options of a command for one environment."""

    env: str | None = field(default=None, kw_only=True)
    """Id of a registered environment."""
    config: str | None = field(default=None, kw_only=True)
    """Take environment and options from the YAML file of a training or from a shipped config."""
    options: SetOptions = field(default=(), kw_only=True)
    """Options of gym.make for the environment; they override all others."""

    def environment(self) -> tuple[str, Options]:
        """Return the id and the options of the environment."""
        options = parse_settings("option", list(itertools.chain(*self.options)))
        if self.config is None and self.env is None:
            raise ConfigurationError("env = None is not allowed: give --env ID or --config FILE")
        if self.config is None:
            return str(self.env), options
        # Imported here, because Stable-Baselines3 takes seconds to load.
        from fusion_gym.training.config import Experiment, load_checked

        environment = load_checked(Experiment, self.config).environment
        return self.env or environment.id, environment.options | options


_REGISTRY = tyro.constructors.ConstructorRegistry()
# What help says of a default that is no value.
_DEFAULTS = {"": "", "None": "", "False": "", str(tyro.MISSING): "(required)"}
_WIDTH = 80


@_REGISTRY.primitive_rule
def _optional(
    info: tyro.constructors.PrimitiveTypeInfo,
) -> tyro.constructors.PrimitiveConstructorSpec[Any] | None:
    """Parse ``X | None`` as X; a missing option is None."""
    parts = get_args(info.type)
    if len(parts) != 2 or parts[1] is not type(None):
        return None
    spec = _REGISTRY.get_primitive_spec(
        tyro.constructors.PrimitiveTypeInfo.make(parts[0], info.markers)
    )
    assert isinstance(spec, tyro.constructors.PrimitiveConstructorSpec)
    return replace(spec, is_instance=lambda value: value is None or spec.is_instance(value))


@_REGISTRY.struct_rule
def _command(
    info: tyro.constructors.StructTypeInfo,
) -> tyro.constructors.StructConstructorSpec | None:
    """Show the default of an option where it says more than that the option is absent."""
    kind: Any = info.type
    if not (isinstance(kind, type) and issubclass(kind, Command)):
        return None
    types, texts = declaration.hints(kind), declaration.meanings(kind)
    hint = tyro.conf.arg(help_behavior_hint=lambda text: _DEFAULTS.get(text, f"(default: {text})"))
    options = (
        tyro.constructors.StructFieldSpec(
            item.name,
            Annotated[types[item.name], hint],  # type: ignore[arg-type]
            tyro.MISSING if item.default is MISSING else item.default,
            texts.get(item.name),
        )
        for item in fields(kind)
    )
    return tyro.constructors.StructConstructorSpec(kind, tuple(options))


def read_command(kind: type[_Kind]) -> _Kind:
    """Return the command with the options of the command line."""
    _check_words()
    output, printed = io.StringIO(), io.StringIO()
    # A paragraph as one line, because tyro keeps a line break before a mark.
    text = re.sub(r"(?<=\S)\n(?=\S)", " ", inspect.getmodule(kind).__doc__ or "")
    try:
        with contextlib.redirect_stderr(output), contextlib.redirect_stdout(printed):
            return tyro.cli(
                kind,
                prog=program_of(kind),
                description=plain_marks(text),
                registry=_REGISTRY,
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as end:
        if end.code:
            print(f"error: {_essence(output.getvalue())}", file=sys.stderr)
        text = printed.getvalue()  # the help, or a script that completes words in a shell
        print(_fold(text) if text.startswith("usage: ") else text, end="")
        flush()
        raise


def _fold(text: str) -> str:
    """Return help with its paragraphs in lines of 80 characters; a space begins another line."""
    wrapper = textwrap.TextWrapper(_WIDTH, break_long_words=False, break_on_hyphens=False)
    lines = (line.rstrip() for line in re.sub(r"\n{3,}", "\n\n", text).split("\n"))
    return "\n".join(line if line[:1] in ("", " ") else wrapper.fill(line) for line in lines)


def _check_words() -> None:
    """Check that every word of the command line is non-empty text without control characters."""
    option = "the command line"
    for word in sys.argv[1:]:
        named = word.startswith("--")
        option = word.strip("-").partition("=")[0] if named else option
        if not word or (named and word.endswith("=")):
            raise ConfigurationError(f"{option} = '' is not allowed: it must not be empty")
        if re.search(CONTROL, word):  # undecodable bytes included
            allowed = "UTF-8 without control characters"
            raise ConfigurationError(f"{option} = {word!r} is not allowed: it must be {allowed}")


def _essence(message: str) -> str:
    """Return the text between tyro's title and the next rule, as one line."""
    lines = [re.sub(r"\x1b\[[\d;]*m", "", line).strip("│ ") for line in message.splitlines()[1:]]
    body = itertools.dropwhile(_is_rule, lines)
    return " ".join(itertools.takewhile(lambda line: not _is_rule(line), body)).removeprefix(
        "Error parsing "
    )


def _is_rule(line: str) -> bool:
    return not line.strip("─-╰╯ ")
