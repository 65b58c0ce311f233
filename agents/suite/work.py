"""The benchmark's work: tuned baselines, references, hindsight, and one training each."""

from __future__ import annotations

import os
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
from ..output.folders import fingerprint
from ..training.run import holds_training, train
from .config import Suite
from .jobs import Folders, Job, computed, experiment_of, inputs_of, setting_task, training_of
from .tuning import tune
from .workers import end_with


def run(job: Job, suite: Suite, folders: Folders, parent: int) -> float:
    """Do a job and write its results; returns its weight.

    A worker ends with its ``parent``, the process that gave it the job.
    """
    if os.getpid() != parent:
        end_with(parent)
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
    summary = train(experiment, resume=holds_training(folder), quiet=True)
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
        "training": training_of(experiment),
        "seconds": summary["seconds"],
        "best_validation": summary["best_validation"],
        "prices": prices,
        "points": [_summary(found[name]) for name in names],
    }
    save_results(folders.episodes(job), found, report["made_from"])
    write(folders.report(job), report)


def _keep(
    job: Job, folders: Folders, found: dict[str, EpisodeResults], report: dict[str, Any]
) -> None:
    """Write the episodes, then the report with a summary of every policy."""
    save_results(folders.episodes(job), found, report["made_from"])
    policies = {name: _summary(results) for name, results in found.items()}
    write(folders.report(job), report | {"policies": policies})


def _header(job: Job, suite: Suite, task: Task) -> dict[str, Any]:
    inputs = inputs_of(job, suite)
    return {
        "setting": job.setting.name,
        "title": job.setting.title,
        "env": job.setting.environment.id,
        "options": job.setting.environment.options,
        "episodes": suite.episodes,
        "seed": suite.seed,
        "horizon": task.horizon,
        "made_from": fingerprint(inputs),
        "inputs": inputs,
    }


def _summary(results: EpisodeResults) -> dict[str, Any]:
    found = summarise(results)
    kept = {key: found[key] for key in ("mse", "return", "rate", "denied", "tokens", "nees")}
    return kept | {"median": robust_summary(results)["median"]}
