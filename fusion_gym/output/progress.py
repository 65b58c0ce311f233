"""The progress of long work: bars on a terminal, plain lines elsewhere.

    writing(("models and validations", folder))
    with progress_bar(total, "training") as bar:
        bar.update(steps)

All output goes to stderr. On a terminal every piece of work has a bar. A file or a pipe receives a
line at intervals, without control characters; a closed stderr receives nothing.
"""

import contextlib
import sys
import time
from collections.abc import Iterator
from contextvars import ContextVar
from datetime import timedelta
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.table import Column
from rich.text import Text

_CONSOLE = Console(stderr=True, force_jupyter=False)
_QUIET: ContextVar[bool] = ContextVar("quiet", default=False)
_DRAWN: ContextVar[Progress | None] = ContextVar("drawn", default=None)
# Seconds between two lines, at most, and their share of the elapsed time.
_EVERY, _MOST, _SHARE = 20.0, 600.0, 0.1


class _Clock(ProgressColumn):
    """Time since the start or resumption, and what remains at the mean speed to the last gain."""

    def render(self, task: Task) -> Text:
        elapsed, gained = task.elapsed or 0.0, task.completed - task.fields["initial"]
        text, left = _time(elapsed), "?"
        if gained > 0.0:
            left = _time(task.fields["reached"] * (task.remaining or 0.0) / gained)
        return Text(text if task.finished else f"{text}, {left} left", "progress.remaining")


_COUNT = TextColumn(
    "{task.completed:,.0f}/{task.total:,.0f} {task.fields[unit]}", "progress.download", markup=False
)
_CLOCK = _Clock(Column(no_wrap=True))
_COLUMNS = (
    TextColumn("{task.description}", markup=False), BarColumn(20), _COUNT, _CLOCK,
    TextColumn("{task.fields[note]}", markup=False, table_column=Column()),
)  # fmt: skip


class Bar:
    """The progress of a piece of work, in a task of rich; ``plain`` prints lines."""

    def __init__(self, progress: Progress, task: Task, plain: bool, most: float = _MOST) -> None:
        self.task, self._progress, self.plain, self._due = task, progress, plain, _EVERY
        self._most = most

    def update(self, amount: float = 1.0) -> None:
        """Add an amount to what is done."""
        self.reach(self.task.completed + amount)

    def reach(self, done: float) -> None:
        """Set what is done; it never decreases, nor exceeds the total."""
        done = min(max(done, self.task.completed), self.task.total or 0.0)
        elapsed = self.task.elapsed or 0.0
        reached = elapsed if done > self.task.completed else self.task.fields["reached"]
        self._progress.update(self.task.id, completed=done, reached=reached)
        if self.plain and elapsed >= self._due:
            self._due = elapsed + min(max(_EVERY, _SHARE * elapsed), self._most)
            remark(self.line())

    def say(self, note: str) -> None:
        """Describe the present work."""
        self._progress.update(self.task.id, note=note)

    def line(self) -> str:
        """Return the progress in one line."""
        line = f"{self.task.description}: {_COUNT.render(self.task)}, {_CLOCK.render(self.task)}"
        return f"{line}, {note}" if (note := self.task.fields["note"]) else line


@contextlib.contextmanager
def progress_bar(
    total: float, description: str, initial: float = 0.0, quiet: bool = False, unit: str = "steps",
    most: float = _MOST,
) -> Iterator[Bar]:  # fmt: skip
    """Show a bar inside the context, below the bars of outer contexts.

    Without a terminal there are at most ``most`` seconds between two lines.
    """
    silent = quiet or is_quiet()
    drawn = not silent and sys.stderr.isatty() and not _CONSOLE.is_dumb_terminal
    outer = _DRAWN.get() if drawn else None
    progress = outer or Progress(
        *_COLUMNS, console=_CONSOLE, disable=not drawn, get_time=time.monotonic,
        redirect_stdout=sys.stdout is not None and sys.stdout.isatty(),  # otherwise unchanged
    )  # fmt: skip
    task = progress.add_task(
        description, total=total, unit=unit, initial=initial, reached=0.0, note=""
    )
    progress.update(task, completed=initial)
    bar = Bar(progress, progress.tasks[-1], plain=not (silent or drawn), most=most)
    token = _DRAWN.set(progress if drawn else _DRAWN.get())
    with contextlib.nullcontext() if outer else progress:
        try:
            yield bar
        finally:
            _DRAWN.reset(token)
            progress.stop_task(task)
            if bar.plain and bar.task.completed > initial:
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
    if not is_quiet():
        _CONSOLE.print(Text(text), soft_wrap=True)


def writing(*goods: tuple[str, Path | str]) -> None:
    """Print the kinds of output and their folders or files."""
    remark("writing " + ", ".join(f"{what} into {place}" for what, place in goods))


def _time(seconds: float) -> str:
    return str(timedelta(seconds=round(seconds)))
