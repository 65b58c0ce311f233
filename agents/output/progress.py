"""The progress bar of all scripts."""

from __future__ import annotations

import sys
from typing import Any

from tqdm import tqdm


def progress_bar(total: int, description: str, initial: int = 0, quiet: bool = False) -> tqdm[Any]:
    """A bar over environment steps; where nobody watches, a line now and then; quiet, nothing."""
    closed = sys.stderr is None  # as the shell's 2>&- does
    return tqdm(
        disable=quiet or closed,
        total=total,
        initial=initial,
        desc=description,
        unit="step",
        unit_scale=True,
        mininterval=0.2 if not closed and sys.stderr.isatty() else 20.0,
    )
