"""The benchmark of a setting: its tests, one training for each agent, and the verdict over them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import torch

from agents.benchmark.classes import Class, trained_classes
from agents.benchmark.config import Setting, Suite, front_prices
from agents.benchmark.envelopes import (
    EnvelopeStore,
    Test,
    check_vertex,
    envelope_task,
    read_tests,
    rule_tests,
    run_test,
    tested_inputs,
)
from agents.benchmark.tables import VERDICT, Row, write_rows
from agents.benchmark.verdict import ClassTests, at_rates, judge, worths
from agents.workers import (
    Call,
    Folders,
    Pool,
    check_training,
    missing,
    run_training,
    side_by_side,
    training_of,
)
from fusion_gym.core.system import least_covering
from fusion_gym.core.task import Task
from fusion_gym.evaluation.envelope import points_of
from fusion_gym.evaluation.episodes import EpisodeResults
from fusion_gym.evaluation.hindsight import run_hindsight
from fusion_gym.evaluation.metrics import robust_summary, summarise
from fusion_gym.output.folders import fingerprint
from fusion_gym.policies.registry import make_policy
from fusion_gym.training.config import (
    EnvironmentConfig,
    Experiment,
    TrainingConfig,
    ValidationConfig,
)

VALIDATIONS = 2  # of a training
_CLASS = ("mode", "memory", "broadcast", "packet", "knows")  # columns of a class
_METRICS = ("mse", "return", "rate", "denied", "tokens", "nees")  # of each policy


def agent_options(setting: Setting, of: Class) -> dict[str, Any]:
    """Return the options of the environment in which an agent of a class decides."""
    return setting.environment.options | of.information | setting.agent_options


def agent_task(setting: Setting, of: Class) -> Task:
    """Return the task in which an agent of a class is tested: no price is drawn."""
    return envelope_task(setting, agent_options(setting, of).items())


def experiment_of(suite: Suite, setting: Setting, of: Class, seed: int, work: Path) -> Experiment:
    """Return the training of one agent: the price drawn for each episode and seen."""
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


class Agent(NamedTuple):
    """One training of a class in a setting, tested at prices over the whole range.

    ``sha256`` is the hash of the class of committed rules that it is compared with.
    """

    suite: Suite
    setting: Setting
    of: Class
    seed: int
    sha256: str
    work: Path

    @property
    def weight(self) -> float:
        """About how long it takes, in seconds on one core."""
        steps = self.suite.timesteps_of(self.setting, self.of.name, self.of.mode)
        return 10.0 + steps / self.setting.pace

    @property
    def experiment(self) -> Experiment:
        """Its training."""
        return experiment_of(self.suite, self.setting, self.of, self.seed, self.work)

    @property
    def inputs(self) -> dict[str, Any]:
        """All that its results depend on."""
        return tested_inputs(self.setting, self.suite.episodes, self.suite.seed) | {
            "training": training_of(self.experiment),
            "envelope": {"class": self.of.name, "sha256": self.sha256},
            "prices": self.suite.prices,
            "price_range": list(self.setting.price_range),
        }


def run_agent(agent: Agent) -> dict[str, Any]:
    """Train an agent that sees the price, and return how that went and its results by price."""
    summary = run_training(agent.experiment)
    suite, setting = agent.suite, agent.setting
    model = f"model:{Path(agent.experiment.output) / 'best_model.zip'}"
    options = tuple(agent_options(setting, agent.of).items())
    tests = Test.at_prices(setting, options, model, suite.prices, suite.episodes, suite.seed)
    return {
        "seconds": summary["seconds"],
        "best_validation": summary["best_validation"],
        "results": [run_test(test) for test in tests],
    }


@dataclass(frozen=True)
class HindsightSearch:
    """A clairvoyant's schedules for the first test episodes."""

    suite: Suite
    setting: Setting
    weight: ClassVar[float] = 60.0

    @property
    def inputs(self) -> dict[str, Any]:
        """All that its results depend on."""
        assert self.setting.hindsight is not None
        hindsight = self.setting.hindsight.model_dump(mode="json")
        hindsight |= {"episodes": self.suite.hindsight_episodes}
        return tested_inputs(self.setting, self.suite.episodes, self.suite.seed) | {
            "hindsight": hindsight
        }


def search_in_hindsight(search: HindsightSearch) -> dict[str, EpisodeResults]:
    """Return what a clairvoyant reaches at each price."""
    torch.set_num_threads(1)
    suite, hindsight = search.suite, search.setting.hindsight
    task, episodes = envelope_task(search.setting), min(suite.hindsight_episodes, suite.episodes)
    assert hindsight is not None
    return {
        f"hindsight at price {price:g}": run_hindsight(
            task, price, hindsight.width, episodes, suite.seed
        )
        for price in hindsight.prices
    }


class BenchmarkRun(NamedTuple):
    """Policies that were tested together: their results by name, and the run's other columns."""

    name: str
    inputs: dict[str, Any]
    results: Mapping[str, EpisodeResults]
    columns: Row


class SettingWork(NamedTuple):
    """All that is tested and trained in a setting, beside committed envelopes."""

    suite: Suite
    setting: Setting
    store: EnvelopeStore
    folders: Folders

    @property
    def hashes(self) -> dict[str, str]:
        """The hash of each class of agents, in the order of classes.

        Raises:
            ConfigurationError: a class that an agent would be compared with is not there.
        """
        names = [of.name for of in trained_classes(self.suite, self.setting)]
        return {name: self.store.envelope(self.setting, name)["sha256"] for name in names}

    @property
    def vertices(self) -> list[Row]:
        """The rules of the envelopes that agents are compared with, each once."""
        classes = self.store.classes(self.setting)
        trained = trained_classes(self.suite, self.setting)
        result = {v["name"]: v for of in trained for v in classes[of.name]["vertices"]}
        return list(result.values())

    def tests(self) -> dict[str, list[Test]]:
        """Return the tests of rules and references by the run that reports them."""
        setting, suite = self.setting, self.suite

        def single(policies: Sequence[str], options: dict[str, Any] | None = None) -> list[Test]:
            rules = [{"policy": policy, "options": options or {}} for policy in policies]
            return rule_tests(setting, rules, suite.episodes, suite.seed)

        rules = rule_tests(setting, self.vertices, suite.episodes, suite.seed)
        result = {"baselines": rules + single(setting.points)}
        if setting.genie:
            result["genie"] = single(["always"], setting.genie.options)
        result |= {run: single(getattr(setting, run)) for run in ("informed", "references")}
        return {run: tests for run, tests in result.items() if tests}

    def inputs(self, run: str) -> dict[str, Any]:
        """Return all that the results of a run of rules or references depend on."""
        result = tested_inputs(self.setting, self.suite.episodes, self.suite.seed)
        if run != "baselines":
            return result | {run: list(getattr(self.setting, run) or ())}
        genie = self.setting.genie and self.setting.genie.model_dump(mode="json")
        points = list(self.setting.points)
        return result | {"envelopes": self.hashes, "points": points, "genie": genie}

    def hindsight(self) -> list[HindsightSearch]:
        """Return the search in hindsight, if there is one."""
        return [HindsightSearch(self.suite, self.setting)] if self.setting.hindsight else []

    def agents(self) -> list[Agent]:
        """Return all trainings, seed by seed."""
        hashes = self.hashes
        return [
            Agent(self.suite, self.setting, of, seed, hashes[of.name], self.folders.work)
            for seed in range(self.suite.training_seeds)
            for of in trained_classes(self.suite, self.setting)
        ]

    def calls(self, classes: Sequence[str]) -> list[Call]:
        """Return the work that is not finished, with agents of some classes.

        Raises:
            ConfigurationError: a training that is there has another config.
        """
        cache = self.folders.cache
        left = [a for a in self.agents() if not cache.holds(run_agent, a.inputs)]
        for agent in left:
            check_training(agent.experiment)
        return [
            *missing(run_test, itertools.chain(*self.tests().values()), cache),
            *missing(search_in_hindsight, self.hindsight(), cache),
            *missing(run_agent, [agent for agent in left if agent.of.name in classes], cache),
        ]

    def runs(self) -> list[BenchmarkRun]:
        """Return all runs, with the agents that are finished."""
        cache = self.folders.cache
        result = [
            BenchmarkRun(name, self.inputs(name), read_tests(tests, cache), {})
            for name, tests in self.tests().items()
        ]
        for search in self.hindsight():
            tested = cache.call(search_in_hindsight, search.inputs, search)
            episodes = {"episodes": len(next(iter(tested.values())).mse)}
            result.append(BenchmarkRun("hindsight", search.inputs, tested, episodes))
        for agent in self.agents():
            if cache.holds(run_agent, agent.inputs):
                content = cache.call(run_agent, agent.inputs, agent)
                prices = front_prices(self.setting.price_range, self.suite.prices)
                names = [f"price={price!r}" for price in prices]
                own = {
                    "class": agent.of.name,
                    "class_options": agent.of.information | self.setting.agent_options,
                    "training_seed": agent.seed,
                }
                tested = dict(zip(names, content.pop("results"), strict=True))
                name = f"agent_{agent.of.name}_{agent.seed}"
                result.append(BenchmarkRun(name, agent.inputs, tested, own | content))
        return result


def run_benchmark(every: Sequence[SettingWork], classes: Sequence[str], pool: Pool) -> None:
    """Test and train what is not finished, agents of some classes, and judge every setting."""
    side_by_side([call for work in every for call in work.calls(classes)], pool, "benchmark")
    side_by_side([Call(30.0, judge_setting, (work,)) for work in every], pool, "verdicts")


def judge_setting(work: SettingWork) -> None:
    """Write the tables of a setting: its runs, and the verdict over the finished agents.

    Raises:
        ConfigurationError: a rule does other than its committed envelope says.
    """
    suite, setting, store, runs = work.suite, work.setting, work.store, work.runs()
    result = {run.name: run.results for run in runs}
    rules, known = result["baselines"], result.get("references", {})
    if suite.episodes == store.suite.episodes and suite.seed == store.suite.seed:
        for vertex in work.vertices:
            check_vertex(vertex, rules[vertex["name"]])
    references = {"sensors": {**result.get("informed", {}), **known}, "centre": known, "local": {}}
    always = float(rules["always"].rate.mean())
    committed, tested, classes = store.classes(setting), {}, {}
    for of in trained_classes(suite, setting):
        own = committed[of.name]
        envelope = {vertex["name"]: rules[vertex["name"]] for vertex in own["vertices"]}
        agents = [list(r.results.values()) for r in runs if r.columns.get("class") == of.name]
        tested[of.name] = ClassTests(of, envelope, agents, own["searches"])
        if agents:
            measured = of.packet == "measurement"
            ahead = references[of.mode] if measured else {}
            clairvoyant = result.get("hindsight", {}) if measured else {}
            prices = front_prices(setting.price_range, suite.prices)
            classes[of.name] = {
                **judge(agents, prices, envelope, ahead, always, clairvoyant, own["searches"]),
                "at": at_rates(tested[of.name], always),
                **{key: getattr(of, key) for key in _CLASS},
                "sha256": own["sha256"],
                "envelope": [point._asdict() for point in points_of(envelope)],
            }
    verdict = {
        "title": setting.title,
        "env": setting.environment.id,
        "episodes": suite.episodes,
        "seed": suite.seed,
        "always": always,
        "classes": classes,
        "worth": worths(tested, always),
    }
    common = {"horizon": envelope_task(setting).horizon, "episodes": suite.episodes}
    rows = [
        common
        | {"run": run.name, "inputs": run.inputs, "made_from": fingerprint(run.inputs)}
        | run.columns
        for run in runs
        if run.name != "genie"
    ]
    write_verdict(work.folders.results / setting.name, verdict, rows, policies_of(work, runs))


def policies_of(work: SettingWork, runs: Sequence[BenchmarkRun]) -> list[Row]:
    """Return a row for each policy of the runs; rules have their family and what it must know."""
    task, vertices, genie = envelope_task(work.setting), work.vertices, work.setting.genie
    families: dict[str, Row] = {}
    for vertex in vertices:
        own = [v["knows"] for v in vertices if v["family"] == vertex["family"]]
        if vertex["family"] not in work.setting.points:
            families[vertex["name"]] = {"family": vertex["family"], "knows": least_covering(own)}
    for name in work.setting.points:
        families[name] = {"family": name, "knows": make_policy(name, task).knowledge}
    result = []
    for run in runs:
        for name, results in run.results.items():
            row: Row = {"run": run.name, "name": name}
            if run.name == "baselines":
                row |= families.get(name, {})
            elif run.name == "genie" and genie:
                row["name"] = genie.assumes
            elif "class" in run.columns:
                row["price"] = float(name.removeprefix("price="))
            summary = summarise(results)
            row |= {key: summary[key] for key in _METRICS}
            result.append(row | {"median": robust_summary(results)["median"]})
    return result


def write_verdict(
    folder: Path, verdict: Mapping[str, Any], runs: Sequence[Row], policies: Sequence[Row]
) -> None:
    """Write the tables of a setting: its runs, their policies, and the verdict at the end."""
    classes: dict[str, Any] = verdict["classes"]
    tables: dict[str, Sequence[Mapping[str, Any]]] = {
        "runs": runs,
        "policies": policies,
        "points": [{"class": name} | p for name, of in classes.items() for p in of["points"]],
        "equal_rates": [{"class": name} | p for name, of in classes.items() for p in of["at"]],
        "envelope": [{"class": name} | p for name, of in classes.items() for p in of["envelope"]],
        "fronts": [{"class": name} | of for name, of in classes.items()],
        "worth": verdict["worth"],
        VERDICT: [verdict],
    }
    for table, rows in tables.items():
        write_rows(folder, table, rows)
