"""The benchmark of a setting: its tests, one training for each agent, and the verdict over them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

from fusion_gym.core.system import least_covering
from fusion_gym.core.task import Task
from fusion_gym.deprecation import replace_value
from fusion_gym.evaluation.envelope import points_of
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.evaluation.hindsight import run_hindsight
from fusion_gym.evaluation.metrics import robust_summary, summarise
from fusion_gym.policies.registry import make_policy

from ..output.folders import fingerprint
from ..training.config import EnvironmentConfig, Experiment, TrainingConfig, ValidationConfig
from .classes import Class, classes_of, trained_classes
from .config import Setting, Suite, front_prices
from .envelopes import (
    EnvelopeStore,
    Test,
    check_vertex,
    envelope_task,
    read_tests,
    rule_tests,
    run_test,
)
from .tables import VERDICT, Row, write_rows
from .verdict import ClassTests, at_rates, judge, worths
from .workers import (
    Call,
    Folders,
    Pool,
    check_training,
    missing,
    run_training,
    side_by_side,
    training_of,
)

VALIDATIONS = 2  # of a training


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
    def name(self) -> str:
        """Its name in the tables."""
        return f"agent_{self.of.name}_{self.seed}"

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
    def prices(self) -> list[float]:
        """The prices that it is tested at."""
        return front_prices(self.setting.price_range, self.suite.prices)

    @property
    def inputs(self) -> dict[str, Any]:
        """All that its results depend on."""
        return tested_inputs(self.suite, self.setting) | {
            "training": training_of(self.experiment),
            "envelope": {"class": self.of.name, "sha256": self.sha256},
            "prices": self.suite.prices,
            "price_range": list(self.setting.price_range),
        }


def run_agent(agent: Agent) -> dict[str, Any]:
    """Train an agent that sees the price, and return how that went and its results by price."""
    summary = run_training(agent.experiment)
    task = agent_task(agent.setting, agent.of)
    model = Path(agent.experiment.output) / "best_model.zip"
    policies = [make_policy(f"model:{model},price={price!r}", task) for price in agent.prices]
    return {
        "seconds": summary["seconds"],
        "best_validation": summary["best_validation"],
        "results": [
            run_episodes(task, policy, agent.suite.episodes, agent.suite.seed)
            for policy in policies
        ],
    }


class HindsightSearch(NamedTuple):
    """A clairvoyant's schedules for the first test episodes."""

    suite: Suite
    setting: Setting

    @property
    def weight(self) -> float:
        """About how long it takes, in seconds on one core."""
        return 0.6 * self.suite.hindsight_episodes

    @property
    def episodes(self) -> int:
        """The number of these episodes."""
        return min(self.suite.hindsight_episodes, self.suite.episodes)

    @property
    def inputs(self) -> dict[str, Any]:
        """All that its results depend on."""
        assert self.setting.hindsight is not None
        hindsight = self.setting.hindsight.model_dump(mode="json")
        hindsight |= {"episodes": self.suite.hindsight_episodes}
        return tested_inputs(self.suite, self.setting) | {"hindsight": hindsight}


def run_search_in_hindsight(search: HindsightSearch) -> dict[str, EpisodeResults]:
    """Return what a clairvoyant reaches at each price."""
    torch.set_num_threads(1)
    task, hindsight = envelope_task(search.setting), search.setting.hindsight
    assert hindsight is not None
    return {
        f"hindsight at price {price:g}": run_hindsight(
            task, price, hindsight.width, search.episodes, search.suite.seed
        )
        for price in hindsight.prices
    }


def tested_inputs(suite: Suite, setting: Setting) -> dict[str, Any]:
    """Return what all results of a setting depend on."""
    return {
        "environment": setting.environment.model_dump(mode="json"),
        "episodes": suite.episodes,
        "seed": suite.seed,
    }


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
        trained = {of.name for of in trained_classes(self.suite, self.setting)}
        names = [of.name for of in classes_of(self.setting) if of.name in trained]
        return {name: self.store.envelope(self.setting, name)["sha256"] for name in names}

    @property
    def vertices(self) -> list[Row]:
        """The rules of the envelopes that agents are compared with."""
        names = [of.name for of in trained_classes(self.suite, self.setting)]
        return self.store.vertices(self.setting, names)

    def tests(self) -> dict[str, list[Test]]:
        """Return the tests by the run that they are reported as."""
        setting, seed = self.setting, self.suite.seed

        def single(policies: Sequence[str]) -> list[Test]:
            return [Test(setting, (), policy, self.suite.episodes, seed) for policy in policies]

        genie = setting.genie.options if setting.genie else {}
        free = Test(setting, tuple(genie.items()), "always", self.suite.episodes, seed)
        result = {
            "baselines": rule_tests(setting, self.vertices, self.suite.episodes, seed)
            + single(setting.points),
            "genie": [free] if setting.genie else [],
            "informed": single(setting.informed),
            "references": single(setting.references),
        }
        return {run: tests for run, tests in result.items() if tests}

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
        tests = [test for tests in self.tests().values() for test in tests]
        return [
            *missing(run_test, tests, cache),
            *missing(run_search_in_hindsight, self.hindsight(), cache),
            *missing(run_agent, [agent for agent in left if agent.of.name in classes], cache),
        ]

    def inputs(self, run: str) -> dict[str, Any]:
        """Return all that the results of a run of policies depend on."""
        result = tested_inputs(self.suite, self.setting)
        if run != "baselines":
            return result | {run: list(getattr(self.setting, run))}
        genie = self.setting.genie and self.setting.genie.model_dump(mode="json")
        points = list(self.setting.points)
        return result | {"envelopes": self.hashes, "points": points, "genie": genie}


def run_benchmark(every: Sequence[SettingWork], classes: Sequence[str], pool: Pool) -> None:
    """Test and train what is not finished, agents of some classes, and judge every setting."""
    side_by_side([call for work in every for call in work.calls(classes)], pool, "benchmark")
    side_by_side([Call(30.0, judge_setting, (work,)) for work in every], pool, "verdicts")


def judge_setting(work: SettingWork) -> None:
    """Write the tables of a setting: its runs, and the verdict over the finished agents.

    Raises:
        ConfigurationError: a rule does other than its committed envelope says.
    """
    suite, setting, store, cache = work.suite, work.setting, work.store, work.folders.cache
    result = {run: read_tests(tests, cache) for run, tests in work.tests().items()}
    rules, known = result["baselines"], result.get("references", {})
    if suite.episodes == store.suite.episodes and suite.seed == store.suite.seed:
        for vertex in work.vertices:
            check_vertex(vertex, rules[vertex["name"]])
    for search in work.hindsight():
        if cache.holds(run_search_in_hindsight, search.inputs):
            hindsight = cache.call(run_search_in_hindsight, search.inputs, search)
            result["hindsight"] = hindsight
    finished = [
        (agent, cache.call(run_agent, agent.inputs, agent))
        for agent in work.agents()
        if cache.holds(run_agent, agent.inputs)
    ]
    references = {"sensors": result.get("informed", {}) | known, "centre": known, "local": {}}
    always = float(rules["always"].rate.mean())
    committed, tested, classes = store.classes(setting), {}, {}
    for of in trained_classes(suite, setting):
        own = committed[of.name]
        envelope = {vertex["name"]: rules[vertex["name"]] for vertex in own["vertices"]}
        agents = [content["results"] for agent, content in finished if agent.of == of]
        tested[of.name] = ClassTests(of, envelope, agents, own["searches"])
        if agents:
            measured = of.packet == "measurement"
            ahead = references[of.mode] if measured else {}
            clairvoyant = result.get("hindsight", {}) if measured else {}
            prices = front_prices(setting.price_range, suite.prices)
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
        "title": setting.title,
        "env": setting.environment.id,
        "episodes": suite.episodes,
        "seed": suite.seed,
        "always": always,
        "classes": classes,
        "worth": worths(tested, always),
    }
    runs, policies = rows_of(work, result, finished)
    write_verdict(work.folders.results / setting.name, verdict, runs, policies)


def rows_of(
    work: SettingWork,
    result: Mapping[str, Mapping[str, EpisodeResults]],
    finished: Sequence[tuple[Agent, Row]],
) -> tuple[list[Row], list[Row]]:
    """Return a row for each run, and one for each policy that it has tested."""
    setting, families = work.setting, families_of(work)
    horizon = envelope_task(setting).horizon
    runs: list[Row] = []
    policies: list[Row] = []

    def add(run: str, inputs: dict[str, Any], **more: Any) -> None:
        row = {"run": run, "inputs": inputs, "made_from": fingerprint(inputs), "horizon": horizon}
        runs.append(row | {"episodes": work.suite.episodes} | more)

    for run, tested in result.items():
        if run == "genie":
            assert setting.genie is not None
            policies.append(
                {"run": run, "name": setting.genie.assumes} | _summary(*tested.values())
            )
            continue
        if run == "hindsight":
            (search,) = work.hindsight()
            add(run, search.inputs, episodes=search.episodes)
        else:
            add(run, work.inputs(run))
        policies += [
            {"run": run, "name": name} | families.get(name, {}) | _summary(results)
            for name, results in tested.items()
        ]
    for agent, content in finished:
        told = {key: content[key] for key in ("seconds", "best_validation")}
        options = agent.of.information | setting.agent_options
        own = {"class": agent.of.name, "class_options": options, "training_seed": agent.seed}
        add(agent.name, agent.inputs, **told, **own)
        policies += [
            {"run": agent.name, "name": f"price={price!r}", "price": price} | _summary(results)
            for price, results in zip(agent.prices, content["results"], strict=True)
        ]
    return runs, policies


def families_of(work: SettingWork) -> dict[str, Row]:
    """Return the family of each tested rule by its name, and what all rules of it need to know."""
    task, families = envelope_task(work.setting), dict[str, list[Row]]()
    for vertex in work.vertices:
        families.setdefault(vertex["family"], []).append(vertex)
    result = {
        vertex["name"]: {
            "family": family,
            "knows": least_covering([replace_value(item["knows"]) for item in vertices]),
        }
        for family, vertices in families.items()
        if family not in work.setting.points
        for vertex in vertices
    }
    return result | {
        name: {"family": name, "knows": make_policy(name, task).knowledge}
        for name in work.setting.points
    }


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


def _summary(results: EpisodeResults) -> dict[str, Any]:
    summary = summarise(results)
    stored = {key: summary[key] for key in ("mse", "return", "rate", "denied", "tokens", "nees")}
    return stored | {"median": robust_summary(results)["median"]}
