"""The benchmark's pieces of work: tuned baselines, references, hindsight, one training each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fusion_gym.core.system import least_covering
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.evaluation.hindsight import run_hindsight
from fusion_gym.evaluation.metrics import robust_summary, summarise
from fusion_gym.policies.registry import make_policy

from ..output.files import save_results, write
from ..training.config import EnvironmentConfig, Experiment, TrainingConfig, ValidationConfig
from ..training.run import train
from .config import Mode, Setting, Suite
from .tuning import tune


@dataclass(frozen=True)
class Job:
    """One piece of work; ``weight`` is about how long it takes, in seconds on one core."""

    setting: Setting
    kind: str
    mode: Mode | None = None
    seed: int = 0
    weight: float = 1.0

    @property
    def name(self) -> str:
        """Name of its JSON, without the suffix."""
        return self.kind if self.mode is None else f"agent_{self.mode}_{self.seed}"


@dataclass(frozen=True)
class Folders:
    """``results`` holds JSON for readers, ``work`` models and episodes."""

    results: Path
    work: Path

    def report(self, job: Job) -> Path:
        """The JSON of a job."""
        return self.results / job.setting.name / f"{job.name}.json"

    def episodes(self, job: Job) -> Path:
        """The episodes of a job."""
        return self.work / job.setting.name / f"{job.name}.npz"


def jobs(suite: Suite, settings: list[Setting], modes: list[Mode]) -> Iterator[Job]:
    """All work, what everything else needs first."""
    for setting in settings:
        yield Job(setting, "baselines", weight=200.0)
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
                yield Job(setting, "agent", mode, seed, weight=30.0 + length / 40_000)


def computed(setting: Setting, kind: str) -> tuple[str, ...]:
    """The setting's references of a kind: "informed" or "references"."""
    return setting.informed if kind == "informed" else setting.references


def run(job: Job, suite: Suite, folders: Folders) -> float:
    """Do a job and write its results; returns its weight."""
    torch.set_num_threads(1)
    if job.kind == "baselines":
        _run_baselines(job, suite, folders)
    elif job.kind in ("informed", "references"):
        _run_references(job, suite, folders)
    elif job.kind == "hindsight":
        _run_hindsight(job, suite, folders)
    else:
        _run_agent(job, suite, folders)
    return job.weight


def setting_task(setting: Setting, mode: Mode = "sensors") -> Task:
    """The setting's task, with what a policy of this mode may know."""
    information = {"information": "centre"} if mode == "centre" else {}
    return make_task(setting.environment.id, **(setting.environment.options | information))


def _test(task: Task, policies: list[str], suite: Suite) -> dict[str, EpisodeResults]:
    return {
        name: run_episodes(task, make_policy(name, task), suite.episodes, suite.seed)
        for name in dict.fromkeys(policies)
    }


def _run_baselines(job: Job, suite: Suite, folders: Folders) -> None:
    """Tune every family, then test its curve, the single policies and the genie."""
    setting, task = job.setting, setting_task(job.setting)
    curves: dict[str, dict[str, Any]] = {}
    found: dict[str, EpisodeResults] = {}
    for family in suite.families_of(setting):
        policies = tune(task, family, suite.tuning)
        found |= _test(task, policies, suite)
        curves[family.label] = _curve(task, policies)
    curves |= {name: _curve(task, [name]) for name in setting.points}
    found |= _test(task, list(setting.points), suite)
    report: dict[str, Any] = {**_header(job, suite, task), "curves": curves}
    if setting.genie is not None:
        options = setting.environment.options | setting.genie.options
        free = make_task(setting.environment.id, **options)
        results = run_episodes(free, make_policy("always", free), suite.episodes, suite.seed)
        report["genie"] = _summary(results) | {"assumes": setting.genie.assumes}
    _keep(job, folders, found, report)


def _curve(task: Task, policies: list[str]) -> dict[str, Any]:
    """A baseline's policies, and who knows all that they look at."""
    knows = least_covering(make_policy(name, task).knowledge for name in policies)
    return {"knows": knows, "policies": policies}


def _run_references(job: Job, suite: Suite, folders: Folders) -> None:
    """Test policies that were computed."""
    task = setting_task(job.setting)
    found = _test(task, list(computed(job.setting, job.kind)), suite)
    _keep(job, folders, found, _header(job, suite, task))


def _run_hindsight(job: Job, suite: Suite, folders: Folders) -> None:
    """Search a clairvoyant's schedules for the first test episodes."""
    task, chosen = setting_task(job.setting), job.setting.hindsight
    assert chosen is not None
    episodes = min(suite.hindsight_episodes, suite.episodes)
    found = {
        f"hindsight at price {price:g}": run_hindsight(
            task, price, chosen.width, episodes, suite.seed
        )
        for price in chosen.prices
    }
    header = _header(job, suite, task) | {"episodes": episodes, "width": chosen.width}
    _keep(job, folders, found, header)


def _run_agent(job: Job, suite: Suite, folders: Folders) -> None:
    """Train one agent that sees the price, then test it at prices over the whole range."""
    setting, mode = job.setting, job.mode
    assert mode is not None
    experiment = experiment_of(suite, setting, mode, job.seed, folders.work)
    folder = Path(experiment.output)
    summary = train(experiment, resume=(folder / "config.yaml").exists(), quiet=True)
    if not summary["finished"]:
        raise KeyboardInterrupt
    task, model = setting_task(setting, mode), folder / "best_model.zip"
    prices = [float(price) for price in np.geomspace(*setting.price_range, suite.prices)]
    low, high = setting.price_range
    names = [f"model:{model},price={min(max(price, low), high)!r}" for price in prices]
    found = _test(task, names, suite)
    report = {
        **_header(job, suite, task),
        "mode": mode,
        "training_seed": job.seed,
        "training": experiment.model_dump(mode="json", exclude={"output"}),
        "seconds": summary["seconds"],
        "best_validation": summary["best_validation"],
        "prices": prices,
        "points": [_summary(found[name]) for name in names],
    }
    save_results(folders.episodes(job), found)
    write(folders.report(job), report)


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


def _keep(
    job: Job, folders: Folders, found: dict[str, EpisodeResults], report: dict[str, Any]
) -> None:
    """Write the episodes, then the report with a summary of every policy."""
    save_results(folders.episodes(job), found)
    policies = {name: _summary(results) for name, results in found.items()}
    write(folders.report(job), report | {"policies": policies})


def _header(job: Job, suite: Suite, task: Task) -> dict[str, Any]:
    return {
        "setting": job.setting.name,
        "title": job.setting.title,
        "env": job.setting.environment.id,
        "options": job.setting.environment.options,
        "episodes": suite.episodes,
        "seed": suite.seed,
        "horizon": task.horizon,
    }


def _summary(results: EpisodeResults) -> dict[str, Any]:
    found = summarise(results)
    kept = {key: found[key] for key in ("mse", "return", "rate", "denied", "tokens", "nees")}
    return kept | {"median": robust_summary(results)["median"]}
