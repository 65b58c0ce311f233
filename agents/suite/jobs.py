"""The benchmark's pieces of work: what they are made from, where they go, which are finished."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.validation import ConfigurationError

from ..output.files import load_results, read_json
from ..output.folders import alone_in, check_inputs
from ..training.config import EnvironmentConfig, Experiment, TrainingConfig, ValidationConfig
from .classes import class_of
from .committed import path_of, present
from .config import Mode, Setting, Suite


@dataclass(frozen=True)
class Job:
    """One piece of work; ``weight`` is about how long it takes, in seconds on one core.

    ``envelopes`` are the classes of committed envelopes that it depends on, with their hashes.
    """

    setting: Setting
    kind: str
    mode: Mode | None = None
    seed: int = 0
    weight: float = 1.0
    envelopes: tuple[tuple[str, str], ...] = ()

    @property
    def name(self) -> str:
        """Name of its JSON, without the suffix."""
        return self.kind if self.mode is None else f"agent_{self.mode}_{self.seed}"

    @property
    def place(self) -> str:
        """Path of its files in the folders, without the suffix."""
        return f"{self.setting.name}/{self.name}"


@dataclass(frozen=True)
class Folders:
    """``results`` holds JSON for readers, ``work`` models and episodes."""

    results: Path
    work: Path

    @classmethod
    def chosen(cls, results: Path | None, work: Path | None, quick: bool) -> Folders:
        """The folders that a command line names, or those of the full or the quick benchmark."""
        return cls(
            results or Path("results/quick" if quick else "results"),
            work or Path("runs/benchmark/quick" if quick else "runs/benchmark/full"),
        )

    def report(self, job: Job) -> Path:
        """The JSON of a job."""
        return self.results / f"{job.place}.json"

    def episodes(self, job: Job) -> Path:
        """The episodes of a job."""
        return self.work / f"{job.place}.npz"

    def hold(self, job: Job) -> bool:
        """Whether results of a job are there."""
        return self.report(job).exists() and self.episodes(job).exists()

    @contextmanager
    def alone(self) -> Iterator[None]:
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
    suite: Suite, settings: Sequence[Setting], modes: Sequence[Mode], results: Path
) -> Iterator[Job]:
    """All work, what everything else needs first; the settings' envelopes are there.

    Raises:
        ConfigurationError: a class that an agent would be compared with is not there.
    """
    hashes = {setting.name: _hashes(suite, setting, results) for setting in settings}
    for setting in settings:
        kept = tuple(hashes[setting.name].values())
        yield Job(setting, "baselines", weight=60.0, envelopes=kept)
    for setting in settings:
        for kind in ("informed", "references"):
            if computed(setting, kind):
                yield Job(setting, kind, weight=60.0)
        if setting.hindsight:
            yield Job(setting, "hindsight", weight=0.6 * suite.hindsight_episodes)
    for seed in range(suite.training_seeds):
        for mode in modes:
            for setting in settings:
                length = suite.timesteps * setting.longer
                weight = 30.0 + length / 40_000
                kept = (hashes[setting.name][mode],)
                yield Job(setting, "agent", mode, seed, weight, kept)


def _hashes(suite: Suite, setting: Setting, results: Path) -> dict[Mode, tuple[str, str]]:
    """The class of each mode's agents, with its hash."""
    there = present(suite, setting, results)
    names = {mode: class_of(setting, mode).name for mode in suite.modes}
    for name in names.values():
        if name not in there:
            path = str(path_of(results, setting.name))
            raise ConfigurationError(
                f"envelopes = {path!r} is not allowed: it has no class {name!r}"
            )
    return {mode: (name, there[name]["sha256"]) for mode, name in names.items()}


def computed(setting: Setting, kind: str) -> tuple[str, ...]:
    """The setting's references of a kind: "informed" or "references"."""
    return setting.informed if kind == "informed" else setting.references


def setting_task(setting: Setting, mode: Mode = "sensors") -> Task:
    """The setting's task, with what a policy of this mode may know."""
    information = {"information": "centre"} if mode == "centre" else {}
    return make_task(setting.environment.id, **(setting.environment.options | information))


def training_of(experiment: Experiment) -> dict[str, Any]:
    return experiment.model_dump(mode="json", exclude={"output"})


def inputs_of(job: Job, suite: Suite) -> dict[str, Any]:
    """All that the results of a job depend on."""
    setting = job.setting
    found: dict[str, Any] = {
        "environment": setting.environment.model_dump(mode="json"),
        "episodes": suite.episodes,
        "seed": suite.seed,
    }
    if job.kind == "baselines":
        genie = setting.genie and setting.genie.model_dump(mode="json")
        return found | {
            "envelopes": dict(job.envelopes),
            "points": list(setting.points),
            "genie": genie,
        }
    if job.kind in ("informed", "references"):
        return found | {job.kind: list(computed(setting, job.kind))}
    if job.kind == "hindsight":
        assert setting.hindsight is not None
        chosen = setting.hindsight.model_dump(mode="json")
        return found | {"hindsight": chosen | {"episodes": suite.hindsight_episodes}}
    assert job.mode is not None
    experiment = experiment_of(suite, setting, job.mode, job.seed, Path())
    tested = {"prices": suite.prices, "price_range": list(setting.price_range)}
    envelope = {"class": job.envelopes[0][0], "sha256": job.envelopes[0][1]}
    return found | {"training": training_of(experiment), "envelope": envelope} | tested


def finished(job: Job, suite: Suite, folders: Folders) -> bool:
    """Whether a job's results are there.

    Raises:
        ConfigurationError: they are damaged, or were made from other settings; says which.
    """
    path = folders.report(job)
    if not folders.hold(job):
        return False
    report = read_json(path, "results")
    check_inputs(inputs_of(job, suite), report.get("inputs"), repr(str(path)))
    load_results(folders.episodes(job), report.get("made_from", ""))
    return True


def experiment_of(suite: Suite, setting: Setting, mode: Mode, seed: int, work: Path) -> Experiment:
    """The training of one agent: the price drawn for each episode and seen."""
    options = setting.environment.options | {
        "cost_weight": "random",
        "price_range": list(setting.price_range),
    }
    if mode == "centre":
        options["information"] = "centre"
    timesteps = round(suite.timesteps * setting.longer)
    own = setting.price_exponent
    exponent = suite.price_exponent if own is None else own
    algorithm, runs = suite.algorithm_of(setting), suite.num_envs
    if mode == "local":
        # As many rows side by side as a coordinator has runs, and as many batches an update.
        sensors = setting_task(setting).sensors
        runs = max(suite.num_envs // sensors, 1)
        size = getattr(algorithm, "batch_size", None)
        if size is not None:
            batch = max(size * runs * sensors // suite.num_envs, 1)
            algorithm = algorithm.model_copy(update={"batch_size": batch})
    return Experiment(
        environment=EnvironmentConfig(
            id=setting.environment.id, options=options, local=mode == "local"
        ),
        algorithm=algorithm,
        training=TrainingConfig(
            timesteps=timesteps, num_envs=runs, seed=seed, price_exponent=exponent
        ),
        validation=ValidationConfig(every=max(timesteps // 8, 1), episodes=512),
        output=str(work / setting.name / f"{mode}_{seed}"),
    )
