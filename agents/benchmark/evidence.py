"""The benchmark from sweeps to rows: every class's prices, rule, agents, tests and verdict."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from agents.benchmark import verdict
from agents.benchmark.calibration import CalibrationJob, CalibrationResult, run_calibration
from agents.benchmark.jobs import Runner
from agents.benchmark.rules import SearchJob, SweepJob, SweepResult, rules_of, run_search, run_sweep
from agents.benchmark.settings import Case, ClassName, Setting, Suite, knowledge_of
from agents.benchmark.training import TrainingJob, run_training
from agents.benchmark.verdict import mean_difference
from fusion_gym.core.knowledge import covers
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

TestResults = tuple[verdict.TestResult, ...]
REFERENCE = "rule"
CALIBRATED = {"agent": "learned", "other": "other_learned"}  # by the kind of the agent alone


class TestRow(NamedTuple):
    """A policy at a price on the test episodes: means per step."""

    setting: str
    name: str  # of the class
    kind: str  # rule, threshold, trigger, agent, learned, other, …, optimum, the user's policy
    seed: int  # of the training
    share: float  # of the tokens of ``always`` that the best single threshold spends there
    price: float
    cost: float
    error: float = math.nan
    tokens: float = math.nan
    mse: float = math.nan
    rate: float = math.nan
    policy: str = ""


class PointRow(NamedTuple):
    """The cost of a kind of policy at a price, relative to the searched rule's, minus 1."""

    setting: str
    name: str
    kind: str
    share: float
    price: float
    difference: float
    low: float
    high: float
    discovery: bool  # after Benjamini and Hochberg, over all points of the table


class ClassRow(NamedTuple):
    """The mean of these differences over a class's prices and seeds; the median over seeds."""

    setting: str
    name: str
    kind: str
    difference: float
    low: float
    high: float
    median: float


class SavingRow(NamedTuple):
    """The share of the own trigger's cost that a kind saves: a mean over prices and classes."""

    setting: str
    kind: str
    classes: int
    saving: float
    low: float
    high: float


class TrainingRow(NamedTuple):
    """A training and its calibration: processor seconds, and costs over the rule's, minus 1."""

    setting: str
    name: str
    kind: str
    algorithm: str
    seed: int
    timesteps: int
    seconds: float
    calibration_seconds: float
    rule_points: int  # prices at which the calibration takes the rule alone
    agent: float
    learned: float


class CaseRow(NamedTuple):
    """A perturbed case: the rule's cost over its nominal cost, the learned policy's over that."""

    setting: str
    case: str
    rule: float
    difference: float
    low: float
    high: float


class Trained(NamedTuple):
    """A training, its processor seconds, its calibration, and the file of the calibrated policy.

    Where agents cannot be calibrated the policy is the agent.
    """

    job: TrainingJob
    seconds: float
    calibration: CalibrationResult
    policy: Path


@dataclass
class Evidence:
    """The results of a class of a setting, by kind of policy and training seed."""

    setting: Setting
    name: ClassName
    sweep: SweepResult
    rule: str = ""
    trainings: dict[str, list[Trained]] = field(default_factory=dict)
    tests: dict[str, list[TestResults]] = field(default_factory=dict)
    bounds: tuple[float, ...] = ()
    cases: dict[str, tuple[TestResults, TestResults]] = field(default_factory=dict)

    @property
    def prices(self) -> tuple[float, ...]:
        """Prices of the class, in increasing order."""
        return tuple(self.setting.prices[self.name])

    def test(
        self, policies: Sequence[str], episodes: int, case: Case | None = None,
        prices: Sequence[float] | None = None,
    ) -> verdict.TestJob:  # fmt: skip
        """Return the test of one policy per price; the key of an agent is its file's content."""
        own_prices = tuple(self.prices if prices is None else prices)
        texts = tuple(
            text.replace("{price}", f"{price!r}")
            for text, price in zip(policies, own_prices, strict=True)
        )
        agent = texts[0].startswith("model:")
        content = "\n".join(texts)
        if agent:
            content = hash_of(Path(texts[0].removeprefix("model:").rpartition(",price=")[0]))
        return verdict.TestJob(
            self.setting, self.name, texts, own_prices, self.prices, episodes, content, agent, case
        )

    @property
    def priced_rule(self) -> str:
        """Text of the searched rule with ``{price}``."""
        return f"{self.rule},price={{price}}"

    @property
    def best_seed(self) -> int:
        """Seed of the training whose calibrated policy costs least on its tuning episodes."""
        costs = [item.calibration.relative_cost for item in self.trainings["agent"]]
        return int(np.argmin(costs))

    @property
    def best_policy(self) -> Path:
        """File of the calibrated policy with that seed."""
        return self.trainings["agent"][self.best_seed].policy


def hash_of(file: Path) -> str:
    """Return the hash of a file's content."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def gather(suite: Suite, runner: Runner) -> list[Evidence]:
    """Run unfinished work, and return all classes."""
    classes = tune_thresholds(suite, runner)
    find_rules(suite, runner, classes)
    train_agents(suite, runner, classes)
    jobs = [verdict.BoundJob(item.setting, item.name, item.prices) for item in classes]
    for item, bounds in zip(classes, runner.run(verdict.run_bound, jobs, "bounds"), strict=True):
        item.bounds = bounds
    places = [(item, kind, texts) for item in classes for kind, texts in policies_of(item)]
    test_all(suite, runner, places)
    test_cases(suite, runner, [item for item in classes if item.name == "scheduler"])
    return classes


def tune_thresholds(suite: Suite, runner: Runner, only: ClassName | None = None) -> list[Evidence]:
    """Tune the rules with one threshold at the prices of the classes, or of one."""
    places = [(s, name) for s in suite.settings for name in ([only] if only else s.classes)]
    jobs = [
        SweepJob(
            *place,
            rules_of(*place, suite.rules),
            tuple(place[0].prices[place[1]]),
            suite.tuning_episodes,
        )
        for place in places
    ]
    results = runner.run(run_sweep, jobs, "single thresholds")
    return [Evidence(*place, result) for place, result in zip(places, results, strict=True)]


def find_rules(suite: Suite, runner: Runner, classes: Sequence[Evidence]) -> None:
    """Search one rule for all prices of each class."""
    generations, folder = suite.generations, runner.folder / "searches"
    jobs = [
        SearchJob(item.setting, item.name, item.prices, generations, folder) for item in classes
    ]
    for item, text in zip(classes, runner.run(run_search, jobs, "searches"), strict=True):
        item.rule = text


def train_agents(suite: Suite, runner: Runner, classes: Sequence[Evidence]) -> None:
    """Train and calibrate the agents of all classes, and the other algorithm's."""
    places = []
    for item in classes:
        own = item.setting, item.name
        for kind, (algorithm, steps) in suite.algorithms(*own).items():
            for seed in range(suite.seeds(*own)):
                folder = f"{item.setting.name}_{item.name}_{algorithm.name}_{seed}"
                experiment = suite.experiment(*own, item.prices, seed, algorithm, steps)
                weight = float(item.setting.seconds[item.name])
                job = TrainingJob(experiment, runner.folder / "agents" / folder, weight)
                places.append((item, kind, job))
    spent = runner.run(run_training, [job for _, _, job in places], "trainings")
    calibrations = [
        CalibrationJob(
            item.setting, item.name, hash_of(job.agent), job.experiment.environment.options,
            item.prices, item.rule, suite.calibration_episodes, job.agent,
            job.folder / "calibrated_model.zip",
        )
        for item, _, job in places if item.setting.calibrated
    ]  # fmt: skip
    every = zip(
        calibrations, runner.run(run_calibration, calibrations, "calibrations"), strict=True
    )
    for (item, kind, job), seconds in zip(places, spent, strict=True):
        policy, result = job.agent, CalibrationResult(0.0, math.nan, ())
        if item.setting.calibrated:
            calibration, result = next(every)
            policy = calibration.policy
        item.trainings.setdefault(kind, []).append(Trained(job, seconds, result, policy))


def test_all(
    suite: Suite, runner: Runner, places: Sequence[tuple[Evidence, str, list[str]]]
) -> None:
    """Test policies of a class and kind, one at each price, on the test episodes."""
    jobs = [
        item.test(texts, suite.episodes, item.setting.trigger.case if kind == "trigger" else None)
        for item, kind, texts in places
    ]
    results = runner.run(verdict.run_test, jobs, "tests")
    for (item, kind, _), outcomes in zip(places, results, strict=True):
        item.tests.setdefault(kind, []).append(outcomes)


def policies_of(item: Evidence) -> Iterator[tuple[str, list[str]]]:
    """Yield the kinds of policy of a class, each with one policy per price."""
    count = len(item.prices)
    yield REFERENCE, [item.priced_rule] * count
    yield "threshold", [item.sweep.best(price).policy for price in item.prices]
    tuned = {row.rule for row in item.sweep.tuned}
    for kind, rule in {"trigger": item.setting.trigger, **item.setting.named_rules}.items():
        if rule.policy in tuned:
            yield kind, [item.sweep.best(price, rule.policy).policy for price in item.prices]
    if item.setting.optimum is not None and item.name == "scheduler":
        yield "optimum", [item.setting.optimum] * count
    for kind, every in item.trainings.items():
        for trained in every:
            yield kind, [f"model:{trained.job.agent},price={{price}}"] * count
            yield CALIBRATED[kind], [f"model:{trained.policy},price={{price}}"] * count


def test_cases(suite: Suite, runner: Runner, classes: Sequence[Evidence]) -> None:
    """Test the rule, and the learned policy with the least cost in tuning, in perturbed cases."""
    places: list[tuple[Evidence, str]] = []
    jobs: list[verdict.TestJob] = []
    for item in classes:
        texts = item.priced_rule, f"model:{item.best_policy},price={{price}}"
        prices = item.prices[1:4]  # the middle ones
        for case in (None, *suite.cases_of(item.setting)):
            places.append((item, "as assumed" if case is None else case.name))
            for text in texts:
                jobs.append(item.test([text] * 3, suite.case_episodes, case, prices))
    results = runner.run(verdict.run_test, jobs, "perturbed cases")
    for place, (item, name) in enumerate(places):
        item.cases[name] = results[2 * place], results[2 * place + 1]


def check_policy(suite: Suite, text: str, name: ClassName) -> None:
    """Refuse a policy that does not exist in every setting, or knows more than its class."""
    for setting in suite.settings:
        policy = make_policy(text.replace("{price}", "1.0"), setting.task(name))
        knower = knowledge_of(setting, name)
        if not covers(knower, policy.knowledge):
            raise ConfigurationError(
                f"policy = {text!r} is not allowed with class = {name!r} in {setting.name}: it "
                f"declares knowledge = {policy.knowledge!r}, and the class has {knower!r}"
            )


def evaluate_policy(suite: Suite, runner: Runner, text: str, name: ClassName) -> list[Evidence]:
    """Test a policy in a class of every setting, together with the searched rule."""
    classes = tune_thresholds(suite, runner, name)
    find_rules(suite, runner, classes)
    places = [
        (item, kind, [policy] * len(item.prices))
        for item in classes
        for kind, policy in ((REFERENCE, item.priced_rule), ("policy", text))
    ]
    test_all(suite, runner, places)
    return classes


def policy_rows(suite: Suite, classes: Sequence[Evidence]) -> list[TestRow]:
    """Return a row for every policy at every price, and for the bound of the cost."""
    rows = [
        TestRow(
            item.setting.name, item.name, kind, seed, share, o.price, float(o.cost.mean()),
            float(o.error.mean()), float(o.tokens.mean()), o.mse, o.rate,
            "" if o.policy.startswith("model:") else o.policy,
        )
        for item in classes
        for kind, every in item.tests.items()
        for seed, outcomes in enumerate(every)
        for share, o in zip(suite.shares, outcomes, strict=True)
    ]  # fmt: skip
    return rows + [
        TestRow(item.setting.name, item.name, "bound", 0, share, price, bound)
        for item in classes
        for share, price, bound in zip(suite.shares, item.prices, item.bounds, strict=False)
    ]


def point_rows(suite: Suite, classes: Sequence[Evidence]) -> list[PointRow]:
    """Return the difference to the searched rule at every price."""
    places: list[tuple[Evidence, str, float, float]] = []
    results: list[verdict.Difference] = []
    for item in classes:
        reference = item.tests[REFERENCE][0]
        for kind, every in item.tests.items():
            if kind == REFERENCE:
                continue
            for place, price in enumerate(item.prices):
                costs = [outcomes[place].cost for outcomes in every]
                places.append((item, kind, suite.shares[place], price))
                results.append(verdict.cost_difference(costs, reference[place].cost))
    counts = verdict.discoveries([item.p for item in results])
    return [
        PointRow(item.setting.name, item.name, kind, share, price, d.mean, d.low, d.high, counted)
        for (item, kind, share, price), d, counted in zip(places, results, counts, strict=True)
    ]


def class_rows(classes: Sequence[Evidence]) -> list[ClassRow]:
    """Return the mean difference to the searched rule over a class's prices.

    The proven bound is a kind of its own, without an interval.
    """
    rows = []
    for item in classes:
        (reference,), place = item.tests[REFERENCE], (item.setting.name, item.name)
        for kind, every in item.tests.items():
            if kind != REFERENCE:
                d = mean_difference([(every, reference)])
                median = float(np.median([mean_difference([([o], reference)]).mean for o in every]))
                rows.append(ClassRow(*place, kind, d.mean, d.low, d.high, median))
        if item.bounds:
            costs = [float(outcome.cost.mean()) for outcome in reference]
            below = float(np.mean(np.divide(item.bounds, costs))) - 1.0
            rows.append(ClassRow(*place, "bound", below, below, below, below))
    return rows


def saving_rows(classes: Sequence[Evidence]) -> list[SavingRow]:
    """Return the cost that each kind saves against the settings' own triggers.

    It is the mean over prices and over the classes in which the trigger runs.
    """
    rows = []
    for setting in dict.fromkeys(item.setting.name for item in classes):
        own = [i for i in classes if i.setting.name == setting and "trigger" in i.tests]
        for kind in ("threshold", REFERENCE, "learned"):
            d = mean_difference([(item.tests[kind], item.tests["trigger"][0]) for item in own])
            rows.append(SavingRow(setting, kind, len(own), -d.mean, -d.high, -d.low))
    return rows


def training_rows(classes: Sequence[Evidence]) -> list[TrainingRow]:
    """Return a row for each training, with its costs over the searched rule's, minus 1."""
    rows = []
    for item in classes:
        (reference,) = item.tests[REFERENCE]
        for kind, every in item.trainings.items():
            for seed, (job, seconds, result, _) in enumerate(every):
                agent, learned = (
                    mean_difference([([item.tests[name][seed]], reference)]).mean
                    for name in (kind, CALIBRATED[kind])
                )
                rule_only = sum(point.mixture == 1.0 for point in result.points)
                algorithm, training = job.experiment.algorithm.name, job.experiment.training
                place = item.setting.name, item.name, kind, algorithm, seed
                work = training.timesteps, seconds, result.seconds
                rows.append(TrainingRow(*place, *work, rule_only, agent, learned))
    return rows


def case_rows(classes: Sequence[Evidence]) -> list[CaseRow]:
    """Return the costs of every scheduler's rule and learned policy in the perturbed cases."""
    rows = []
    for item in classes:
        for case, (rule, learned) in item.cases.items():
            base = item.cases["as assumed"][0]
            d = mean_difference([([learned], rule)])
            change = mean_difference([([rule], base)]).mean
            rows.append(CaseRow(item.setting.name, case, change, d.mean, d.low, d.high))
    return rows
