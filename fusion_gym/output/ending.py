"""How every command ends: with one line for what is no bug, and an exit status."""

import contextlib
import functools
import io
import os
import signal
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterator
from typing import Any

from fusion_gym.core.system import SignalError
from fusion_gym.validation import ConfigurationError

# Where Python and packages are, whose frames are not a user's.
_INSTALLED = ("<", *(sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")))

# Modules that run commands; the others call a user's code.
_COMMANDS = ("agents.", *(f"fusion_gym.{name}." for name in ("commands", "output", "training")))


@contextlib.contextmanager
def report_errors(interrupted: Callable[[], str] = lambda: "interrupted") -> Iterator[None]:
    """Let what a user or the machine did wrong end the program with one line.

    An error in a user's code ends with its file and line. Anything else is an error of the
    program's own, and keeps its traceback.

    Raises:
        SystemExit: a setting that is not allowed, a file or the memory that the system refuses
            (status 1, one line says what); an interrupt (130, after the line ``interrupted``
            returns); nobody reads the output any more (141, and nothing is said).
    """
    try:
        _write_anything()
        with name_user_code():
            yield
        flush()
    except ConfigurationError as error:
        sys.exit(f"error: {_joined(error)}")
    except KeyboardInterrupt:
        print(interrupted(), file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:
        _drop_output()
        sys.exit(141)
    except OSError as error:
        _drop_output()
        place = "" if error.filename is None else f"{str(error.filename)!r}: "
        sys.exit(f"error: {place}{_joined(error.strerror or error)}")
    except MemoryError as error:
        sys.exit(f"error: there is not enough memory. {_joined(error)}".rstrip(". "))


@contextlib.contextmanager
def name_user_code() -> Iterator[None]:
    """Turn an error in a user's code that the library called into one line with its place.

    Raises:
        ConfigurationError: names file, line and error. Errors of ours pass.
    """
    try:
        yield
    except (ConfigurationError, BrokenPipeError):
        raise
    except SignalError as error:
        raise ConfigurationError(str(error)) from None
    except Exception as error:
        place, called = "", False
        for frame, line in traceback.walk_tb(error.__traceback__):
            name, file = frame.f_globals.get("__name__", ""), frame.f_code.co_filename
            if name.partition(".")[0] in ("fusion_gym", "agents"):
                place, called = "", not name.startswith(_COMMANDS)
            elif called and not file.startswith(_INSTALLED):
                place = f"{file}, line {line}, in {frame.f_code.co_name}: {type(error).__name__}"
        if not place:
            raise
        raise ConfigurationError(f"{place}: {error}".rstrip(": ")) from None


@contextlib.contextmanager
def on_signal(number: int, handler: Any) -> Iterator[None]:
    """Handle a signal this way while the context is entered."""
    before = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, before)


# Ended from outside like by Ctrl-C, so that workers stop too.
ended_like_by_ctrl_c = functools.partial(on_signal, signal.SIGTERM, signal.default_int_handler)


def flush() -> None:
    """What was printed arrives, or an error says that it did not."""
    if sys.stdout is not None:  # it is None where it was closed
        sys.stdout.flush()


def _drop_output() -> None:
    """What cannot be printed is forgotten; the interpreter would try once more at its end."""
    try:
        flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _write_anything() -> None:
    """Characters that the terminal does not know are printed as escapes."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def _joined(message: object) -> str:
    """The message in one line."""
    return " ".join(line.strip() for line in str(message).splitlines())
