"""The progress bars of all scripts."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Mapping
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


@contextlib.contextmanager
def progress_bars(
    totals: Mapping[str, int],
) -> Iterator[Callable[[str, Mapping[str, Any] | None], None]]:
    """A bar a training, one below the other; where nobody watches, a line a validation.

    What is yielded shows how far one of them is by its last validation (none: not so far yet).
    """
    watched = sys.stderr is not None and sys.stderr.isatty()
    width = max(map(len, totals))
    with contextlib.ExitStack() as stack:
        bars = {
            name: stack.enter_context(
                tqdm(
                    total=total,
                    desc=f"training {name:<{width}}",
                    unit="step",
                    unit_scale=True,
                    smoothing=0.0,
                    position=place,
                    disable=not watched,
                )
            )
            for place, (name, total) in enumerate(totals.items())
        }
        shown = dict.fromkeys(totals, 0)

        def show(name: str, record: Mapping[str, Any] | None) -> None:
            bar, new = bars[name], record is not None and record["timesteps"] > shown[name]
            if record is not None and new:
                shown[name] = record["timesteps"]
                result = f"MSE {record['mse']:.4f}, rate {record['rate']:.4f}"
                bar.set_postfix_str(result, refresh=False)
                bar.update(min(shown[name], totals[name]) - bar.n)
                if not watched and sys.stderr is not None:
                    reached = f"{shown[name]:,} of {totals[name]:,} steps"
                    print(f"training {name}: {reached}, {result}", file=sys.stderr, flush=True)
            bar.refresh()

        yield show
