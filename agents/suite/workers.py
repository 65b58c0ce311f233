"""Worker processes that end with the process that they work for."""

from __future__ import annotations

import functools
import os
import threading
import time

_EVERY = 1.0  # seconds between two looks


@functools.cache
def end_with(parent: int) -> None:
    """End this process soon after its ``parent`` is gone, also where that was killed.

    The system then gives an orphan another parent. Where it does not (Windows), nothing happens.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_EVERY)
        os._exit(1)  # at once: nobody waits for the work, and its files are whole

    threading.Thread(target=watch, name="end-with-parent", daemon=True).start()
