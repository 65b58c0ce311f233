"""Who does the work, and where its files are: processes of this machine, or a cluster.

joblib hands it out, through its own processes (``loky``) or a dask scheduler; a ray cluster does it
as ray's tasks, for joblib's backend of it gives nothing back before all is done. On other machines
every path must be the same: the folders of results and work are shared.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import json
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import joblib
import torch

from agents.cache import Cache
from fusion_gym.output.ending import name_user_code
from fusion_gym.output.folders import alone_in, check_inputs, fingerprint
from fusion_gym.output.progress import Bar, progress_bar
from fusion_gym.training.checked import read_yaml
from fusion_gym.training.config import Experiment
from fusion_gym.training.monitor import log_line
from fusion_gym.training.run import holds_training, train
from fusion_gym.validation import ConfigurationError

BackendName = Literal["loky", "dask", "ray"]
_PACKAGES = {"dask": "distributed", "ray": "ray"}
_PATIENCE = 30.0  # seconds until a scheduler that does not answer is given up


@dataclass(frozen=True)
class Pool:
    """``workers`` processes here, or all of the cluster at ``address``.

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

    def map_unordered(self, function: Callable[[Any], Any], pieces: Sequence[Any]) -> Iterator[Any]:
        """Let the pool do the pieces; what the function returns, as it comes. While connected."""
        if self.backend == "ray":
            yield from self._map_by_ray(function, pieces)
        else:
            calls = (joblib.delayed(function)(piece) for piece in pieces)
            yield from joblib.Parallel(return_as="generator_unordered", batch_size=1)(calls)

    def _map_by_ray(self, function: Callable[[Any], Any], pieces: Sequence[Any]) -> Iterator[Any]:
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
                reason = str(error).splitlines()[0] if str(error) else type(error).__name__
                raise ConfigurationError(
                    f"address = {self.address!r} is not allowed with backend={self.backend!r}: "
                    f"{reason}"
                ) from None
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


class Folders(NamedTuple):
    """``results`` holds tables for readers, ``work`` trainings and the cache of finished pieces."""

    results: Path
    work: Path

    @classmethod
    def create(cls, results: Path | None, work: Path | None, quick: bool) -> Folders:
        """Return the folders of a command line, or the usual ones.

        Raises:
            ConfigurationError: the work folder is one of an earlier version.
        """
        folders = cls(
            results or Path("results/quick" if quick else "results"),
            work or Path("runs/benchmark/quick" if quick else "runs/benchmark/full"),
        )
        for name in ("tuned", "tested", "baselines.json"):
            for path in folders.work.glob(f"*/{name}"):
                raise ConfigurationError(
                    f"work = {str(folders.work)!r} holds {str(path)!r} of an earlier version: give "
                    "another --work, or remove all there but the trainings, SETTING/CLASS_SEED"
                )
        return folders

    @property
    def cache(self) -> Cache:
        """Finished pieces of work."""
        return Cache(self.work / "pieces")

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Both folders, made if they are not there, for this process alone.

        Raises:
            ConfigurationError: another process works there, or they cannot be written.
        """
        with contextlib.ExitStack() as stack:
            stack.enter_context(alone_in(self.results, "results"))
            if self.work.resolve() != self.results.resolve():
                stack.enter_context(alone_in(self.work, "work"))
            yield


def training_of(experiment: Experiment) -> dict[str, Any]:
    """Return all that a training depends on."""
    return experiment.model_dump(mode="json", exclude={"output"})


def check_training(experiment: Experiment) -> None:
    """Whether a training in its folder, if there is one, is of this config.

    Raises:
        ConfigurationError: it is of another one; names the first difference.
    """
    folder = Path(experiment.output)
    if holds_training(folder):
        begun = read_yaml(folder / "config.yaml", "work")
        begun = {key: value for key, value in dict(begun or {}).items() if key != "output"}
        check_inputs(training_of(experiment), begun, f"the training in {str(folder)!r}")


def run_training(experiment: Experiment) -> dict[str, Any]:
    """Train as far as it is not, and return the summary.

    Raises:
        KeyboardInterrupt: the training was interrupted.
    """
    torch.set_num_threads(1)
    resume = holds_training(Path(experiment.output))
    summary = train(experiment, resume=resume, quiet=True)
    if not summary["finished"]:
        raise KeyboardInterrupt
    return summary


class Call(NamedTuple):
    """A call, about how long it takes in seconds on one core, and the training that it does."""

    weight: float
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    training: Experiment | None = None

    @property
    def validation(self) -> dict[str, Any] | None:
        """The last validation that its training has written."""
        if self.training is None:
            return None
        with contextlib.suppress(FileNotFoundError):
            text = Path(self.training.output, "validation.jsonl").read_text(encoding="utf-8")
            whole = text[: text.rfind("\n") + 1].splitlines()
            return json.loads(whole[-1]) if whole else None
        return None


class WorkPiece(Protocol):
    """A piece of work: all that its result depends on, and its time in seconds on one core."""

    @property
    def inputs(self) -> dict[str, Any]: ...
    @property
    def weight(self) -> float: ...


def missing(
    function: Callable[[Any], Any], pieces: Iterable[WorkPiece], cache: Cache
) -> list[Call]:
    """Return the calls that put the results of these pieces into the cache, each once."""
    every = {fingerprint(piece.inputs): piece for piece in pieces}
    return [
        Call(piece.weight, _fill, (cache, function, piece), getattr(piece, "experiment", None))
        for piece in every.values()
        if not cache.holds(function, piece.inputs)
    ]


def _fill(cache: Cache, function: Callable[[Any], Any], piece: WorkPiece) -> None:
    cache.call(function, piece.inputs, piece)


def side_by_side(work: Sequence[Call], pool: Pool, description: str) -> list[Any]:
    """Let the pool do the work, show how far it is, and return the results in the work's order.

    Raises:
        ConfigurationError: some of it does not fit, there is no such pool, or the system ended a
            worker.
    """
    if not work:
        return []
    results: list[Any] = [None] * len(work)
    left = dict(enumerate(work))
    parent = os.getpid() if pool.local else None
    with (
        progress_bar(len(work), description, unit="pieces") as bar,
        pool.connect(),
        _watch(bar, left),
    ):
        ended = pool.map_unordered(functools.partial(_do, parent), list(enumerate(work)))
        try:
            for place, result in ended:
                results[place] = result
                del left[place]
        except BrokenProcessPool:
            raise ConfigurationError(
                f"workers = {pool.workers}: the system ended one of them, perhaps for want of "
                "memory; finished pieces of work are kept: go on as after an interrupt"
            ) from None
    return results


@contextlib.contextmanager
def _watch(bar: Bar, left: Mapping[int, Call]) -> Iterator[None]:
    """Show on the bar how far the calls that are ``left`` and their trainings are."""
    total, calls = sum(call.weight for call in left.values()), len(left)
    end = threading.Event()

    def show() -> None:
        share = 1.0
        for call in list(left.values()):
            last = call.validation
            share -= call.weight / total
            if last is not None and call.training is not None:
                share += call.weight / total * last["timesteps"] / call.training.training.timesteps
                bar.say(f"{Path(call.training.output).parent.name}: {log_line(last)}")
        bar.reach(calls - len(left), share)

    def repeat() -> None:
        while not end.wait(_EVERY):
            show()

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()
        show()


def _do(parent: int | None, item: tuple[int, Call]) -> tuple[int, Any]:
    """Return the place and the result of a call. A worker here ends with its ``parent``."""
    if parent is not None and os.getpid() != parent:
        end_with(parent)
    place, call = item
    with name_user_code():
        return place, call.function(*call.arguments)


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
