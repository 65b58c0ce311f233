"""The benchmark of policies: tuned envelopes, learned fronts and references in every setting.

    python -m agents.benchmark [--envs NAME …] [--modes sensors …] [--quick] [--resume]

Envelopes that are missing are tuned first, as ``python -m agents.envelope`` does; every agent keeps
the hash of the one that it is compared with. Every piece of work (one training seed of one agent,
say) writes its JSON into
the results folder as it is finished, and its episodes into the work folder; ``--resume`` skips
what is there, if it was made from the same inputs, and goes on with trainings in the work folder,
whose checkpoints hold pickles. ``python -m agents.report`` makes tables and figures of it.
"""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from fusion_gym.evaluation.envelope import points_of
from fusion_gym.validation import ConfigurationError, choice

from .command_line import Command, spelled, start
from .input.options import OutputFolder, Steps, Whole, writable_folder
from .output.ending import ended_like_by_ctrl_c
from .output.files import load_results, read_json, write
from .suite.classes import class_of
from .suite.committed import FOLDER, complete, present
from .suite.config import Setting, Suite, load_suite
from .suite.jobs import Folders, finished, jobs, setting_task
from .suite.team import BackendName, Team
from .suite.verdict import judge
from .suite.work import run
from .suite.workers import Work, side_by_side
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
    """Processes side by side, of this machine."""
    backend: BackendName = "loky"
    """Who works: loky's processes of this machine, or a dask or ray cluster."""
    address: str | None = None
    """Where dask's scheduler or ray's head is; without it a cluster of --workers begins here."""
    seeds: Annotated[int | None, Whole(1, 10_000)] = None
    """Number of training seeds, instead of the config's."""
    timesteps: Steps = None
    """Steps of each training, instead of the config's."""

    def run(self) -> None:
        """Do all work that is not finished, and judge every setting."""
        with ended_like_by_ctrl_c():
            self._run()

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
        team = Team(self.workers, self.backend, self.address)
        folders = Folders.chosen(self.results, self.work, self.quick)
        if not team.here:  # whoever works has another working directory
            folders = Folders(folders.results.absolute(), folders.work.absolute())
        writable_folder("results", folders.results)
        writable_folder("work", folders.work)
        by_name = {setting.name: setting for setting in suite.settings}
        chosen = [by_name[choice("envs", name, by_name)] for name in self.envs or by_name]
        for mode in self.modes:
            choice("modes", mode, suite.modes)
        modes = [mode for mode in suite.modes if not self.modes or mode in self.modes]
        for setting in chosen:
            setting_task(setting)
        with folders.alone():
            names = [f"{s.name}/*.json" for s in chosen] + [
                f"{FOLDER}/{s.name}.json" for s in chosen
            ]
            there = [path for name in names for path in folders.results.glob(name)]
            if there and not self.resume:
                raise ConfigurationError(
                    f"results = {str(folders.results)!r} holds {len(there)} finished pieces of "
                    "work: go on with --resume, or give another --results and --work"
                )
            for setting in chosen:
                compared = [class_of(setting, mode).name for mode in suite.modes]
                complete(suite, [setting], compared, folders.results, folders.work, team)
            work = jobs(suite, chosen, modes, folders.results)
            # All of the settings' pieces, for the verdict is over all of them.
            every = jobs(suite, chosen, suite.modes, folders.results)
            done = [job.place for job in every if finished(job, suite, folders)]
            side_by_side(
                [
                    Work(job.weight, run, (job, suite, folders))
                    for job in work
                    if job.place not in done
                ],
                team,
                "benchmark",
            )
            for setting in chosen:
                conclude(suite, setting, folders)
        report = f"{spelled('report')} --results {folders.results}"
        print(f"results in {folders.results}: {report}")


def conclude(suite: Suite, setting: Setting, folders: Folders) -> dict[str, Any] | None:
    """The verdict over whatever agents of a setting are finished, written as ``verdict.json``.

    Raises:
        ConfigurationError: results that are damaged or were made from other settings.
    """
    every = jobs(suite, [setting], suite.modes, folders.results)
    pieces = [job for job in every if finished(job, suite, folders)]
    reports = {job.name: read_json(folders.report(job), "results") for job in pieces}
    found = {
        job.name: load_results(folders.episodes(job), reports[job.name]["made_from"])
        for job in pieces
    }
    if "baselines" not in found:
        return None
    rules, known = found["baselines"], found.get("references", {})
    references = {"sensors": found.get("informed", {}) | known, "centre": known, "local": {}}
    always = float(rules["always"].rate.mean())
    classes = present(suite, setting, folders.results)
    verdict: dict[str, Any] = {"setting": setting.name, "title": setting.title, "modes": {}}
    for mode in suite.modes:
        done = [job.name for job in pieces if job.mode == mode]
        if not done:
            continue
        name = class_of(setting, mode).name
        envelope = {vertex["name"]: rules[vertex["name"]] for vertex in classes[name]["vertices"]}
        agents = [list(found[job].values()) for job in done]
        prices = reports[done[0]]["prices"]
        verdict["modes"][mode] = judge(
            agents, prices, envelope, references[mode], always, found.get("hindsight", {}),
            classes[name]["searches"],
        ) | {
            "class": name,
            "sha256": classes[name]["sha256"],
            "envelope": [point._asdict() for point in points_of(envelope)],
        }  # fmt: skip
    write(folders.results / setting.name / "verdict.json", verdict)
    return verdict


def main() -> None:
    """Entry point; exit status 130 after an interrupt."""
    start(Benchmark)


if __name__ == "__main__":
    main()
