"""The commands: train, evaluate, compare, tune, benchmark and more (``python -m agents``)."""

from __future__ import annotations

import sys
from types import TracebackType


def missing_extra(error: BaseException) -> str | None:
    """The line that says what to install, if the error is that a package is missing."""
    if not isinstance(error, ModuleNotFoundError):
        return None
    missing = error.name or str(error)
    if missing.partition(".")[0] in ("fusion_gym", "agents"):
        return None
    return f"error: {missing} is missing: pip install 'fusion-gym[agents]'"


def _tell(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    line = "interrupted" if isinstance(error, KeyboardInterrupt) else missing_extra(error)
    if line is None:
        sys.__excepthook__(kind, error, trace)
    else:
        print(line, file=sys.stderr)


# python -m agents.COMMAND imports this first, for seconds, before the command can say anything.
if sys.argv[:1] == ["-m"]:
    sys.excepthook = _tell
