"""The benchmark of policies: tuned baselines, learned fronts and references in every setting.

    python -m agents.benchmark [--envs NAME …] [--modes sensors …] [--quick] [--resume]

Every piece of work (a setting's baselines, one training seed of one agent) writes its JSON into
the results folder as it is finished, and its episodes into the work folder; ``--resume`` skips
what is there. ``python -m agents.report`` makes tables and figures of it.
"""

from __future__ import annotations

import argparse
import json
import shlex
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import torch
from tqdm import tqdm

from agents.arrays import load_results, save_results
from agents.config import EnvironmentConfig, Experiment, TrainingConfig, ValidationConfig
from agents.evaluate import write
from agents.suite import COMPARABLE, Mode, Setting, Suite, load_suite
from agents.train import train
from agents.tuning import tune
from agents.verdict import judge
from fusion_gym.envs import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation import (
    EpisodeResults,
    lower_envelope,
    make_policy,
    robust_summary,
    run_episodes,
    summarise,
)
from fusion_gym.validation import ConfigurationError, choice


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
        yield Job(setting, "baselines", weight=120.0)
    for setting in settings:
        if setting.references:
            yield Job(setting, "references", weight=30.0)
    for seed in range(suite.training_seeds):
        for mode in modes:
            for setting in settings:
                length = suite.timesteps * setting.longer
                yield Job(setting, "agent", mode, seed, weight=30.0 + length / 40_000)


def run(job: Job, suite: Suite, folders: Folders) -> float:
    """Do a job and write its results; returns its weight."""
    torch.set_num_threads(1)
    if job.kind == "baselines":
        _run_baselines(job, suite, folders)
    elif job.kind == "references":
        _run_references(job, suite, folders)
    else:
        _run_agent(job, suite, folders)
    return job.weight


def _task(setting: Setting, mode: Mode = "sensors") -> Task:
    information = {"information": "centre"} if mode == "centre" else {}
    return make_task(setting.environment.id, **(setting.environment.options | information))


def _test(task: Task, policies: list[str], suite: Suite) -> dict[str, EpisodeResults]:
    return {
        name: run_episodes(task, make_policy(name, task), suite.episodes, suite.seed)
        for name in dict.fromkeys(policies)
    }


def _run_baselines(job: Job, suite: Suite, folders: Folders) -> None:
    """Tune every family, then test its curve, the single policies and the informed references."""
    setting, task = job.setting, _task(job.setting)
    curves: dict[str, dict[str, Any]] = {}
    found: dict[str, EpisodeResults] = {}
    for family in suite.families_of(setting):
        policies = tune(task, family, suite.tuning)
        found |= _test(task, policies, suite)
        curves[family.label] = {"knows": family.knows, "policies": policies}
    for points, kind in ((setting.points, "clock"), (setting.informed, "informed")):
        for name in points:
            curves[name] = {"knows": kind, "policies": [name]}
        found |= _test(task, list(points), suite)
    report: dict[str, Any] = {
        **_header(job, suite, task),
        "curves": curves,
        "policies": {name: _summary(results) for name, results in found.items()},
    }
    if setting.genie is not None:
        options = setting.environment.options | setting.genie.options
        free = make_task(setting.environment.id, **options)
        results = run_episodes(free, make_policy("always", free), suite.episodes, suite.seed)
        report["genie"] = _summary(results) | {"assumes": setting.genie.assumes}
    save_results(folders.episodes(job), found)
    write(folders.report(job), report)


def _run_references(job: Job, suite: Suite, folders: Folders) -> None:
    """Test policies that were computed, and that know no more than the centre."""
    setting, task = job.setting, _task(job.setting)
    found = _test(task, list(setting.references), suite)
    save_results(folders.episodes(job), found)
    policies = {name: _summary(results) for name, results in found.items()}
    write(folders.report(job), {**_header(job, suite, task), "policies": policies})


def _run_agent(job: Job, suite: Suite, folders: Folders) -> None:
    """Train one agent that sees the price, then test it at prices over the whole range."""
    setting, mode = job.setting, job.mode
    assert mode is not None
    experiment = experiment_of(suite, setting, mode, job.seed, folders.work)
    folder = Path(experiment.output)
    summary = train(experiment, resume=(folder / "config.yaml").exists(), quiet=True)
    if not summary["finished"]:
        raise KeyboardInterrupt
    task, model = _task(setting, mode), folder / "best_model.zip"
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
    algorithm, runs = suite.algorithm_of(setting), suite.num_envs
    if mode == "local":
        # As many rows side by side as a coordinator has runs, and as many batches an update.
        sensors = _task(setting).sensors
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
            timesteps=timesteps, num_envs=runs, seed=seed, price_exponent=suite.price_exponent
        ),
        validation=ValidationConfig(every=max(timesteps // 8, 1), episodes=512),
        output=str(work / setting.name / f"{mode}_{seed}"),
    )


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


def conclude(suite: Suite, setting: Setting, folders: Folders) -> dict[str, Any] | None:
    """The verdict over whatever agents of a setting are finished, written as ``verdict.json``."""
    first = Job(setting, "baselines")
    if not folders.report(first).exists():
        return None
    report = json.loads(folders.report(first).read_text())
    every = load_results(folders.episodes(first))
    ahead = {
        name: every[name]
        for curve in report["curves"].values()
        if curve["knows"] == "informed"
        for name in curve["policies"]
    }
    second = Job(setting, "references")
    known = load_results(folders.episodes(second)) if folders.report(second).exists() else {}
    references = {"sensors": ahead | known, "centre": known, "local": {}}
    always = float(every["always"].rate.mean())
    verdict: dict[str, Any] = {"setting": setting.name, "title": setting.title, "modes": {}}
    for mode in suite.modes:
        done = [Job(setting, "agent", mode, seed) for seed in range(suite.training_seeds)]
        done = [job for job in done if folders.report(job).exists()]
        if not done:
            continue
        comparable = {
            name: every[name]
            for curve in report["curves"].values()
            if curve["knows"] in COMPARABLE[mode]
            for name in curve["policies"]
        }
        agents = [list(load_results(folders.episodes(job)).values()) for job in done]
        prices = json.loads(folders.report(done[0]).read_text())["prices"]
        verdict["modes"][mode] = judge(agents, prices, comparable, references[mode], always) | {
            "envelope": [point._asdict() for point in lower_envelope(comparable)]
        }
    write(folders.results / setting.name / "verdict.json", verdict)
    return verdict


def execute(suite: Suite, work: list[Job], folders: Folders, workers: int) -> None:
    """Run the jobs on several cores, with an estimate of the remaining time."""
    total = sum(job.weight for job in work)
    began = time.perf_counter()
    with tqdm(total=round(total), desc="benchmark", unit="s of work", smoothing=0.0) as bar:
        finished = joblib.Parallel(n_jobs=workers, return_as="generator_unordered")(
            joblib.delayed(run)(job, suite, folders) for job in work
        )
        for weight in finished:
            bar.update(min(weight, bar.total - bar.n))
    print(f"{len(work)} pieces of work in {time.perf_counter() - began:.0f} s")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = argparse.ArgumentParser(
        prog="python -m agents.benchmark",
        description="Tuned baselines, learned fronts and references in every setting.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    result.add_argument("--config", default="configs/benchmark.yaml")
    result.add_argument("--envs", nargs="+", metavar="NAME", help="settings, all by default")
    result.add_argument("--modes", nargs="+", help="sensors, centre, local; all by default")
    result.add_argument("--quick", action="store_true", help="less of everything, in minutes")
    result.add_argument("--resume", action="store_true", help="skip what is finished")
    result.add_argument("--results", type=Path, help="folder for JSON (results, or results/quick)")
    result.add_argument("--work", type=Path, help="folder for models and episodes")
    result.add_argument("--workers", type=int, default=2, help="processes side by side")
    result.add_argument("--seeds", type=int, help="training seeds, instead of the config's")
    result.add_argument("--timesteps", type=int, help="of each training, instead of the config's")
    return result


def main() -> None:
    """Entry point; exit status 130 after an interrupt."""
    given = parser().parse_args()
    # Ended from outside like by Ctrl-C: the workers stop too.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    kind = "quick" if given.quick else "full"
    folders = Folders(
        given.results or Path("results/quick" if given.quick else "results"),
        given.work or Path("runs/benchmark") / kind,
    )
    try:
        suite = load_suite(given.config, given.quick)
        changed = {"training_seeds": given.seeds, "timesteps": given.timesteps}
        changed = {key: value for key, value in changed.items() if value is not None}
        suite = Suite.model_validate(suite.model_dump() | changed)
        by_name = {setting.name: setting for setting in suite.settings}
        for name in given.envs or []:
            choice("envs", name, by_name)
        for mode in given.modes or []:
            choice("modes", mode, suite.modes)
        chosen = [by_name[name] for name in given.envs or by_name]
        work = list(jobs(suite, chosen, given.modes or list(suite.modes)))
        done = [
            job for job in work if folders.report(job).exists() and folders.episodes(job).exists()
        ]
        if done and not given.resume:
            raise ConfigurationError(
                f"results = {str(folders.results)!r} holds {len(done)} finished pieces of work: go "
                "on with --resume, or give another --results and --work"
            )
        for setting in chosen:
            _task(setting)
        execute(suite, [job for job in work if job not in done], folders, given.workers)
        for setting in chosen:
            conclude(suite, setting, folders)
        print(f"results in {folders.results}: python -m agents.report --results {folders.results}")
    except ConfigurationError as error:
        sys.exit(f"error: {error}")
    except ValueError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        command = shlex.join(["python", "-m", "agents.benchmark", *sys.argv[1:]])
        print(f"interrupted; go on with: {command} --resume", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
