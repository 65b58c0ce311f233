"""The benchmark from sweeps to rows: every class's prices, rule, agents, tests and verdict."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agents.benchmark import verdict
from agents.benchmark.calibration import CalibrationJob, CalibrationResult, run_calibration
from agents.benchmark.jobs import Runner
from agents.benchmark.rules import (
    SearchJob,
    SweepJob,
    SweepResult,
    rules_of,
    run_search,
    run_sweep,
    without_threshold,
)
from agents.benchmark.settings import Case, ClassName, Setting, Suite, knowledge_of
from agents.benchmark.training import TrainingJob, run_training
from agents.benchmark.verdict import mean_difference
from fusion_gym import seeds
from fusion_gym.core.knowledge import covers
from fusion_gym.evaluation.rule_search import SearchResult
from fusion_gym.policies.registry import make_policy, search_ranges
from fusion_gym.validation import ConfigurationError

TestResults = tuple[verdict.TestResult, ...]
REFERENCE = "rule"
TRIGGERS = "printed", "trigger"
SAVINGS = "printed", "thresholds", REFERENCE, "informed", "learned"
FRESH = seeds.TUNING[10_000]  # first of the episodes that choose among tuned policies
CALIBRATED = {"agent": "calibrated", "other": "other_calibrated"}  # by the kind of the agent alone


class TestRow(NamedTuple):
    """A policy at a price on the test episodes: means per step."""

    setting: str
    name: str  # of the class
    kind: str  # rule, threshold, trigger, agent, calibrated, learned, …, the user's policy
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
    """The cost of a kind of policy at a price, over the best tuned rule's cost, minus 1."""

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
    """The share of the tuned trigger's cost that a kind saves in the class of its knowledge."""

    setting: str
    name: str
    kind: str
    saving: float
    low: float
    high: float


class TrainingRow(NamedTuple):
    """A training: processor seconds, and costs over the best tuned rules', minus 1."""

    setting: str
    name: str
    kind: str
    algorithm: str
    seed: int
    timesteps: int
    seconds: float
    calibration_seconds: float
    best: bool  # its policy is the learned policy of its seed
    rule_points: int  # prices at which the learned policy is a rule
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


@dataclass
class Trained:
    """A training, its processor seconds, its calibration, and the file of the calibrated policy.

    Where agents cannot be calibrated the policy is the agent. ``rule_places`` are the places of
    prices at which a rule is the learned policy without calibration.
    """

    job: TrainingJob
    seconds: float
    calibration: CalibrationResult
    policy: Path
    rule_places: tuple[int, ...] = ()

    @property
    def rule_points(self) -> int:
        """Number of prices at which the learned policy is a rule."""
        points = enumerate(self.calibration.points)
        return len({*self.rule_places, *(k for k, point in points if point.mixture == 1.0)})

    def learned(
        self, outcomes: TestResults, reference: TestResults, places: Sequence[int]
    ) -> TestResults:
        """Return the results of the learned policy at some prices: its own or the reference's."""
        every = zip(places, outcomes, reference, strict=True)
        return tuple(rule if place in self.rule_places else own for place, own, rule in every)


@dataclass
class Evidence:
    """The results of a class of a setting, by kind of policy and training seed."""

    setting: Setting
    name: ClassName
    sweep: SweepResult
    searches: dict[str, SearchResult] = field(default_factory=dict)
    choice: dict[str, TestResults] = field(default_factory=dict)
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
        prices: Sequence[float] | None = None, seed: int = seeds.TEST.start,
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
            self.setting, self.name, texts, own_prices, self.prices, episodes, content, agent, case,
            seed,
        )  # fmt: skip

    @property
    def rule(self) -> str:
        """Text of the searched rule."""
        return self.searches[REFERENCE].policies[0]

    @property
    def priced_rule(self) -> str:
        """Text of the searched rule with ``{price}``."""
        return f"{self.rule},price={{price}}"

    @property
    def rules(self) -> dict[str, list[str]]:
        """Tuned rules by kind, one at each price."""
        result = {
            REFERENCE: [self.priced_rule] * len(self.prices),
            "threshold": [self.sweep.best(price).policy for price in self.prices],
        }
        result |= {k: [*r.policies] for k, r in self.searches.items() if k != REFERENCE}
        tuned = {row.rule for row in self.sweep.tuned}
        for kind, rule in self.setting.named_rules.items():
            if rule.policy in tuned:
                result[kind] = [self.sweep.best(price, rule.policy).policy for price in self.prices]
        return result

    @property
    def references(self) -> list[str]:
        """Kind of the tuned rule that costs least at each price, on tuning episodes."""
        costs = {kind: [o.cost.mean() for o in results] for kind, results in self.choice.items()}
        return [min(costs, key=lambda kind: costs[kind][k]) for k in range(len(self.prices))]

    @property
    def reference(self) -> TestResults:
        """Results of the best tuned rule at each price."""
        return tuple(self.tests[kind][0][k] for k, kind in enumerate(self.references))

    @property
    def best_of_seeds(self) -> list[tuple[str, int]]:
        """Kind and number of each seed's training whose calibrated policy costs least in tuning."""
        count = len(self.trainings["agent"])
        return [min(((k, seed) for k in self.trainings), key=self._cost) for seed in range(count)]

    @property
    def best(self) -> tuple[str, int]:
        """Kind and number of the training that costs least among these."""
        return min(self.best_of_seeds, key=self._cost)

    def training(self, kind: str, seed: int) -> Trained:
        """Return a training."""
        return self.trainings[kind][seed]

    def learned(self, kind: str, seed: int) -> TestResults:
        """Return the results of the learned policy of a training."""
        own = self.tests[CALIBRATED[kind]][seed]
        return self.training(kind, seed).learned(own, self.reference, range(len(own)))

    def _cost(self, place: tuple[str, int]) -> float:
        return self.training(*place).calibration.relative_cost


def hash_of(file: Path) -> str:
    """Return the hash of a file's content."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def gather(suite: Suite, runner: Runner) -> list[Evidence]:
    """Run unfinished work, and return all classes."""
    classes = tune_thresholds(suite, runner)
    find_rules(suite, runner, classes)
    choose_references(suite, runner, classes)
    train_agents(suite, runner, classes)
    keep_references(suite, runner, classes)
    jobs = [verdict.BoundJob(item.setting, item.name, item.prices) for item in classes]
    for item, bounds in zip(classes, runner.run(verdict.run_bound, jobs, "bounds"), strict=True):
        item.bounds = tuple(np.maximum.accumulate([0.0, *bounds])[1:].tolist())
    places = [(item, kind, texts) for item in classes for kind, texts in policies_of(item)]
    test_all(suite, runner, places)
    for item in classes:
        item.tests["learned"] = [item.learned(*place) for place in item.best_of_seeds]
    test_informed(suite, runner, classes)
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
    """Search one rule for all prices of each class, its trigger, and thresholds per sensor."""
    places, jobs = list[tuple[Evidence, str]](), []
    for item in classes:
        own = item.setting, item.name, item.prices, suite.generations, runner.folder / "searches"
        for kind, *rule in searched_rules(item):
            places.append((item, kind))
            jobs.append(SearchJob(*own, *rule))
    results = runner.run(run_search, jobs, "searches")
    for (item, kind), result in zip(places, results, strict=True):
        item.searches[kind] = result


def searched_rules(item: Evidence) -> Iterator[tuple[str, Any, tuple[str, ...], Case | None]]:
    """Yield kind, text, parameters and case of each search of a class."""
    yield REFERENCE, None, (), None
    trigger = item.setting.trigger
    if any(row.rule == trigger.policy for row in item.sweep.tuned):
        yield "trigger", without_threshold(trigger.policy)[0], (), trigger.case
    for policy in item.sweep.cheapest():
        text, name = without_threshold(policy)
        own = search_ranges(text).get(name)
        if policy != trigger.policy and own is not None and own.per_sensor:
            yield "thresholds", text, (name,), None
            return


def choose_references(suite: Suite, runner: Runner, classes: Sequence[Evidence]) -> None:
    """Compare the tuned rules of each class on fresh tuning episodes."""
    places = [
        (item, kind, texts)
        for item in classes
        for kind, texts in item.rules.items()
        if kind != "trigger" or item.setting.trigger.case is None
    ]
    episodes = suite.calibration_episodes[1]
    jobs = [item.test(texts, episodes, seed=FRESH) for item, _, texts in places]
    results = runner.run(verdict.run_test, jobs, "references")
    for (item, kind, _), outcomes in zip(places, results, strict=True):
        item.choice[kind] = outcomes


def keep_references(suite: Suite, runner: Runner, classes: Sequence[Evidence]) -> None:
    """Keep another rule as the learned policy, unless the agent's is cheaper by two deviations.

    The costs are those on the tuning episodes, and a deviation is their mean difference's.
    """
    places, jobs = list[tuple[Evidence, Trained]](), []
    for item in classes:
        if set(item.references) != {REFERENCE} or not item.setting.calibrated:
            for trained in (t for every in item.trainings.values() for t in every):
                texts = [f"model:{trained.policy},price={{price}}"] * len(item.prices)
                places.append((item, trained))
                jobs.append(item.test(texts, suite.calibration_episodes[1], seed=FRESH))
    results = runner.run(verdict.run_test, jobs, "choices of a rule")
    for (item, trained), outcomes in zip(places, results, strict=True):
        places_of_rules = []
        for place, kind in enumerate(item.references):
            gain = item.choice[kind][place].cost - outcomes[place].cost
            mixed = kind == REFERENCE and item.setting.calibrated  # with this rule, by calibration
            if not mixed and gain.mean() <= 2.0 * gain.std(ddof=1) / len(gain) ** 0.5:
                places_of_rules.append(place)
        trained.rule_places = tuple(places_of_rules)


def train_agents(suite: Suite, runner: Runner, classes: Sequence[Evidence]) -> None:
    """Train and calibrate the agents of all classes, and the other algorithm's."""
    places = []
    for item in classes:
        own = item.setting, item.name, item.prices
        for kind, algorithm in zip(CALIBRATED, item.setting.timesteps[item.name], strict=False):
            for seed in range(suite.training_seeds):
                experiment = suite.experiment(*own, seed, algorithm, item.rule)
                folder = f"{item.setting.name}_{item.name}_{algorithm}_{seed}"
                job = TrainingJob(experiment, runner.folder / "agents" / folder)
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
        item.test(texts, suite.episodes, item.setting.trigger.case if kind in TRIGGERS else None)
        for item, kind, texts in places
    ]
    results = runner.run(verdict.run_test, jobs, "tests")
    for (item, kind, _), outcomes in zip(places, results, strict=True):
        item.tests.setdefault(kind, []).append(outcomes)


def policies_of(item: Evidence) -> Iterator[tuple[str, list[str]]]:
    """Yield the kinds of policy of a class, each with one policy per price."""
    yield from item.rules.items()
    count = len(item.prices)
    if "trigger" in item.searches and item.setting.printed:
        yield "printed", [item.setting.printed] * count
    if item.setting.optimum is not None and item.name == "scheduler":
        yield "optimum", [item.setting.optimum] * count
    for kind, every in item.trainings.items():
        for trained in every:
            yield kind, [f"model:{trained.job.agent},price={{price}}"] * count
            yield CALIBRATED[kind], [f"model:{trained.policy},price={{price}}"] * count


def test_informed(suite: Suite, runner: Runner, classes: Sequence[Evidence]) -> None:
    """Test the scheduler's searched rule at the prices of the class of the trigger's knowledge."""
    schedulers = {item.setting.name: item for item in classes if item.name == "scheduler"}
    pairs = [
        (item, schedulers[item.setting.name])
        for item in classes
        if item.name == item.setting.headline != "scheduler" and item.setting.name in schedulers
    ]
    jobs = [
        other.test([other.priced_rule] * len(item.prices), suite.episodes, prices=item.prices)
        for item, other in pairs
    ]
    results = runner.run(verdict.run_test, jobs, "rules of schedulers")
    for (item, _), outcomes in zip(pairs, results, strict=True):
        item.tests["informed"] = [outcomes]


def test_cases(suite: Suite, runner: Runner, classes: Sequence[Evidence]) -> None:
    """Test the best rule, and the learned policy of the best seed, in perturbed cases."""
    places: list[tuple[Evidence, str]] = []
    jobs: list[verdict.TestJob] = []
    middle = range(1, 4)  # places of prices
    for item in classes:
        prices, learned = item.prices[1:4], item.training(*item.best)
        text = f"model:{learned.policy},price={{price}}"
        rules = [item.rules[item.references[k]][k] for k in middle]
        for case in (None, *suite.cases_of(item.setting)):
            places.append((item, "as assumed" if case is None else case.name))
            for texts in (rules, [text] * 3):
                jobs.append(item.test(texts, suite.case_episodes, case, prices))
    results = runner.run(verdict.run_test, jobs, "perturbed cases")
    for place, (item, name) in enumerate(places):
        rule, own = results[2 * place], results[2 * place + 1]
        item.cases[name] = rule, item.training(*item.best).learned(own, rule, middle)


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
    """Test a policy in a class of every setting, together with the tuned rules."""
    classes = tune_thresholds(suite, runner, name)
    find_rules(suite, runner, classes)
    choose_references(suite, runner, classes)
    places = [
        (item, kind, policies)
        for item in classes
        for kind, policies in (item.rules | {"policy": [text] * len(item.prices)}).items()
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
    """Return the difference to the best tuned rule at every price."""
    places: list[tuple[Evidence, str, float, float]] = []
    results: list[verdict.Difference] = []
    for item in classes:
        reference = item.reference
        for kind, every in item.tests.items():
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
    """Return the mean difference to the best tuned rules over a class's prices.

    The proven bound is a kind of its own, without an interval.
    """
    rows = []
    for item in classes:
        reference, place = item.reference, (item.setting.name, item.name)
        for kind, every in item.tests.items():
            d = mean_difference([(every, reference)])
            median = float(np.median([mean_difference([([o], reference)]).mean for o in every]))
            rows.append(ClassRow(*place, kind, d.mean, d.low, d.high, median))
        if item.bounds:
            costs = [float(outcome.cost.mean()) for outcome in reference]
            below = float(np.mean(np.divide(item.bounds, costs))) - 1.0
            rows.append(ClassRow(*place, "bound", below, below, below, below))
    return rows


def saving_rows(classes: Sequence[Evidence]) -> list[SavingRow]:
    """Return the cost that each kind saves against a setting's tuned trigger, a mean over prices.

    A setting counts in the class of its trigger's knowledge.
    """
    rows = []
    for item in classes:
        if item.name == item.setting.headline and "trigger" in item.tests:
            for kind in SAVINGS:
                if kind in item.tests:
                    own = verdict.saving(item.tests[kind], item.tests["trigger"][0])
                    rows.append(SavingRow(item.setting.name, item.name, kind, *own))
            if item.bounds:
                costs = [float(outcome.cost.mean()) for outcome in item.tests["trigger"][0]]
                most = 1.0 - float(np.mean(np.divide(item.bounds, costs)))
                rows.append(SavingRow(item.setting.name, item.name, "bound", most, most, most))
    return rows


def training_rows(classes: Sequence[Evidence]) -> list[TrainingRow]:
    """Return a row for each training, with its costs over the best tuned rules', minus 1."""
    rows = []
    for item in classes:
        for kind, every in item.trainings.items():
            for seed, trained in enumerate(every):
                agent, learned = (
                    mean_difference([([own], item.reference)]).mean
                    for own in (item.tests[kind][seed], item.learned(kind, seed))
                )
                experiment = trained.job.experiment
                place = item.setting.name, item.name, kind, experiment.algorithm.name, seed
                work = experiment.training.timesteps, trained.seconds, trained.calibration.seconds
                best = (kind, seed) in item.best_of_seeds
                rows.append(TrainingRow(*place, *work, best, trained.rule_points, agent, learned))
    return rows


def case_rows(classes: Sequence[Evidence]) -> list[CaseRow]:
    """Return the costs of every scheduler's rules and learned policy in the perturbed cases."""
    rows = []
    for item in classes:
        for case, (rule, learned) in item.cases.items():
            base = item.cases["as assumed"][0]
            d = mean_difference([([learned], rule)])
            change = mean_difference([([rule], base)]).mean
            rows.append(CaseRow(item.setting.name, case, change, d.mean, d.low, d.high))
    return rows
