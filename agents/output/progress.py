"""The progress bar of all scripts."""

from __future__ import annotations

import sys
from typing import Any

from tqdm import tqdm


def progress_bar(total: int, description: str, initial: int = 0, quiet: bool = False) -> tqdm[Any]:
    """A bar over environment steps; where nobody watches, a line now and then; quiet, nothing."""
    return tqdm(
        disable=quiet,
        total=total,
        initial=initial,
        desc=description,
        unit="step",
        unit_scale=True,
        mininterval=0.2 if sys.stderr.isatty() else 20.0,
    )
