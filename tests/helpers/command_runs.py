"""Commands in this process: how they end, and what is wrong with how they refuse."""

import contextlib
import io
import os
import re
import signal
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from hostile_commands import Try, load
from hostile_folder import contents

POSIX = os.name == "posix"
if POSIX:
    import resource

NOBODY = 65534


class Hung(BaseException):
    """A try took too long."""


class Ended(NamedTuple):
    """How a command ended."""

    status: int
    out: str
    err: str
    trace: str


def call(command: str, words: list[str], seconds: float = 60.0, limit: int | None = None) -> Ended:
    """A command in this process, in the present folder; ``limit`` bytes are the longest file."""

    def late(*_: object) -> None:
        raise Hung

    out, err, trace, status = io.StringIO(), io.StringIO(), "", 0
    arguments, sys.argv = sys.argv, ["program", *words]
    if POSIX:  # elsewhere a try may take any time
        longest = resource.getrlimit(resource.RLIMIT_FSIZE)
        alarm = signal.signal(signal.SIGALRM, late)
        signal.setitimer(signal.ITIMER_REAL, seconds)
    if limit is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, longest[1]))
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            load(command).main()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 1
        if isinstance(end.code, str):
            err.write(end.code + "\n")
        status = 0 if end.code is None else status
    except BaseException:
        status, trace = 1, traceback.format_exc()
    finally:
        if POSIX:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            resource.setrlimit(resource.RLIMIT_FSIZE, longest)
            signal.signal(signal.SIGALRM, alarm)
        sys.argv = arguments
    return Ended(status, out.getvalue(), err.getvalue(), trace)


def succeed(command: str, words: list[str], seconds: float = 200.0) -> Ended:
    """Run a command that must end well."""
    ended = call(command, words, seconds)
    assert (ended.status, ended.trace) == (0, ""), ended.err
    return ended


def refusal(command: str, words: list[str], limit: int | None = None) -> str:
    """Run a command that must end with one line of error, and return the line."""
    ended = call(command, words, limit=limit)
    assert (ended.status, ended.trace) == (1, ""), ended.err
    message = ended.err.splitlines()[-1]
    assert message.startswith("error: ")
    return message


@contextlib.contextmanager
def without_rights(requests: bool) -> Iterator[None]:
    """As somebody who may not enter a locked folder, even if the tests run as root."""
    if not requests or not POSIX or os.geteuid() != 0:
        yield
        return
    os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(0)


# Other words that name an option: those of the one thing that stands in its list.
SAID = {
    "policies": {"policy", "model", "zoo"},
    "policy": {"policy", "model", "zoo"},
    "against": {"policy", "model", "zoo"},
    "set": {"option", "system", "error", "horizon", "cost_weight", "token_rate", "information"}
    | {"access"},
    "env": {"environment"},
    "seeds": {"seed"},
    "model": {"the command line"},
    "papers": {"the command line", "paper"},
    "kinds": {"the command line", "kind"},
    "log": {"the command line"},
    "name": {"the command line"},
}


def flaw(tried: Try, folder: Path) -> str | None:
    """What is wrong with how the command refuses; ``None`` if nothing is."""
    before = contents(folder)
    with without_rights("locked" in tried.value):
        ended = call(tried.command, tried.words)
    if ended.trace:
        return f"traceback: {ended.trace.strip().splitlines()[-1]}"
    if ended.status == 0:
        return "accepted"
    lines = ended.err.splitlines()
    if len(lines) != 1 or not lines[0].startswith("error: "):
        return f"not one line: {ended.err[:300]!r}"
    label = lines[0].replace("\\\\", "\\")
    spelled = {tried.option, tried.option.replace("_", "-")}
    spec = tried.option in ("policies", "policy", "against", "set")
    part = re.split("[:=,]", tried.value)[0] if spec else tried.value
    part = repr(part)[1:-1]
    if part[:100] not in label:
        return f"does not name the value: {lines[0][:300]}"
    if not any(name in label for name in spelled | SAID.get(tried.option, set())):
        return f"does not name the option: {lines[0][:300]}"
    if contents(folder) != before:
        return f"left {sorted(contents(folder).keys() ^ before.keys())}"
    return None
