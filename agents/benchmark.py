"""The benchmark of policies: tuned envelopes, learned fronts and references in every setting.

    fusion-gym benchmark [--envs NAME …] [--classes sensors_memory …] [--quick] [--resume]

Envelopes that are missing are tuned first, as ``fusion-gym envelope`` does; every agent keeps
the hash of the one that it is compared with. Every piece of work (one training seed of one agent,
say) writes its JSON into
the results folder as it is finished, and its episodes into the work folder; ``--resume`` skips
what is there, if it was made from the same inputs, and goes on with trainings in the work folder,
whose checkpoints hold pickles. ``fusion-gym report`` makes tables and figures of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from fusion_gym.validation import choice

from .command_line import SuiteCommand
from .input.options import Steps, Whole, writable_folder
from .output.ending import ended_like_by_ctrl_c
from .output.folders import refuse_earlier
from .output.progress import writing
from .output.tables import console
from .suite.agreement import agreement_table
from .suite.beside_rules import SHIPPED
from .suite.classes import names_of, trained_classes
from .suite.committed import FOLDER, Shelf, complete, missing_classes
from .suite.config import Setting, Suite, load_suite
from .suite.envelopes import envelope_task, run_test
from .suite.jobs import Folders, job_finished, jobs, rules_of
from .suite.team import BackendName, Team
from .suite.work import conclude, run_job
from .suite.workers import Work, side_by_side
from .training.checked import parse

USUAL = Path("results")  # of the full benchmark


@dataclass(frozen=True)
class Benchmark(SuiteCommand):
    """The benchmark of policies: tuned baselines, learned fronts and references."""

    backend: BackendName = "loky"
    """Who works: loky's processes of this machine, or a dask or ray cluster."""
    address: str | None = None
    """Where dask's scheduler or ray's head is; without it a cluster of this machine begins."""
    seeds: Annotated[int | None, Whole(1, 10_000)] = None
    """Number of training seeds, instead of the config's."""
    timesteps: Steps = None
    """Steps of each training, instead of the config's."""

    def run(self) -> None:
        """Do all work that is not finished, and judge every setting."""
        with ended_like_by_ctrl_c():
            self._run()

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
        folders = Folders.create(self.results, self.work, self.quick)
        if not team.here:  # whoever works has another working directory
            folders = Folders(folders.results.absolute(), folders.work.absolute())
        writable_folder("results", folders.results)
        writable_folder("work", folders.work)
        by_name = {setting.name: setting for setting in suite.settings}
        settings = [by_name[choice("envs", name, by_name)] for name in self.envs or by_name]
        for name in self.classes:
            choice("classes", name, names_of(suite))
        classes = self.classes or names_of(suite)
        for setting in settings:
            envelope_task(setting)
        files = [f"{item.name}/*.json" for item in settings]
        files += [f"{FOLDER}/{item.name}.json" for item in settings]
        there = [path for name in files for path in folders.results.glob(name)]
        refuse_earlier(folders.results, len(there), self.resume)
        shelf = self._shelf(suite, settings, folders)
        compared = [[of.name for of in trained_classes(suite, setting)] for setting in settings]
        for setting, names in zip(settings, compared, strict=True):
            missing_classes(shelf.suite, setting, names, shelf.results)
        if not team.here:
            with team.gathered():  # nobody is there, or a package is absent
                pass
        with folders.lock():
            writing(("finished pieces", folders.results), ("trainings and episodes", folders.work))
            for setting, names in zip(settings, compared, strict=True):
                complete(shelf.suite, [setting], names, shelf.results, folders.work, team)
            rules = [
                Work(4.0, run_test, (test, folders.work))
                for setting in settings
                for test in rules_of(suite, setting, shelf)
                if not test.path(folders.work).exists()
            ]
            side_by_side(rules, team, "rules")
            # All of the settings' pieces, for the verdict is over all of them.
            every = jobs(suite, settings, names_of(suite), shelf)
            done = [job.place for job in every if job_finished(job, suite, folders)]
            side_by_side(
                [
                    Work(job.weight, run_job, (job, suite, folders, shelf))
                    for job in jobs(suite, settings, classes, shelf)
                    if job.place not in done
                ],
                team,
                "benchmark",
            )
            judged = [Work(30.0, conclude, (suite, item, folders, shelf)) for item in settings]
            side_by_side(judged, team, "verdicts")
        if self.quick:
            beside = agreement_table(folders.results, USUAL, [setting.name for setting in settings])
            if beside is not None:
                console().print(beside)
        report = f"fusion-gym report --results {folders.results}"
        print(f"results in {folders.results}: {report}")

    def _shelf(self, suite: Suite, settings: Sequence[Setting], folders: Folders) -> Shelf:
        """The quick benchmark takes the envelopes that are shipped, if they are of this config."""
        shipped = Shelf(load_suite(self.config), SHIPPED)
        if self.quick and all(
            {of.name for of in trained_classes(suite, setting)} <= shipped.envelopes(setting).keys()
            for setting in settings
        ):
            return shipped
        return Shelf(suite, folders.results)
