"""The progress of long work: bars on a terminal, plain lines elsewhere.

    writing(("models and validations", folder))
    with progress_bar(total, "training") as bar:
        bar.update(steps)

All output goes to stderr. On a terminal every piece of work has a bar. A file or a pipe receives a
line at intervals, without control characters; a closed stderr receives nothing.
"""

import contextlib
import os
import sys
import time
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path

from rich.console import Console
from rich.progress import Progress, ProgressColumn, Task
from rich.progress_bar import ProgressBar
from rich.table import Column
from rich.text import Text

_QUIET: ContextVar[bool] = ContextVar("quiet", default=False)
# Seconds between two lines, at most, and their share of the elapsed time.
_EVERY, _MOST, _SHARE = 20.0, 600.0, 0.1


class Bar:
    """The progress of a piece of work: ``done`` of ``total`` in a ``unit``, given in the plural.

    ``share`` of the work, from 0 to 1, gives the remaining time; ``note`` describes the present
    work.
    """

    def __init__(self, description: str, total: float, unit: str, initial: float = 0.0) -> None:
        self.description, self.total, self.unit = description, total, unit
        self.done, self.note, self.share = initial, "", initial / total if total else 1.0
        self._began = self._reached = time.monotonic()
        self._first, self._due = self.share, self._began + _EVERY
        self._ended: float | None = None
        self.plain = False  # whether lines are printed instead of a bar

    def update(self, amount: float = 1.0) -> None:
        """Add an amount to ``done``."""
        self.reach(self.done + amount)

    def reach(self, done: float, share: float | None = None) -> None:
        """Set ``done``, and ``share`` if parts of the work differ in duration."""
        self.done = min(max(done, self.done), self.total)
        known = self.done / self.total if share is None and self.total else share or 0.0
        if known > self.share:
            self.share, self._reached = min(known, 1.0), time.monotonic()
        now = time.monotonic()
        if self.plain and now >= self._due:
            self._due = now + min(max(_EVERY, _SHARE * self.seconds), _MOST)
            remark(self.line())

    def say(self, note: str) -> None:
        """Set the note."""
        self.note = note

    @property
    def begun(self) -> bool:
        """Whether the work has advanced."""
        return self.share > self._first

    @property
    def seconds(self) -> float:
        """Seconds since the start or resumption of the work."""
        return (self._ended or time.monotonic()) - self._began

    @property
    def left(self) -> float | None:
        """Seconds that remain at the mean speed so far; None before the work has advanced."""
        if not self.begun:
            return 0.0 if self.share >= 1.0 else None
        needed = (self._reached - self._began) * (1.0 - self.share) / (self.share - self._first)
        return max(needed - (time.monotonic() - self._reached), 0.0)

    @property
    def count(self) -> str:
        """``done`` and ``total``, as text."""
        return f"{int(self.done):,}/{int(self.total):,} {self.unit}"

    @property
    def clock(self) -> str:
        """The elapsed and the remaining time, as text."""
        if self.share >= 1.0:
            return _time(self.seconds)
        left = "?" if self.left is None else _time(self.left)
        return f"{_time(self.seconds)}, {left} left"

    def end(self) -> None:
        """Stop the clock."""
        self._ended, self.plain = time.monotonic(), False

    def line(self) -> str:
        """Return the progress in one line."""
        message = [f"{self.description}: {int(100 * self.share)} %", self.count, self.clock]
        return ", ".join([*message, self.note] if self.note else message)


@contextlib.contextmanager
def progress_bar(
    total: float, description: str, initial: float = 0.0, quiet: bool = False, unit: str = "steps"
) -> Iterator[Bar]:
    """Show a bar inside the context, below the bars of outer contexts."""
    bar = Bar(description, total, unit, initial)
    silent = quiet or is_quiet()
    drawn = not silent and (_SCREEN.progress is not None or _watched())
    bar.plain = plain = not (silent or drawn)
    with _SCREEN.showing(bar) if drawn else contextlib.nullcontext():
        try:
            yield bar
        finally:
            bar.end()
            if plain and bar.begun:
                remark(bar.line())


@contextlib.contextmanager
def quietly(quiet: bool = True) -> Iterator[None]:
    """Show neither bars nor remarks inside the context."""
    token = _QUIET.set(quiet or _QUIET.get())
    try:
        yield
    finally:
        _QUIET.reset(token)


def is_quiet() -> bool:
    """Return whether only results and errors are shown."""
    return _QUIET.get() or sys.stderr is None  # after the shell's 2>&-


def remark(text: str) -> None:
    """Print a line to stderr, above the bars."""
    if is_quiet():
        return
    if _SCREEN.progress is not None:
        _SCREEN.progress.console.print(Text(text), soft_wrap=True)
    else:
        print(text, file=sys.stderr, flush=True)


def writing(*goods: tuple[str, Path | str]) -> None:
    """Print the kinds of output and their folders or files."""
    remark("writing " + ", ".join(f"{what} into {place}" for what, place in goods))


class _Screen:
    """The bars of a terminal, one below the other."""

    def __init__(self) -> None:
        self.progress: Progress | None = None

    @contextlib.contextmanager
    def showing(self, bar: Bar) -> Iterator[None]:
        if self.progress is not None:
            self.progress.add_task("", bar=bar)
            yield
            return
        # Otherwise stdout is left unchanged.
        watched = sys.stdout is not None and sys.stdout.isatty()
        with Progress(*_columns(), console=Console(stderr=True), redirect_stdout=watched) as result:
            self.progress = result
            try:
                result.add_task("", bar=bar)
                yield
            finally:
                self.progress = None


_SCREEN = _Screen()


class _Part(ProgressColumn):
    """A column with an attribute of a bar; columns that are not ``whole`` are shortened first."""

    def __init__(self, name: str, style: str = "", whole: bool = True) -> None:
        super().__init__(Column(no_wrap=whole))
        self._name, self._style = name, style

    def render(self, task: Task) -> Text:
        text = getattr(task.fields["bar"], self._name)
        return Text(text, self._style, no_wrap=True, overflow="ellipsis")


class _Drawn(ProgressColumn):
    """The column of the bar."""

    def __init__(self) -> None:
        super().__init__(Column(min_width=8, max_width=20))

    def render(self, task: Task) -> ProgressBar:
        return ProgressBar(1.0, task.fields["bar"].share)


def _columns() -> list[ProgressColumn]:
    return [
        _Part("description"),
        _Drawn(),
        _Part("count", "progress.download"),
        _Part("clock", "progress.remaining"),
        _Part("note", whole=False),
    ]


def _time(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"


def _watched() -> bool:
    """Return whether stderr is a terminal that can draw."""
    return sys.stderr.isatty() and os.environ.get("TERM") not in ("dumb", "unknown")
