"""The end of a command: one line for errors of the user or the machine, and an exit status."""

import contextlib
import io
import os
import signal
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterator

from fusion_gym.core.knowledge import SignalError
from fusion_gym.validation import ConfigurationError

# Folders of Python and of packages, whose frames are not a user's.
_INSTALLED = ("<", *(sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")))

# Modules that run commands; the others call a user's code.
_COMMANDS = ("agents.", *(f"fusion_gym.{name}." for name in ("commands", "output", "training")))


@contextlib.contextmanager
def report_errors(interrupted: Callable[[], str] = lambda: "interrupted") -> Iterator[None]:
    """End the program with one line after an error of the user or the machine.

    An error in a user's code ends with its file and line. Any other error keeps its traceback. The
    exit status is 1, after an interrupt 130, and after a closed output 141.

    Args:
        interrupted: function that returns the line after an interrupt.
    """
    try:
        if isinstance(sys.stdout, io.TextIOWrapper):  # some terminals lack characters
            sys.stdout.reconfigure(errors="backslashreplace")
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
    """Turn an error in a user's code that the library called into one line with its place."""
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
def ended_like_by_ctrl_c() -> Iterator[None]:
    """Let SIGTERM act like Ctrl-C inside the context, so that workers stop too."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def flush() -> None:
    """Flush the output, or raise an error if it cannot be written."""
    if sys.stdout is not None:  # it is None where it was closed
        sys.stdout.flush()


def _drop_output() -> None:
    """Discard output that cannot be written, which the interpreter would try again at its end."""
    try:
        flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _joined(message: object) -> str:
    """Return the message in one line."""
    return " ".join(line.strip() for line in str(message).splitlines())
