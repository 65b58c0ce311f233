"""Workers of jobs: processes of this machine, or a cluster.

joblib distributes them to its own processes (``loky``) or a dask scheduler. On other machines every
path must be the same: all machines share the folders of results and work.
"""

from __future__ import annotations

import contextlib
import functools
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import joblib

from fusion_gym.errors import forbidden
from fusion_gym.output.ending import name_user_code
from fusion_gym.output.progress import progress_bar
from fusion_gym.validation import ConfigurationError

BackendName = Literal["loky", "dask"]
_PATIENCE = 30.0  # seconds until a scheduler that does not answer is given up


@dataclass(frozen=True)
class Pool:
    """``workers`` processes of this machine, or a cluster at ``address``.

    ``dask`` without an address starts a cluster of so many workers on this machine.
    """

    workers: int = 2
    backend: BackendName = "loky"
    address: str | None = None

    def __post_init__(self) -> None:
        if self.address is not None and self.backend == "loky":
            raise forbidden("address", self.address, "it belongs to 'dask'", "with backend='loky'")

    @property
    def local(self) -> bool:
        """Whether the workers are child processes."""
        return self.backend == "loky"

    @contextlib.contextmanager
    def connect(self) -> Iterator[None]:
        """Connect to the pool for the duration of the context."""
        with contextlib.ExitStack() as stack:
            if not self.local:
                try:
                    stack.enter_context(self._client())
                except (OSError, ValueError) as error:
                    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
                    where = f"with backend={self.backend!r}"
                    raise forbidden("address", self.address, reason, where) from None
            jobs = self.workers if self.local else -1
            stack.enter_context(joblib.parallel_config(self.backend, n_jobs=jobs))
            yield

    def _client(self) -> Any:
        try:
            from distributed import Client
        except ImportError:
            reason = "it needs distributed: install fusion-gym with its extra 'dask'"
            raise forbidden("backend", "dask", reason) from None
        if self.address is None:
            return Client(n_workers=self.workers, threads_per_worker=1)
        return Client(address=self.address, timeout=_PATIENCE)


class Call(NamedTuple):
    """A call, with its approximate seconds on one core."""

    weight: float
    function: Callable[..., Any]
    arguments: tuple[Any, ...]


def run_parallel(work: Sequence[Call], pool: Pool, description: str) -> list[Any]:
    """Run the work in the pool with progress, and return the results in the work's order."""
    if not work:
        return []
    results: dict[int, Any] = {}
    parent, total = os.getpid() if pool.local else None, sum(call.weight for call in work)
    with progress_bar(100.0, description, unit="%") as bar, pool.connect():
        calls = (joblib.delayed(_do)(parent, item) for item in enumerate(work))
        pieces = joblib.Parallel(return_as="generator_unordered", batch_size=1)(calls)
        try:
            for place, result in pieces:
                results[place] = result
                bar.say(f"{len(results)} of {len(work)} pieces")
                bar.update(100.0 * work[place].weight / total)
        except BrokenProcessPool:
            raise ConfigurationError(
                f"workers = {pool.workers}: the system ended one of them; the memory may be full. "
                "Finished pieces of work are saved: continue as after an interrupt"
            ) from None
    return [results[place] for place in range(len(work))]


def _do(parent: int | None, item: tuple[int, Call]) -> tuple[int, Any]:
    """Return place and result of a call; a local worker ends with its ``parent``."""
    if parent is not None and os.getpid() != parent:
        end_with(parent)
    place, call = item
    with name_user_code():
        return place, call.function(*call.arguments)


_EVERY = 1.0  # seconds between two looks


@functools.cache
def end_with(parent: int) -> None:
    """End this process soon after its ``parent``, also after a kill.

    The system then gives an orphan another parent. On Windows, where it does not, nothing happens.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_EVERY)
        os._exit(1)  # at once: nobody waits for the work, and its files are whole

    threading.Thread(target=watch, name="end-with-parent", daemon=True).start()
