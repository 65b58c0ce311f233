"""Trainings side by side: a process and a bar of progress each, one interrupt for all."""

import contextlib
import json
import multiprocessing
import os
import signal
from collections.abc import Mapping
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from fusion_gym.validation import ConfigurationError

from ..output.ending import on_signal
from ..output.progress import progress_bar
from ..training.config import Experiment
from ..training.monitor import log_line
from ..training.run import holds_training, train
from .workers import end_with

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
