"""The benchmark's pieces of work: what they are made from, where they go, which are finished."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from fusion_gym.core.task import Task
from fusion_gym.validation import ConfigurationError

from ..output.files import load_results, read_json
from ..output.folders import alone_in, check_inputs
from ..training.config import EnvironmentConfig, Experiment, TrainingConfig, ValidationConfig
from .classes import Class, classes_of, trained_classes
from .committed import Shelf, path_of
from .config import Setting, Suite
from .envelopes import Test, envelope_task

VALIDATIONS = 2  # of a training


class Job(NamedTuple):
    """One piece of work; ``weight`` is about how long it takes, in seconds on one core.

    ``envelopes`` are the classes of committed envelopes that it depends on, with their hashes.
    """

    setting: Setting
    kind: str
    of: Class | None = None
    seed: int = 0
    weight: float = 1.0
    envelopes: tuple[tuple[str, str], ...] = ()

    @property
    def name(self) -> str:
        """Name of its JSON, without the suffix."""
        return self.kind if self.of is None else f"agent_{self.of.name}_{self.seed}"

    @property
    def place(self) -> str:
        """Path of its files in the work folder, without the suffix."""
        return f"{self.setting.name}/{self.name}"


class Folders(NamedTuple):
    """``results`` holds tables for readers, ``work`` finished pieces, models and episodes."""

    results: Path
    work: Path

    @classmethod
    def create(cls, results: Path | None, work: Path | None, quick: bool) -> Folders:
        """The folders that a command line names, or those of the full or the quick benchmark."""
        return cls(
            results or Path("results/quick" if quick else "results"),
            work or Path("runs/benchmark/quick" if quick else "runs/benchmark/full"),
        )

    def report(self, job: Job) -> Path:
        """The JSON of a job."""
        return self.work / f"{job.place}.json"

    def episodes(self, job: Job) -> Path:
        """The episodes of a job."""
        return self.work / f"{job.place}.npz"

    def hold(self, job: Job) -> bool:
        """Whether results of a job are there."""
        return self.report(job).exists() and self.episodes(job).exists()

    @contextmanager
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


def jobs(
    suite: Suite, settings: Sequence[Setting], classes: Sequence[str], shelf: Shelf
) -> Iterator[Job]:
    """All work, what everything else needs first; agents of some classes, by name.

    Raises:
        ConfigurationError: a class that an agent would be compared with is not there.
    """
    required = {setting.name: trained_classes(suite, setting) for setting in settings}
    hashes = {setting.name: _hashes(shelf, setting, required[setting.name]) for setting in settings}
    for setting in settings:
        yield Job(setting, "baselines", weight=5.0, envelopes=tuple(hashes[setting.name].items()))
    for setting in settings:
        for kind in ("informed", "references"):
            if computed(setting, kind):
                yield Job(setting, kind, weight=60.0)
        if setting.hindsight:
            yield Job(setting, "hindsight", weight=0.6 * suite.hindsight_episodes)
    for seed in range(suite.training_seeds):
        for setting in settings:
            for of in required[setting.name]:
                if of.name in classes:
                    weight = 10.0 + suite.timesteps_of(setting, of.name, of.mode) / setting.pace
                    stored = ((of.name, hashes[setting.name][of.name]),)
                    yield Job(setting, "agent", of, seed, weight, stored)


def _hashes(shelf: Shelf, setting: Setting, classes: Sequence[Class]) -> dict[str, str]:
    """The hash of each class of agents, and of those without agents that are there as well."""
    there = shelf.classes(setting)
    for of in classes:
        if of.name not in there:
            path = str(path_of(shelf.results, setting.name))
            raise ConfigurationError(
                f"envelopes = {path!r} is not allowed: it has no class {of.name!r}"
            )
    names = {of.name for of in classes}
    return {c.name: there[c.name]["sha256"] for c in classes_of(setting) if c.name in names}


def rules_of(suite: Suite, setting: Setting, shelf: Shelf) -> list[Test]:
    """The rules of the envelopes that agents are compared with, to be run on the test episodes."""
    names = [of.name for of in trained_classes(suite, setting)]
    return [
        Test(setting, tuple(v["options"].items()), v["policy"], suite.episodes, suite.seed)
        for v in shelf.vertices(setting, names)
    ]


def computed(setting: Setting, kind: str) -> tuple[str, ...]:
    """The setting's references of a kind: "informed" or "references"."""
    return setting.informed if kind == "informed" else setting.references


def agent_options(setting: Setting, of: Class) -> dict[str, Any]:
    """The options of the environment in which an agent of a class decides."""
    return setting.environment.options | of.information | setting.agent_options


def agent_task(setting: Setting, of: Class) -> Task:
    """The task in which an agent of a class is tested: no price is drawn."""
    return envelope_task(setting, agent_options(setting, of).items())


def training_of(experiment: Experiment) -> dict[str, Any]:
    return experiment.model_dump(mode="json", exclude={"output"})


def job_inputs(job: Job, suite: Suite) -> dict[str, Any]:
    """All that the results of a job depend on."""
    setting = job.setting
    result: dict[str, Any] = {
        "environment": setting.environment.model_dump(mode="json"),
        "episodes": suite.episodes,
        "seed": suite.seed,
    }
    if job.kind == "baselines":
        genie = setting.genie and setting.genie.model_dump(mode="json")
        return result | {
            "envelopes": dict(job.envelopes),
            "points": list(setting.points),
            "genie": genie,
        }
    if job.kind in ("informed", "references"):
        return result | {job.kind: list(computed(setting, job.kind))}
    if job.kind == "hindsight":
        assert setting.hindsight is not None
        hindsight = setting.hindsight.model_dump(mode="json")
        return result | {"hindsight": hindsight | {"episodes": suite.hindsight_episodes}}
    assert job.of is not None
    experiment = experiment_of(suite, setting, job.of, job.seed, Path())
    tested = {"prices": suite.prices, "price_range": list(setting.price_range)}
    envelope = {"class": job.envelopes[0][0], "sha256": job.envelopes[0][1]}
    return result | {"training": training_of(experiment), "envelope": envelope} | tested


def job_finished(job: Job, suite: Suite, folders: Folders) -> bool:
    """Whether a job's results are there.

    Raises:
        ConfigurationError: they are damaged, or were made from other settings; says which.
    """
    path = folders.report(job)
    if not folders.hold(job):
        return False
    report = read_json(path, "work")
    check_inputs(job_inputs(job, suite), report.get("inputs"), repr(str(path)))
    load_results(folders.episodes(job), report.get("made_from", ""))
    return True


def experiment_of(suite: Suite, setting: Setting, of: Class, seed: int, work: Path) -> Experiment:
    """The training of one agent: the price drawn for each episode and seen."""
    options = agent_options(setting, of) | {
        "cost_weight": "random",
        "price_range": list(setting.price_range),
    }
    timesteps = suite.timesteps_of(setting, of.name, of.mode)
    own = setting.price_exponent
    return Experiment(
        environment=EnvironmentConfig(
            id=setting.environment.id, options=options, local=of.mode == "local"
        ),
        algorithm=suite.algorithm_of(setting, of.mode),
        training=TrainingConfig(
            timesteps=timesteps,
            num_envs=suite.num_envs_of(setting, of.name, of.mode),
            seed=seed,
            price_exponent=suite.price_exponent if own is None else own,
            error=setting.error or suite.error,
        ),
        validation=ValidationConfig(every=max(timesteps // VALIDATIONS, 1), episodes=512),
        output=str(work / setting.name / f"{of.name}_{seed}"),
    )
