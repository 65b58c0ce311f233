"""The benchmark of policies: tuned baselines, learned fronts and references in every setting.

    python -m agents.benchmark [--envs NAME …] [--modes sensors …] [--quick] [--resume]

Every piece of work (a setting's baselines, one training seed of one agent) writes its JSON into
the results folder as it is finished, and its episodes into the work folder; ``--resume`` skips
what is there, if it was made from the same inputs, and goes on with trainings in the work folder,
whose checkpoints hold pickles. ``python -m agents.report`` makes tables and figures of it.
"""

from __future__ import annotations

import os
import shlex
import signal
import sys
import time
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import joblib
from tqdm import tqdm

from fusion_gym.core.system import covers
from fusion_gym.evaluation.envelope import lower_envelope
from fusion_gym.validation import ConfigurationError, choice

from .command_line import Command, spelled, start
from .input.options import OutputFolder, Steps, Whole, writable_folder
from .output.files import load_results, read_json, write
from .suite.config import COMPARED_UP_TO, Setting, Suite, load_suite
from .suite.jobs import Folders, Job, finished, jobs, setting_task
from .suite.verdict import judge
from .suite.work import run
from .training.checked import parse


@dataclass(frozen=True)
class Benchmark(Command):
    """The benchmark of policies: tuned baselines, learned fronts and references."""

    config: str = "benchmark"
    """The suite: a YAML file, or the name of a shipped config."""
    envs: tuple[str, ...] = ()
    """Settings by name; none stands for all."""
    modes: tuple[str, ...] = ()
    """Some of sensors, centre and local; none stands for all."""
    quick: bool = False
    """Less of everything, in minutes."""
    resume: bool = False
    """Skip what is finished, go on with trainings of one's own: their checkpoints hold pickles."""
    results: Annotated[Path | None, OutputFolder()] = None
    """Folder for JSON, instead of results or results/quick."""
    work: Annotated[Path | None, OutputFolder()] = None
    """Folder for models and episodes, instead of runs/benchmark/full or quick."""
    workers: Annotated[int, Whole(1, 512)] = 2
    """Processes side by side."""
    seeds: Annotated[int | None, Whole(1, 10_000)] = None
    """Number of training seeds, instead of the config's."""
    timesteps: Steps = None
    """Steps of each training, instead of the config's."""

    def run(self) -> None:
        """Do all work that is not finished, and judge every setting."""
        # Ended from outside like by Ctrl-C: the workers stop too.
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            self._run()
        finally:
            signal.signal(signal.SIGTERM, before)

    def interrupted(self) -> str:
        """Finished pieces of work are kept."""
        words = [word for word in sys.argv[1:] if word != "--resume"]
        command = shlex.join([*spelled("benchmark").split(), *words, "--resume"])
        return f"interrupted; go on with: {command}"

    def suite(self) -> Suite:
        """The config with what the command line says instead, checked again.

        Raises:
            ConfigurationError: a config or a value that is not allowed.
        """
        suite = load_suite(self.config, self.quick)
        changed = {"training_seeds": self.seeds, "timesteps": self.timesteps}
        changed = {key: value for key, value in changed.items() if value is not None}
        return parse(Suite, suite.model_dump() | changed, "command line")

    def _run(self) -> None:
        suite = self.suite()
        folders = Folders(
            self.results or Path("results/quick" if self.quick else "results"),
            self.work or Path("runs/benchmark/quick" if self.quick else "runs/benchmark/full"),
        )
        writable_folder("results", folders.results)
        writable_folder("work", folders.work)
        by_name = {setting.name: setting for setting in suite.settings}
        chosen = [by_name[choice("envs", name, by_name)] for name in self.envs or by_name]
        for mode in self.modes:
            choice("modes", mode, suite.modes)
        modes = [mode for mode in suite.modes if not self.modes or mode in self.modes]
        work = list(jobs(suite, chosen, modes))
        for setting in chosen:
            setting_task(setting)
        with folders.alone():
            present = sum(folders.hold(job) for job in work)
            if present and not self.resume:
                raise ConfigurationError(
                    f"results = {str(folders.results)!r} holds {present} finished pieces of work: "
                    "go on with --resume, or give another --results and --work"
                )
            # All of the settings' pieces, for the verdict is over all of them.
            every = jobs(suite, chosen, suite.modes)
            done = [job.place for job in every if finished(job, suite, folders)]
            left = [job for job in work if job.place not in done]
            execute(suite, left, folders, self.workers)
            for setting in chosen:
                conclude(suite, setting, folders)
        report = f"{spelled('report')} --results {folders.results}"
        print(f"results in {folders.results}: {report}")


def conclude(suite: Suite, setting: Setting, folders: Folders) -> dict[str, Any] | None:
    """The verdict over whatever agents of a setting are finished, written as ``verdict.json``.

    Raises:
        ConfigurationError: results that are damaged or were made from other settings.
    """
    pieces = [job for job in jobs(suite, [setting], suite.modes) if finished(job, suite, folders)]
    reports = {job.name: read_json(folders.report(job), "results") for job in pieces}
    found = {
        job.name: load_results(folders.episodes(job), reports[job.name]["made_from"])
        for job in pieces
    }
    if "baselines" not in found:
        return None
    every, known = found["baselines"], found.get("references", {})
    references = {"sensors": found.get("informed", {}) | known, "centre": known, "local": {}}
    always = float(every["always"].rate.mean())
    verdict: dict[str, Any] = {"setting": setting.name, "title": setting.title, "modes": {}}
    for mode in suite.modes:
        done = [job.name for job in pieces if job.mode == mode]
        if not done:
            continue
        comparable = {
            name: every[name]
            for curve in reports["baselines"]["curves"].values()
            if covers(COMPARED_UP_TO[mode], curve["knows"])
            for name in curve["policies"]
        }
        agents = [list(found[name].values()) for name in done]
        prices = reports[done[0]]["prices"]
        verdict["modes"][mode] = judge(
            agents, prices, comparable, references[mode], always, found.get("hindsight", {})
        ) | {"envelope": [point._asdict() for point in lower_envelope(comparable)]}
    write(folders.results / setting.name / "verdict.json", verdict)
    return verdict


def execute(suite: Suite, work: list[Job], folders: Folders, workers: int) -> None:
    """Run the jobs on several cores, with an estimate of the remaining time.

    Raises:
        ConfigurationError: a job does not fit, or the system ended a worker.
    """
    total = sum(job.weight for job in work)
    began = time.perf_counter()
    with tqdm(total=round(total), desc="benchmark", unit="s of work", smoothing=0.0) as bar:
        weights = joblib.Parallel(n_jobs=workers, return_as="generator_unordered")(
            joblib.delayed(run)(job, suite, folders, os.getpid()) for job in work
        )
        try:
            for weight in weights:
                bar.update(min(weight, bar.total - bar.n))
        except BrokenProcessPool:
            raise ConfigurationError(
                f"workers = {workers}: the system ended one of them, perhaps for want of memory; "
                "finished pieces of work are kept, go on with --resume"
            ) from None
    print(f"{len(work)} pieces of work in {time.perf_counter() - began:.0f} s")


def main() -> None:
    """Entry point; exit status 130 after an interrupt."""
    start(Benchmark)


if __name__ == "__main__":
    main()
