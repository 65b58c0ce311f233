"""The benchmark's pieces of work: the tests of rules and references, and one training each."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

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
from ..output.folders import alone_in, check_inputs, fingerprint
from ..training.config import EnvironmentConfig, Experiment, TrainingConfig, ValidationConfig
from ..training.run import holds_training, train
from .classes import Class, classes_of, names_of, trained_classes
from .config import Setting, Suite, front_prices
from .references import EnvelopeStore, Test, envelope_task, run_test
from .tables import VERDICT, write_rows
from .verdict import ClassTests, at_rates, judge, worths

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

    def finished(self, place: str, inputs: Mapping[str, Any]) -> bool:
        """Return whether the results of a piece of work are there.

        Raises:
            ConfigurationError: they are damaged, or were made from other inputs; says which.
        """
        report = self.work / f"{place}.json"
        if not (report.exists() and report.with_suffix(".npz").exists()):
            return False
        check_inputs(inputs, read_json(report, "work").get("inputs"), repr(str(report)))
        self.read(place)
        return True

    def read(self, place: str) -> tuple[dict[str, Any], dict[str, EpisodeResults]]:
        """Return the report of a finished piece of work, and its episodes by policy.

        Raises:
            ConfigurationError: they are damaged.
        """
        report = read_json(self.work / f"{place}.json", "work")
        return report, load_results(self.work / f"{place}.npz", report.get("made_from", ""))

    def write(
        self, place: str, report: Mapping[str, Any], episodes: Mapping[str, EpisodeResults]
    ) -> None:
        """Write the episodes of a piece of work, then its report."""
        save_results(self.work / f"{place}.npz", episodes, report["made_from"])
        write(self.work / f"{place}.json", report)

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
    suite: Suite, settings: Sequence[Setting], classes: Sequence[str], store: EnvelopeStore
) -> Iterator[Job]:
    """All work, what everything else needs first; agents of some classes, by name.

    Raises:
        ConfigurationError: a class that an agent would be compared with is not there.
    """
    required = {setting.name: trained_classes(suite, setting) for setting in settings}
    hashes = {setting.name: _hashes(store, setting, required[setting.name]) for setting in settings}
    for setting in settings:
        yield Job(setting, "baselines", weight=5.0, envelopes=tuple(hashes[setting.name].items()))
    for setting in settings:
        for kind in ("informed", "references"):
            if policies_of(setting, kind):
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


def _hashes(store: EnvelopeStore, setting: Setting, classes: Sequence[Class]) -> dict[str, str]:
    """The hash of each class of agents, and of those without agents that are there as well."""
    names = {of.name for of in classes}
    return {
        of.name: store.envelope(setting, of.name)["sha256"]
        for of in classes_of(setting)
        if of.name in names
    }


def rules_of(suite: Suite, setting: Setting, store: EnvelopeStore) -> list[Test]:
    """The rules of the envelopes that agents are compared with, to be run on the test episodes."""
    names = [of.name for of in trained_classes(suite, setting)]
    return [
        Test(setting, tuple(v["options"].items()), v["policy"], suite.episodes, suite.seed)
        for v in store.vertices(setting, names)
    ]


def policies_of(setting: Setting, kind: str) -> tuple[str, ...]:
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
        return result | {job.kind: list(policies_of(setting, job.kind))}
    if job.kind == "hindsight":
        assert setting.hindsight is not None
        hindsight = setting.hindsight.model_dump(mode="json")
        return result | {"hindsight": hindsight | {"episodes": suite.hindsight_episodes}}
    assert job.of is not None
    experiment = experiment_of(suite, setting, job.of, job.seed, Path())
    tested = {"prices": suite.prices, "price_range": list(setting.price_range)}
    envelope = {"class": job.envelopes[0][0], "sha256": job.envelopes[0][1]}
    return result | {"training": training_of(experiment), "envelope": envelope} | tested


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


def run_job(job: Job, suite: Suite, folders: Folders, store: EnvelopeStore) -> None:
    """Do a job and write its results."""
    torch.set_num_threads(1)
    if job.kind == "baselines":
        _run_baselines(job, suite, folders, store)
    elif job.kind in ("informed", "references"):
        _run_references(job, suite, folders)
    elif job.kind == "hindsight":
        _run_hindsight(job, suite, folders)
    else:
        _run_agent(job, suite, folders)


def judge_setting(
    suite: Suite, setting: Setting, folders: Folders, store: EnvelopeStore
) -> dict[str, Any] | None:
    """The verdict over whatever agents of a setting are finished, written as tables.

    Raises:
        ConfigurationError: results that are damaged or were made from other settings.
    """
    every = jobs(suite, [setting], names_of(suite), store)
    pieces = [job for job in every if folders.finished(job.place, job_inputs(job, suite))]
    read = {job.name: folders.read(job.place) for job in pieces}
    reports = {name: report for name, (report, _) in read.items()}
    result = {name: episodes for name, (_, episodes) in read.items()}
    if "baselines" not in result:
        return None
    rules, known = result["baselines"], result.get("references", {})
    references = {"sensors": result.get("informed", {}) | known, "centre": known, "local": {}}
    always = float(rules["always"].rate.mean())
    committed, tested, classes = store.classes(setting), {}, {}
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
        "envelope": [{"class": name} | p for name, of in classes.items() for p in of["envelope"]],
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


def _run_baselines(job: Job, suite: Suite, folders: Folders, store: EnvelopeStore) -> None:
    """Gather the tested rules of the committed envelopes, test the single policies and the genie.

    Raises:
        ConfigurationError: a rule does other than its envelope says.
    """
    setting = job.setting
    curves: dict[str, dict[str, Any]] = {}
    result: dict[str, EpisodeResults] = {}
    vertices = store.vertices(setting, [name for name, _ in job.envelopes])
    for vertex, test in zip(vertices, rules_of(suite, setting, store), strict=True):
        if not test.path(folders.work).exists():
            run_test(test, folders.work)
        results = test.read(folders.work)
        if suite.episodes == store.suite.episodes and suite.seed == store.suite.seed:
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
    result = _test(task, list(policies_of(job.setting, job.kind)), suite)
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
    folders.write(job.place, report, result)


def _keep(
    job: Job, folders: Folders, content: dict[str, EpisodeResults], report: dict[str, Any]
) -> None:
    """Write the episodes, then the report with a summary of every policy."""
    policies = {name: _summary(results) for name, results in content.items()}
    folders.write(job.place, report | {"policies": policies}, content)


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
