"""Who does the work: processes of this machine, or a cluster that is there already.

joblib hands it out, through its own processes (``loky``) or a dask scheduler; a ray cluster does it
as ray's tasks, for joblib's backend of it gives nothing back before all is done. On other machines
every path must be the same: the folders of results and work are shared.
"""

import contextlib
import functools
import importlib
import json
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import joblib

from fusion_gym.validation import ConfigurationError

from ..output.ending import name_user_code, on_signal
from ..output.progress import progress_bar
from ..training.config import Experiment
from ..training.monitor import log_line
from ..training.run import holds_training, train

BackendName = Literal["loky", "dask", "ray"]
_PACKAGES = {"dask": "distributed", "ray": "ray"}
_PATIENCE = 30.0  # seconds until a scheduler that does not answer is given up


@dataclass(frozen=True)
class Pool:
    """``workers`` processes here, or all those of the cluster at ``address``.

    With ``dask`` or ``ray`` and without an address a cluster of so many workers is begun here.

    Raises:
        ConfigurationError: an address where there is no cluster.
    """

    workers: int = 2
    backend: BackendName = "loky"
    address: str | None = None

    def __post_init__(self) -> None:
        if self.address is not None and self.backend == "loky":
            raise ConfigurationError(
                f"address = {self.address!r} is not allowed with backend='loky', which has none: "
                "it belongs to 'dask' and 'ray'"
            )

    @property
    def local(self) -> bool:
        """Whether the workers are processes of this one."""
        return self.backend == "loky"

    def map_unordered(
        self, function: Callable[[Any], float], pieces: Sequence[Any]
    ) -> Iterator[float]:
        """Let the pool do the pieces; what the function returns, as it comes. While connected."""
        if self.backend == "ray":
            yield from self._map_by_ray(function, pieces)
        else:
            calls = (joblib.delayed(function)(piece) for piece in pieces)
            yield from joblib.Parallel(return_as="generator_unordered", batch_size=1)(calls)

    def _map_by_ray(
        self, function: Callable[[Any], float], pieces: Sequence[Any]
    ) -> Iterator[float]:
        ray = self._package()
        task = ray.remote(num_cpus=1, max_retries=-1)(lambda piece: function(piece))
        left = [task.remote(piece) for piece in pieces]
        while left:
            ended, left = ray.wait(left)
            try:
                yield from ray.get(ended)
            except ray.exceptions.RayTaskError as error:
                raise error.cause from None

    @contextlib.contextmanager
    def connect(self) -> Iterator[None]:
        """Hand work to the pool while this is entered.

        Raises:
            ConfigurationError: the backend's package is not installed, or nobody is at the address.
        """
        with contextlib.ExitStack() as stack:
            try:
                if self.backend == "dask":
                    stack.enter_context(self._package().Client(**self._cluster()))
                elif self.backend == "ray":
                    self._package().init(**self._cluster())
                    stack.callback(self._package().shutdown)
            except (OSError, ValueError) as error:
                raise self._nobody(error) from None
            if self.backend != "ray":
                jobs = self.workers if self.local else -1
                stack.enter_context(joblib.parallel_config(self.backend, n_jobs=jobs))
            yield

    def _cluster(self) -> dict[str, Any]:
        """Return what the backend needs to find a cluster, or to begin one here."""
        if self.address is not None:
            patience = {"timeout": _PATIENCE} if self.backend == "dask" else {}
            return {"address": self.address} | patience
        if self.backend == "dask":
            return {"n_workers": self.workers, "threads_per_worker": 1}
        return {"num_cpus": self.workers, "include_dashboard": False}

    def _package(self) -> Any:
        name = _PACKAGES[self.backend]
        try:
            return importlib.import_module(name)
        except ImportError:
            raise ConfigurationError(
                f"backend = {self.backend!r} is not allowed: it needs {name}, which "
                f"'fusion-gym[{self.backend}]' installs"
            ) from None

    def _nobody(self, error: Exception) -> ConfigurationError:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        return ConfigurationError(
            f"address = {self.address!r} is not allowed with backend={self.backend!r}: {reason}"
        )


_EVERY = 1.0  # seconds between two looks


class Call(NamedTuple):
    """A call and about how long it takes, in seconds on one core."""

    weight: float
    function: Callable[..., Any]
    arguments: tuple[Any, ...]


def side_by_side(work: Sequence[Call], pool: Pool, description: str) -> None:
    """Let the pool do the work, and show how far it is.

    Raises:
        ConfigurationError: some of it does not fit, there is no such pool, or the system ended a
            worker of this machine. A cluster gives the work of a worker that is gone to another.
    """
    if not work:
        return
    total, done = sum(item.weight for item in work), 0.0
    parent = os.getpid() if pool.local else None
    with progress_bar(len(work), description, unit="pieces") as bar, pool.connect():
        weights = pool.map_unordered(functools.partial(_do, parent), work)
        try:
            for place, weight in enumerate(weights, 1):
                done += weight
                bar.reach(place, done / total)
        except BrokenProcessPool:
            raise ConfigurationError(
                f"workers = {pool.workers}: the system ended one of them, perhaps for want of "
                "memory; finished pieces of work are kept: go on as after an interrupt"
            ) from None


def _do(parent: int | None, work: Call) -> float:
    """Do a piece of work; returns its weight. A worker of this machine ends with its ``parent``."""
    if parent is not None and os.getpid() != parent:
        end_with(parent)
    with name_user_code():
        work.function(*work.arguments)
    return work.weight


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


_EVERY = 1.0  # seconds between two looks


def train_beside(experiments: Mapping[str, Experiment]) -> dict[str, dict[str, Any]]:
    """Begin these trainings or go on with them, all at once; returns their summaries by name.

    Bars show what each has written of its validations. An interrupt, or what goes wrong in one of
    them, ends all after their rollout, with a checkpoint.

    Raises:
        KeyboardInterrupt: they were interrupted.
        ConfigurationError: as :func:`.training.run.train`, or the system ended a process.
    """
    others = set(multiprocessing.active_children())
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(len(experiments), spawn, end_with, (os.getpid(),)) as pool:
        try:
            with on_signal(signal.SIGINT, signal.SIG_IGN):  # the new processes ignore it
                running = {name: _begin(pool, item) for name, item in experiments.items()}
            _watch(experiments, set(running.values()))
            return {name: future.result() for name, future in running.items()}
        except BaseException as error:
            for child in set(multiprocessing.active_children()) - others:
                child.terminate()
            if isinstance(error, BrokenProcessPool):
                raise ConfigurationError(
                    f"trainings = {list(experiments)}: the system ended one of them, perhaps for "
                    "want of memory; what they have learned is kept"
                ) from None
            raise


def _begin(pool: ProcessPoolExecutor, experiment: Experiment) -> Future[dict[str, Any]]:
    resume = holds_training(Path(experiment.output))
    return pool.submit(train, experiment, resume=resume, quiet=True)


def _watch(experiments: Mapping[str, Experiment], left: set[Future[dict[str, Any]]]) -> None:
    """Show how far the trainings are until all have ended.

    Raises:
        KeyboardInterrupt: one was interrupted; or what went wrong in it.
    """
    with contextlib.ExitStack() as stack:
        bars = {
            name: stack.enter_context(progress_bar(item.training.timesteps, f"training {name}"))
            for name, item in experiments.items()
        }
        while left:
            done, left = wait(left, _EVERY)
            for name, experiment in experiments.items():
                last = _last_validation(Path(experiment.output))
                if last is not None:
                    bars[name].say(log_line(last))
                    bars[name].reach(last["timesteps"])
            for future in done:
                if not future.result()["finished"]:
                    raise KeyboardInterrupt


def _last_validation(folder: Path) -> dict[str, Any] | None:
    """What a training has last written of its validations."""
    try:
        lines = (folder / "validation.jsonl").read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        return None
    return json.loads(lines[-1]) if lines else None
