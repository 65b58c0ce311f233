"""The benchmark's work: the envelopes' rules, references, hindsight, and one training each."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fusion_gym.core.system import least_covering
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.envelope import points_of
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.evaluation.hindsight import run_hindsight
from fusion_gym.evaluation.metrics import robust_summary, summarise
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

from ..output.files import load_results, read_json, save_results, write
from ..output.folders import fingerprint
from ..training.run import holds_training, train
from .classes import names_of, trained_classes
from .committed import Shelf
from .config import Setting, Suite
from .envelopes import envelope_task, run_test
from .fronts import front_prices
from .jobs import (
    Folders,
    Job,
    agent_task,
    computed,
    experiment_of,
    job_finished,
    job_inputs,
    jobs,
    rules_of,
    training_of,
)
from .tables import VERDICT, write_rows
from .verdict import judge
from .worth import ClassTests, at_rates, worths


def run_job(job: Job, suite: Suite, folders: Folders, shelf: Shelf) -> None:
    """Do a job and write its results."""
    torch.set_num_threads(1)
    if job.kind == "baselines":
        _run_baselines(job, suite, folders, shelf)
    elif job.kind in ("informed", "references"):
        _run_references(job, suite, folders)
    elif job.kind == "hindsight":
        _run_hindsight(job, suite, folders)
    else:
        _run_agent(job, suite, folders)


def conclude(
    suite: Suite, setting: Setting, folders: Folders, shelf: Shelf
) -> dict[str, Any] | None:
    """The verdict over whatever agents of a setting are finished, written as tables.

    Raises:
        ConfigurationError: results that are damaged or were made from other settings.
    """
    every = jobs(suite, [setting], names_of(suite), shelf)
    pieces = [job for job in every if job_finished(job, suite, folders)]
    reports = {job.name: read_json(folders.report(job), "work") for job in pieces}
    result = {
        job.name: load_results(folders.episodes(job), reports[job.name]["made_from"])
        for job in pieces
    }
    if "baselines" not in result:
        return None
    rules, known = result["baselines"], result.get("references", {})
    references = {"sensors": result.get("informed", {}) | known, "centre": known, "local": {}}
    always = float(rules["always"].rate.mean())
    committed, tested, classes = shelf.classes(setting), {}, {}
    for of in trained_classes(suite, setting):
        own = committed[of.name]
        envelope = {vertex["name"]: rules[vertex["name"]] for vertex in own["vertices"]}
        done = [job.name for job in pieces if job.of == of]
        agents = [list(result[job].values()) for job in done]
        tested[of.name] = ClassTests(of, envelope, agents, own["searches"])
        if done:
            prices = reports[done[0]]["prices"]
            clairvoyant = result.get("hindsight", {}) if of.packet == "measurement" else {}
            ahead = references[of.mode] if of.packet == "measurement" else {}
            classes[of.name] = {
                **judge(agents, prices, envelope, ahead, always, clairvoyant, own["searches"]),
                "at": at_rates(tested[of.name], always),
                "mode": of.mode,
                "memory": of.memory,
                "broadcast": of.broadcast,
                "packet": of.packet,
                "knows": of.knows,
                "sha256": own["sha256"],
                "envelope": [point._asdict() for point in points_of(envelope)],
            }
    verdict = {
        "setting": setting.name,
        "title": setting.title,
        "always": always,
        "classes": classes,
        "worth": worths(tested, always),
    }
    baselines = reports["baselines"]
    verdict |= {key: baselines[key] for key in ("env", "episodes", "seed")}
    write_verdict(folders.results / setting.name, verdict, reports)
    return verdict


def write_verdict(
    folder: Path, verdict: Mapping[str, Any], reports: Mapping[str, Mapping[str, Any]]
) -> None:
    """Write the tables of a setting: its pieces of work by name, and its verdict at the end."""
    policies: list[dict[str, Any]] = []
    for run, report in reports.items():
        families: dict[str, dict[str, Any]] = {
            name: {"family": family, "knows": curve["knows"]}
            for family, curve in report.get("curves", {}).items()
            for name in curve["policies"]
        }
        for name, policy in report.get("policies", {}).items():
            policies.append({"run": run, "name": name, **families.get(name, {}), **policy})
        for price, policy in zip(report.get("prices", []), report.get("points", []), strict=True):
            policies.append({"run": run, "name": f"price={price!r}", "price": price, **policy})
        if "genie" in report:
            genie = report["genie"]
            policies.append({"run": "genie", "name": genie["assumes"], **genie})
    classes: dict[str, Any] = verdict["classes"]
    tables: dict[str, list[dict[str, Any]]] = {
        "runs": [{"run": run, **report} for run, report in reports.items()],
        "policies": policies,
        "points": [{"class": name} | p for name, of in classes.items() for p in of["points"]],
        "equal_rates": [{"class": name} | p for name, of in classes.items() for p in of["at"]],
        "tested": [{"class": name} | p for name, of in classes.items() for p in of["envelope"]],
        "fronts": [{"class": name} | of for name, of in classes.items()],
        "worth": verdict["worth"],
        VERDICT: [dict(verdict)],
    }
    for table, rows in tables.items():
        write_rows(folder, table, rows)


def _test(task: Task, policies: list[str], suite: Suite) -> dict[str, EpisodeResults]:
    return {
        name: run_episodes(task, make_policy(name, task), suite.episodes, suite.seed)
        for name in dict.fromkeys(policies)
    }


def _run_baselines(job: Job, suite: Suite, folders: Folders, shelf: Shelf) -> None:
    """Gather the tested rules of the committed envelopes, test the single policies and the genie.

    Raises:
        ConfigurationError: a rule does other than its envelope says.
    """
    setting = job.setting
    curves: dict[str, dict[str, Any]] = {}
    result: dict[str, EpisodeResults] = {}
    vertices = shelf.vertices(setting, [name for name, _ in job.envelopes])
    for vertex, test in zip(vertices, rules_of(suite, setting, shelf), strict=True):
        if not test.path(folders.work).exists():
            run_test(test, folders.work)
        results = test.read(folders.work)
        if suite.episodes == shelf.suite.episodes and suite.seed == shelf.suite.seed:
            check_vertex(vertex, results)
        policy = make_policy(vertex["policy"], envelope_task(setting, vertex["options"].items()))
        result[vertex["name"]] = results
        curve = curves.setdefault(vertex["family"], {"knows": [], "policies": []})
        curve["knows"].append(policy.knowledge)
        curve["policies"].append(vertex["name"])
    task = envelope_task(setting)
    for name in setting.points:
        result |= _test(task, [name], suite)
        knows = [make_policy(name, task).knowledge]
        curves[name] = {"knows": knows, "policies": [name]}
    for curve in curves.values():
        curve["knows"] = least_covering(curve["knows"])
        curve["policies"].sort(key=lambda name: float(result[name].rate.mean()))
    report: dict[str, Any] = {**_header(job, suite, task), "curves": curves}
    if setting.genie is not None:
        options = setting.environment.options | setting.genie.options
        free = make_task(setting.environment.id, **options)
        results = run_episodes(free, make_policy("always", free), suite.episodes, suite.seed)
        report["genie"] = _summary(results) | {"assumes": setting.genie.assumes}
    _keep(job, folders, result, report)


def check_vertex(vertex: dict[str, Any], results: EpisodeResults) -> None:
    """Whether a rule does on the test seeds what its envelope says."""
    claim, does = vertex["test"]["mse"]["mean"], float(results.mse.mean())
    if not np.isclose(claim, does, rtol=1e-6):
        raise ConfigurationError(
            f"envelopes: {vertex['name']!r} has an error of {does:.6g} on the test seeds, and not "
            f"{claim:.6g} as its envelope says: tune it again"
        )


def _run_references(job: Job, suite: Suite, folders: Folders) -> None:
    """Test policies that were computed."""
    task = envelope_task(job.setting)
    result = _test(task, list(computed(job.setting, job.kind)), suite)
    _keep(job, folders, result, _header(job, suite, task))


def _run_hindsight(job: Job, suite: Suite, folders: Folders) -> None:
    """Search a clairvoyant's schedules for the first test episodes."""
    task, hindsight = envelope_task(job.setting), job.setting.hindsight
    assert hindsight is not None
    episodes = min(suite.hindsight_episodes, suite.episodes)
    result = {
        f"hindsight at price {price:g}": run_hindsight(
            task, price, hindsight.width, episodes, suite.seed
        )
        for price in hindsight.prices
    }
    header = _header(job, suite, task) | {"episodes": episodes, "width": hindsight.width}
    _keep(job, folders, result, header)


def _run_agent(job: Job, suite: Suite, folders: Folders) -> None:
    """Train one agent that sees the price, then test it at prices over the whole range."""
    setting, of = job.setting, job.of
    assert of is not None
    experiment = experiment_of(suite, setting, of, job.seed, folders.work)
    folder = Path(experiment.output)
    summary = train(experiment, resume=holds_training(folder), quiet=True)
    if not summary["finished"]:
        raise KeyboardInterrupt
    task, model = agent_task(setting, of), folder / "best_model.zip"
    prices = front_prices(setting.price_range, suite.prices)
    names = [f"model:{model},price={price!r}" for price in prices]
    result = _test(task, names, suite)
    report = {
        **_header(job, suite, task),
        "mode": of.mode,
        "class": of.name,
        "class_options": of.information | setting.agent_options,
        "training_seed": job.seed,
        "training": training_of(experiment),
        "seconds": summary["seconds"],
        "best_validation": summary["best_validation"],
        "prices": prices,
        "points": [_summary(result[name]) for name in names],
    }
    save_results(folders.episodes(job), result, report["made_from"])
    write(folders.report(job), report)


def _keep(
    job: Job, folders: Folders, content: dict[str, EpisodeResults], report: dict[str, Any]
) -> None:
    """Write the episodes, then the report with a summary of every policy."""
    save_results(folders.episodes(job), content, report["made_from"])
    policies = {name: _summary(results) for name, results in content.items()}
    write(folders.report(job), report | {"policies": policies})


def _header(job: Job, suite: Suite, task: Task) -> dict[str, Any]:
    inputs = job_inputs(job, suite)
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
    summary = summarise(results)
    stored = {key: summary[key] for key in ("mse", "return", "rate", "denied", "tokens", "nees")}
    return stored | {"median": robust_summary(results)["median"]}
