"""The benchmark of policies: tuned envelopes, learned fronts and references in every setting.

    fusion-gym benchmark [--envs NAME …] [--classes sensors_memory …] [--quick] [--resume]

Envelopes that are missing are tuned first, as ``fusion-gym envelope`` does; every agent keeps
the hash of the one that it is compared with. Every piece of work (one training seed of one agent,
say) writes what it found and its episodes into the work folder as it is finished; ``--resume``
skips what is there, if it was made from the same inputs, and goes on with trainings there, whose
checkpoints hold pickles. The results folder gets a setting's tables once it is judged, and
``fusion-gym report`` makes a page and figures of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from fusion_gym.validation import choice

from .command_line import SuiteCommand
from .experiments.classes import names_of, trained_classes
from .experiments.config import Setting, Suite, load_suite
from .experiments.references import (
    SHIPPED,
    EnvelopeStore,
    complete_envelopes,
    envelope_task,
    missing_classes,
    run_test,
)
from .experiments.report import agreement_table
from .experiments.training import Folders, job_inputs, jobs, judge_setting, rules_of, run_job
from .experiments.workers import BackendName, Call, Pool, side_by_side
from .input.options import Steps, Whole, writable_folder
from .output.ending import ended_like_by_ctrl_c
from .output.folders import refuse_earlier
from .output.progress import writing
from .output.tables import console
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
        pool = Pool(self.workers, self.backend, self.address)
        folders = Folders.create(self.results, self.work, self.quick)
        if not pool.local:  # whoever works has another working directory
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
        for option, suffix in (("results", "csv"), ("work", "json")):
            folder: Path = getattr(folders, option)
            there = [path for item in settings for path in folder.glob(f"{item.name}/*.{suffix}")]
            refuse_earlier(option, folder, len(there), self.resume)
        store = self._store(suite, settings, folders)
        compared = [[of.name for of in trained_classes(suite, setting)] for setting in settings]
        for setting, names in zip(settings, compared, strict=True):
            missing_classes(store.suite, setting, names, store.results)
        if not pool.local:
            with pool.connect():  # nobody is there, or a package is absent
                pass
        with folders.lock():
            writing(("tables", folders.results), ("finished pieces and trainings", folders.work))
            for setting, names in zip(settings, compared, strict=True):
                complete_envelopes(store.suite, [setting], names, store.results, folders.work, pool)
            rules = [
                Call(4.0, run_test, (test, folders.work))
                for setting in settings
                for test in rules_of(suite, setting, store)
                if not test.path(folders.work).exists()
            ]
            side_by_side(rules, pool, "rules")
            # All of the settings' pieces, for the verdict is over all of them.
            every = jobs(suite, settings, names_of(suite), store)
            done = [
                job.place for job in every if folders.finished(job.place, job_inputs(job, suite))
            ]
            side_by_side(
                [
                    Call(job.weight, run_job, (job, suite, folders, store))
                    for job in jobs(suite, settings, classes, store)
                    if job.place not in done
                ],
                pool,
                "benchmark",
            )
            judged = [Call(30.0, judge_setting, (suite, item, folders, store)) for item in settings]
            side_by_side(judged, pool, "verdicts")
        if self.quick:
            beside = agreement_table(folders.results, USUAL, [setting.name for setting in settings])
            if beside is not None:
                console().print(beside)
        report = f"fusion-gym report --results {folders.results}"
        print(f"results in {folders.results}: {report}")

    def _store(self, suite: Suite, settings: Sequence[Setting], folders: Folders) -> EnvelopeStore:
        """The quick benchmark takes the envelopes that are shipped, if they are of this config."""
        shipped = EnvelopeStore(load_suite(self.config), SHIPPED)
        if self.quick and all(
            {of.name for of in trained_classes(suite, setting)} <= shipped.envelopes(setting).keys()
            for setting in settings
        ):
            return shipped
        return EnvelopeStore(suite, folders.results)
