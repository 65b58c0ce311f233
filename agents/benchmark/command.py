"""The benchmark, part by part: rules, agents, perturbed cases, and its pages.

    python -m agents.benchmark [--parts agents report] [--envs NAME …] [--quick] [--resume]

The part ``envelopes`` tunes the rules of each class of knowledge, chooses the vertices of their
lower envelope on tuning seeds, measures them on the test seeds, and commits them with a SHA-256.
``agents`` trains agents of every class and tests them beside these rules, which it tunes where they
are missing. ``robustness`` tests rules and agents where the truth is not what they assume.
``report`` writes pages and figures of all tables in the results folder.

Every finished piece of work stays in the work folder. ``--resume`` keeps those that were made from
the same inputs by the same code, and goes on with trainings there; both hold pickles.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from rich.markdown import Markdown

from agents.benchmark.classes import classes_of, names_of, trained_classes
from agents.benchmark.config import Setting, Suite, load_suite
from agents.benchmark.envelopes import SHIPPED, EnvelopeStore
from agents.benchmark.figures import write_report
from agents.benchmark.report import agreement_text
from agents.benchmark.robustness import RobustTrial, try_cases, usual_class
from agents.benchmark.training import SettingWork, run_benchmark
from agents.workers import BackendName, Folders, Pool
from fusion_gym.commands.command_line import Long
from fusion_gym.commands.options import OutputFolder, Steps, Whole, writable_folder
from fusion_gym.output.ending import ended_like_by_ctrl_c
from fusion_gym.output.progress import writing
from fusion_gym.output.tables import console
from fusion_gym.validation import ConfigurationError, choice, read_text

USUAL = Path("results")  # of the full benchmark
Part = Literal["envelopes", "agents", "robustness", "report"]


@dataclass(frozen=True)
class Benchmark(Long):
    """The benchmark of policies: rules, agents, perturbed cases, and its pages."""

    program = "python -m agents.benchmark"

    config: str = "benchmark"
    """The suite: a YAML file, or the name of a shipped config."""
    parts: tuple[Part, ...] = ("agents", "report")
    """What is done, in the order of the list."""
    envs: tuple[str, ...] = ()
    """Settings by name; none stands for all."""
    classes: tuple[str, ...] = ()
    """Classes by name, as local_packets; none stands for all, and in robustness for sensors_memory,
    or sensors in settings in which nothing is left to remember."""
    quick: bool = False
    """Less of everything, in minutes."""
    resume: bool = False
    """Keep what is finished, and go on; pieces and checkpoints of trainings hold pickles."""
    results: Annotated[Path | None, OutputFolder()] = None
    """Folder for tables, instead of results or results/quick."""
    work: Annotated[Path | None, OutputFolder()] = None
    """Folder for trainings and finished pieces, instead of runs/benchmark/full or quick."""
    workers: Annotated[int, Whole(1, 512)] = 2
    """Processes side by side."""
    backend: BackendName = "loky"
    """Who works: loky's processes of this machine, or a dask or ray cluster."""
    address: str | None = None
    """Where dask's scheduler or ray's head is; without it a cluster of this machine begins."""
    seeds: Annotated[int | None, Whole(1, 10_000)] = None
    """Number of training seeds, instead of the config's."""
    timesteps: Steps = None
    """Steps of each training, instead of the config's."""
    agents: tuple[str, ...] = ()
    """Files of agents for robustness, patterns with {setting} and {class}; none stands for agents
    of the work folder, and of the zoo."""
    trained: bool = False
    """Train agents over draws of the perturbations as well, for robustness."""
    pages: tuple[Path, ...] = ()
    """Other pages, as README.md, whose marked parts the report writes again."""

    def run(self) -> None:
        """Do the parts in their order."""
        with ended_like_by_ctrl_c():
            self._run()

    def _run(self) -> None:
        changed = {"training_seeds": self.seeds, "timesteps": self.timesteps}
        changed = {key: value for key, value in changed.items() if value is not None}
        suite = load_suite(self.config, self.quick, **changed)
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
        pages = {path: read_text("pages", path) for path in self.pages}
        if set(self.parts) - {"report"}:
            if not self.resume:
                self._refuse_earlier(settings, folders)
            self._work(suite, settings, folders, pool)
        if "report" in self.parts:
            write_report(folders.results, {item.name: item.title for item in suite.settings}, pages)
        print(f"results in {folders.results}")

    def _refuse_earlier(self, settings: Sequence[Setting], folders: Folders) -> None:
        """Refuse to begin where results of these parts, or pieces of work, are already.

        Raises:
            ConfigurationError: there are some.
        """
        last = {"envelopes": "classes", "agents": "verdict", "robustness": "robustness"}
        tables = [
            f"{item.name}/{last[part]}.csv"
            for part in set(self.parts) & last.keys()
            for item in settings
        ]
        there = [table for table in tables if (folders.results / table).exists()]
        pieces = list(folders.cache.folder.rglob("output.pkl"))
        for option, folder, count in (
            ("results", folders.results, len(there)),
            ("work", folders.work, len(pieces)),
        ):
            if count:
                raise ConfigurationError(
                    f"{option} = {str(folder)!r} holds {count} finished pieces of work: go on with "
                    "--resume, or give another --results and --work"
                )

    def _work(
        self, suite: Suite, settings: Sequence[Setting], folders: Folders, pool: Pool
    ) -> None:
        """Do all parts but the report, each checked before anything runs."""
        store = self._store(suite, settings, folders)
        tuned = [(item, store.missing(item, self._tuned(suite, item))) for item in settings]
        every = [SettingWork(suite, setting, store, folders) for setting in settings]
        trials = self._trials(suite, settings, store, folders)
        for trial in trials:
            trial.check()
            if self.agents or "agents" not in self.parts:
                trial.check_agents()
        coming = {(setting.name, of.name) for setting, classes in tuned for of in classes}
        for trial in trials:
            if (trial.setting.name, trial.of.name) not in coming:
                store.envelope(trial.setting, trial.of.name)
        if not pool.local:
            with pool.connect():  # nobody is there, or a package is absent
                pass
        with folders.lock():
            writing(("tables", folders.results), ("finished pieces and trainings", folders.work))
            for setting, missing in tuned:
                if missing:
                    store.complete(setting, missing, folders.cache, pool)
            if "agents" in self.parts:
                run_benchmark(every, self.classes or names_of(suite), pool)
            if trials:
                try_cases(trials, pool)
        if self.quick and "agents" in self.parts:
            text = agreement_text(folders.results, USUAL, [setting.name for setting in settings])
            console().print(Markdown(text))

    def _tuned(self, suite: Suite, setting: Setting) -> list[str]:
        """Return the classes whose rules the parts tune where they are missing."""
        every = [of.name for of in classes_of(setting)]
        compared = [of.name for of in trained_classes(suite, setting)]
        result = list(self.classes or every) if "envelopes" in self.parts else []
        return result + (compared if "agents" in self.parts else [])

    def _trials(
        self, suite: Suite, settings: Sequence[Setting], store: EnvelopeStore, folders: Folders
    ) -> list[RobustTrial]:
        """Return what is tried under perturbed cases."""
        trials, seeds = [], suite.training_seeds if self.trained else 0
        for setting in settings if "robustness" in self.parts else ():
            classes = {of.name: of for of in classes_of(setting)}
            for name in self.classes or (usual_class(suite, setting),):
                of = classes[choice("classes", name, classes)]
                trials.append(RobustTrial(suite, setting, of, store, self.agents, seeds, folders))
        return trials

    def _store(self, suite: Suite, settings: Sequence[Setting], folders: Folders) -> EnvelopeStore:
        """The quick benchmark takes the envelopes that are shipped, if they are of this config."""
        shipped = EnvelopeStore(load_suite(self.config), SHIPPED)
        if self.quick and "envelopes" not in self.parts:
            try:
                if all(
                    shipped.classes(item) and not shipped.missing(item, self._tuned(suite, item))
                    for item in settings
                ):
                    return shipped
            except ConfigurationError:  # of another suite
                pass
        return EnvelopeStore(suite, folders.results)
