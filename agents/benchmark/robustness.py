"""Rules and agents of a class under perturbed cases, and the verdict of each case."""

from __future__ import annotations

import functools
import glob
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agents.benchmark.classes import Class, trained_classes
from agents.benchmark.config import NOMINAL, Setting, Suite, front_prices, world
from agents.benchmark.envelopes import EnvelopeStore, Test, read_tests, rule_tests, run_test
from agents.benchmark.tables import Row
from agents.benchmark.training import agent_options, agent_task, experiment_of
from agents.benchmark.verdict import KINDS, MIDDLE, is_gain, judge, write_cases
from agents.workers import Call, Folders, Pool, check_training, missing, run_training, side_by_side
from fusion_gym import zoo
from fusion_gym.evaluation.envelope import best_mse
from fusion_gym.evaluation.episodes import EpisodeResults
from fusion_gym.evaluation.intervals import mean_interval
from fusion_gym.policies.registry import make_policy
from fusion_gym.training.config import Experiment
from fusion_gym.validation import ConfigurationError, refusal

RULES = "rules"


def agents_of(setting: Setting, of: Class, patterns: Sequence[str], work: Path) -> list[str]:
    """Return the texts of a setting's agents: files that fit patterns, the benchmark's, the zoo's.

    ``{setting}`` and ``{class}`` in a pattern are filled in. Without patterns the agents of the
    benchmark's ``work`` folder are taken, and where there are none that of the zoo.

    Raises:
        ConfigurationError: there are none.
    """
    result: list[str] = []
    for pattern in patterns:
        filled = pattern.replace("{setting}", setting.name).replace("{class}", of.name)
        files = sorted(glob.glob(filled))
        if not files and "{setting}" not in pattern:
            raise refusal("agents", pattern, "a file, or a pattern that some file fits")
        result += files
    if patterns and not result:
        raise refusal("agents", list(patterns), f"patterns that some file of {setting.name} fits")
    trained = work.glob(f"{setting.name}/{of.name}_[0-9]*/best_model.zip")
    result = result or sorted(map(str, trained))
    if result:
        return [f"model:{path}" for path in result]
    name = f"{setting.name}_{of.name}"
    if name not in zoo.names():
        raise ConfigurationError(
            f"agents = () is not allowed: neither {str(work)!r} nor the zoo has agents of "
            f"{setting.name} in the class {of.name!r}; name files, or train some"
        )
    return [f"zoo:{name}"]


def usual_class(suite: Suite, setting: Setting) -> str:
    """Return the class of a scheduler that knows most."""
    names = [of.name for of in trained_classes(suite, setting)]
    return "sensors_memory" if "sensors_memory" in names else "sensors"


@dataclass(frozen=True)
class RobustTrial:
    """What is tried in a setting: rules and agents of a class in every case.

    ``patterns`` name files of agents, and ``seeds`` is the number of trainings over draws.
    """

    suite: Suite
    setting: Setting
    of: Class
    store: EnvelopeStore
    patterns: tuple[str, ...]
    seeds: int
    folders: Folders

    @functools.cached_property
    def envelope(self) -> Row:
        """The committed rules of the class."""
        return self.store.envelope(self.setting, self.of.name)

    @functools.cached_property
    def worlds(self) -> dict[str, Setting]:
        """The setting as it is in each case, by name and the nominal one first."""
        cases = self.suite.cases_of(self.setting)
        return {case.name: world(self.setting, case) for case in cases}

    @functools.cached_property
    def agents(self) -> list[str]:
        """The texts of the agents."""
        return agents_of(self.setting, self.of, self.patterns, self.folders.work)

    def check(self) -> None:
        """Make every case once.

        Raises:
            ConfigurationError: a case that the setting cannot have, or no draws to train over;
                says which.
        """
        for name, item in [*self.worlds.items(), ("drawn", self.drawn)]:
            try:
                agent_task(item, self.of)
            except ConfigurationError as error:
                raise ConfigurationError(f"{name} of {self.setting.name}: {error}") from None
        if self.seeds and not self.setting.drawn:
            raise ConfigurationError(
                f"trained = True is not allowed with {self.setting.name}: the config has no "
                "'drawn' options for it"
            )

    def check_agents(self) -> None:
        """Make every agent once.

        Raises:
            ConfigurationError: there are none, or one does not fit.
        """
        for agent in self.agents:
            make_policy(agent, agent_task(self.setting, self.of))

    @property
    def drawn(self) -> Setting:
        """The setting in which agents are trained over draws."""
        return self.setting.with_options(self.setting.environment.options | self.setting.drawn)

    def trainings(self) -> list[Experiment]:
        """Return the trainings over draws, the benchmark's in all else."""
        work = self.folders.work / "trained"
        return [
            experiment_of(self.suite, self.drawn, self.of, seed, work) for seed in range(self.seeds)
        ]

    def rules(self, case: str) -> list[Test]:
        """Return the tests of the envelope's rules in a case."""
        episodes, seed = self.suite.robustness_episodes, self.suite.seed
        return rule_tests(self.worlds[case], self.envelope["vertices"], episodes, seed)

    def always(self, case: str) -> Test:
        """Return the test of what transmits always in a case."""
        suite = self.suite
        return Test(self.worlds[case], (), "always", suite.robustness_episodes, suite.seed)

    def agent_tests(self, kind: str, case: str) -> list[list[Test]]:
        """Return the tests of each agent of a kind in a case, at prices over the whole range.

        Raises:
            OSError: an agent's file cannot be read.
        """
        outputs = [Path(experiment.output) for experiment in self.trainings()]
        trained = [f"model:{output / 'best_model.zip'}" for output in outputs]
        world, suite = self.worlds[case], self.suite
        options = tuple(agent_options(world, self.of).items())
        return [
            Test.at_prices(
                world, options, agent, suite.prices, suite.robustness_episodes, suite.seed
            )
            for agent in (self.agents if kind == "agents" else trained)
        ]

    def tests(self, kind: str) -> list[Test]:
        """Return the tests of the rules, or of a kind of agents, in all cases."""
        if kind == RULES:
            return [t for case in self.worlds for t in (*self.rules(case), self.always(case))]
        every = (tests for case in self.worlds for tests in self.agent_tests(kind, case))
        return [test for tests in every for test in tests]

    def judge(self, case: str) -> Row:
        """Return what a case does to the rules, and every kind of agent beside them."""
        cache = self.folders.cache

        def always_rate(case: str) -> float:
            (result,) = read_tests([self.always(case)], cache).values()
            return float(result.rate.mean())

        rules, always = read_tests(self.rules(case), cache), always_rate(case)
        nominal = read_tests(self.rules(NOMINAL.name), cache)
        middle = math.sqrt(MIDDLE[0] * MIDDLE[1]) * always_rate(NOMINAL.name)
        row: Row = {"always": always, "rules": error_change(nominal, rules, middle)}
        prices = front_prices(self.setting.price_range, self.suite.prices)
        for kind in KINDS:
            tested = [
                list(read_tests(tests, cache).values()) for tests in self.agent_tests(kind, case)
            ]
            if tested:
                searches = self.envelope["searches"]
                row[kind] = judge(tested, prices, rules, {}, always, searches=searches)
        return row

    def write(self, rows: Sequence[Row]) -> None:
        """Write the tables of the cases, each of which is judged."""
        titles = [case.title for case in self.suite.cases_of(self.setting)]
        cases = {
            name: {"title": title} | row
            for name, title, row in zip(self.worlds, titles, rows, strict=True)
        }
        report = {
            "class": self.of.name,
            "episodes": self.suite.robustness_episodes,
            "sha256": self.envelope["sha256"],
            "cases": with_shares(cases),
        }
        write_cases(self.folders.results / self.setting.name, report)


Rules = Mapping[str, EpisodeResults]


def with_shares(cases: dict[str, Row]) -> dict[str, Row]:
    """Return the cases, with what each leaves of the nominal gain of every kind of agent."""
    for kind in KINDS:
        before = cases[NOMINAL.name].get(kind, {}).get("middle")
        for row in cases.values():
            middle = row.get(kind, {}).get("middle")
            if middle and before and is_gain(before):
                row[kind]["left"] = float(middle["mean"] / before["mean"])
    return cases


def error_change(nominal: Rules, case: Rules, rate: float) -> dict[str, float] | None:
    """Return the relative change of the rules' error at a rate, over paired episodes.

    That of a ratio of means, by its linear part; ``None`` left of either's first rule.
    """
    before, after = best_mse(nominal, rate), best_mse(case, rate)
    if before is None or after is None:
        return None
    ratio = float(after.mean() / before.mean())
    linear = ratio - 1.0 + (after - ratio * before) / before.mean()
    return mean_interval(np.asarray(linear))._asdict()


def try_cases(trials: Sequence[RobustTrial], pool: Pool) -> None:
    """Do what is not finished of the trials, judge every case and write the tables."""

    def test(*kinds: str) -> None:
        calls = [
            call
            for trial in trials
            for kind in kinds
            for call in missing(run_test, trial.tests(kind), trial.folders.cache)
        ]
        side_by_side(calls, pool, " and ".join(kinds))

    test(RULES, "agents")
    trainings = [training for trial in trials for training in trial.trainings()]
    for training in trainings:
        check_training(training)
    side_by_side(
        [
            Call(30.0 + training.training.timesteps / 10_000, run_training, (training,))
            for training in trainings
        ],
        pool,
        "trainings over draws",
    )
    test("trained")
    judged = [Call(20.0, trial.judge, (case,)) for trial in trials for case in trial.worlds]
    rows = iter(side_by_side(judged, pool, "verdicts"))
    for trial in trials:
        trial.write([next(rows) for _ in trial.worlds])
