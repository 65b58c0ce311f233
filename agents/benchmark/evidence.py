"""The benchmark from sweeps to rows: every class's prices, rule, agents, tests and verdict."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from agents.benchmark.bounds import BoundJob, run_bound
from agents.benchmark.jobs import Runner
from agents.benchmark.rules import SearchJob, SweepJob, SweepResult, rules_of, run_search, run_sweep
from agents.benchmark.settings import (
    CLASSES,
    TEST_SEED,
    VALIDATION_SEED,
    Case,
    ClassName,
    Setting,
    Suite,
    knowledge_of,
)
from agents.benchmark.tables import CaseRow, ChoiceRow, ClassRow, PointRow, TestRow
from agents.benchmark.training import TrainingJob, run_training
from agents.benchmark.verdict import (
    Difference,
    TestJob,
    TestResult,
    cost_difference,
    discoveries,
    over_prices,
    run_test,
)
from fusion_gym.core.system import covers
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

TestResults = tuple[TestResult, ...]
REFERENCE = "rule"


@dataclass
class ClassRecord:
    """The results of a class of a setting, by kind of policy and training seed."""

    setting: Setting
    name: ClassName
    sweep: SweepResult
    memoryless: SweepResult | None = None
    rule: str = ""
    models: list[Path] = field(default_factory=list)
    tests: dict[str, list[TestResults]] = field(default_factory=dict)
    validations: dict[str, list[TestResults]] = field(default_factory=dict)
    bounds: tuple[float, ...] = ()
    cases: dict[str, tuple[TestResults, TestResults]] = field(default_factory=dict)

    @property
    def prices(self) -> tuple[float, ...]:
        """Prices of the class, in increasing order."""
        return self.sweep.prices

    def test(
        self, policies: Sequence[str], episodes: int, seed: int = TEST_SEED,
        case: Case | None = None, prices: Sequence[float] | None = None,
    ) -> TestJob:  # fmt: skip
        """Return the test of one policy per price; the key of an agent is its file's content."""
        own_prices = tuple(self.prices if prices is None else prices)
        texts = tuple(
            text.replace("{price}", f"{price!r}")
            for text, price in zip(policies, own_prices, strict=True)
        )
        agent = texts[0].startswith("model:")
        content = "\n".join(texts)
        if agent:
            file = Path(texts[0].removeprefix("model:").rpartition(",price=")[0])
            content = hashlib.sha256(file.read_bytes()).hexdigest()
        return TestJob(
            self.setting, self.name, texts, own_prices, self.prices, episodes, seed, content,
            agent, None, case,
        )  # fmt: skip

    @property
    def best_agent(self) -> int:
        """Training seed of the agent with the least cost in validation."""
        reference = self.validations[REFERENCE][0]
        scores = [over_prices([outcomes], reference).mean for outcomes in self.validations["agent"]]
        return int(np.argmin(scores))

    @property
    def choice(self) -> tuple[str, int]:
        """Kind and seed of the policy with the least cost in validation."""
        reference = self.validations[REFERENCE][0]
        scores = {
            (kind, seed): over_prices([outcomes], reference).mean
            for kind, every in self.validations.items()
            for seed, outcomes in enumerate(every)
        }
        return min(scores, key=scores.__getitem__)


def gather(suite: Suite, runner: Runner) -> list[ClassRecord]:
    """Run unfinished work, and return all classes."""
    classes = find_prices(suite, runner)
    find_rules(suite, runner, classes)
    train_agents(suite, runner, classes)
    jobs = [BoundJob(entry.setting, entry.name, entry.prices) for entry in classes]
    for entry, bounds in zip(classes, runner.run(run_bound, jobs, "bounds"), strict=True):
        entry.bounds = bounds
    test_all(suite, runner, classes)
    test_cases(suite, runner, [entry for entry in classes if entry.name == "scheduler"])
    return classes


def find_prices(
    suite: Suite, runner: Runner, names: Sequence[ClassName] = CLASSES
) -> list[ClassRecord]:
    """Tune the rules with one threshold, and freeze the prices of the classes."""

    def sweep(
        setting: Setting, name: ClassName, memory: bool, prices: tuple[float, ...] = ()
    ) -> SweepJob:
        rules = rules_of(setting, name, suite.rules, memory)
        return SweepJob(setting, name, memory, rules, suite.shares, suite.tuning_episodes, prices)

    places = [(setting, name) for setting in suite.settings for name in names]
    jobs = [sweep(setting, name, setting.has_memory(name)) for setting, name in places]
    results = runner.run(run_sweep, jobs, "single thresholds")
    classes = [ClassRecord(*place, result) for place, result in zip(places, results, strict=True)]
    others = [entry for entry in classes if entry.setting.has_memory(entry.name)]
    jobs = [sweep(entry.setting, entry.name, False, entry.prices) for entry in others]
    results = runner.run(run_sweep, jobs, "single thresholds without memory")
    for entry, result in zip(others, results, strict=True):
        entry.memoryless = result
    return classes


def find_rules(suite: Suite, runner: Runner, classes: Sequence[ClassRecord]) -> None:
    """Search one rule for all prices of each class."""
    jobs = [
        SearchJob(
            entry.setting, entry.name, entry.prices, suite.generations, runner.folder / "searches"
        )
        for entry in classes
    ]
    for entry, text in zip(classes, runner.run(run_search, jobs, "searches"), strict=True):
        entry.rule = f"{text},price={{price}}"


def train_agents(suite: Suite, runner: Runner, classes: Sequence[ClassRecord]) -> None:
    """Train one agent per class and seed."""
    places = [(entry, seed) for entry in classes for seed in range(suite.training_seeds)]
    jobs = []
    for entry, seed in places:
        folder = runner.folder / "agents" / f"{entry.setting.name}_{entry.name}_{seed}"
        experiment = suite.experiment(entry.setting, entry.name, entry.prices, seed)
        jobs.append(TrainingJob(entry.setting, entry.name, experiment, folder))
    runner.run(run_training, jobs, "trainings")
    for (entry, _), job in zip(places, jobs, strict=True):
        entry.models.append(job.model)


def test_all(suite: Suite, runner: Runner, classes: Sequence[ClassRecord]) -> None:
    """Test every kind of policy on the test episodes, and rules and agents in validation."""
    places: list[tuple[ClassRecord, str, bool]] = []
    jobs: list[TestJob] = []
    for entry in classes:
        for kind, policies in policies_of(entry):
            places.append((entry, kind, True))
            jobs.append(entry.test(policies, suite.episodes))
            if kind in (REFERENCE, "agent"):
                places.append((entry, kind, False))
                jobs.append(entry.test(policies, suite.validation_episodes, VALIDATION_SEED))
    for (entry, kind, final), outcomes in zip(
        places, runner.run(run_test, jobs, "tests"), strict=True
    ):
        tests = entry.tests if final else entry.validations
        tests.setdefault(kind, []).append(outcomes)


def policies_of(entry: ClassRecord) -> Iterator[tuple[str, list[str]]]:
    """Yield the kinds of policy of a class, each with one policy per price."""
    count = len(entry.prices)
    yield REFERENCE, [entry.rule] * count
    yield "threshold", [entry.sweep.best(price).policy for price in entry.prices]
    trigger = entry.setting.trigger.policy
    if any(tuned.rule == trigger for tuned in entry.sweep.tuned):
        yield "trigger", [entry.sweep.best(price, trigger).policy for price in entry.prices]
    if entry.setting.optimum is not None and entry.name == "scheduler":
        yield "optimum", [entry.setting.optimum] * count
    for model in entry.models:
        yield "agent", [f"model:{model},price={{price}}"] * count


def test_cases(suite: Suite, runner: Runner, classes: Sequence[ClassRecord]) -> None:
    """Test the rule, and the agent with the least validation cost, in every perturbed case."""
    places: list[tuple[ClassRecord, str]] = []
    jobs: list[TestJob] = []
    for entry in classes:
        agent = f"model:{entry.models[entry.best_agent]},price={{price}}"
        prices = entry.prices[1:4]  # the middle ones
        for case in (None, *suite.cases_of(entry.setting)):
            places.append((entry, "as assumed" if case is None else case.name))
            for text in (entry.rule, agent):
                policies = [text] * len(prices)
                jobs.append(entry.test(policies, suite.case_episodes, case=case, prices=prices))
    results = runner.run(run_test, jobs, "perturbed cases")
    for place, (entry, name) in enumerate(places):
        entry.cases[name] = results[2 * place], results[2 * place + 1]


def check_policy(suite: Suite, text: str, name: ClassName) -> None:
    """Refuse a policy that does not exist in every setting, or knows more than its class."""
    for setting in suite.settings:
        policy, knower = (
            make_policy(text.replace("{price}", "1.0"), setting.task(name)),
            knowledge_of(setting, name),
        )
        if not covers(knower, policy.knowledge):
            raise ConfigurationError(
                f"policy = {text!r} is not allowed with class = {name!r} in {setting.name}: it "
                f"declares knowledge = {policy.knowledge!r}, and the class has {knower!r}"
            )


def evaluate_policy(suite: Suite, runner: Runner, text: str, name: ClassName) -> list[ClassRecord]:
    """Test a policy in a class of every setting, together with the searched rule."""
    classes = find_prices(suite, runner, (name,))
    find_rules(suite, runner, classes)
    kinds = {REFERENCE: [entry.rule for entry in classes], "policy": [text] * len(classes)}
    test_texts(suite, runner, classes, kinds)
    return classes


def search_again(suite: Suite, runner: Runner) -> list[ClassRecord]:
    """Search three random classes with four times the generations and other episodes."""
    classes = find_prices(suite, runner)
    find_rules(suite, runner, classes)
    drawn = np.random.default_rng(0).choice(len(classes), min(3, len(classes)), replace=False)
    classes = [classes[place] for place in sorted(drawn)]
    generations = 4 * suite.generations
    jobs = [
        SearchJob(
            c.setting, c.name, c.prices, generations, runner.folder / "searches", 2_000_000_000
        )
        for c in classes
    ]
    texts = [f"{text},price={{price}}" for text in runner.run(run_search, jobs, "second searches")]
    test_texts(
        suite, runner, classes, {REFERENCE: [entry.rule for entry in classes], "second": texts}
    )
    return classes


def test_texts(
    suite: Suite, runner: Runner, classes: Sequence[ClassRecord], kinds: dict[str, list[str]]
) -> None:
    """Test one policy of every kind for each class, at all prices."""
    for kind, texts in kinds.items():
        jobs = [
            entry.test([text] * len(entry.prices), suite.episodes)
            for entry, text in zip(classes, texts, strict=True)
        ]
        for entry, outcomes in zip(classes, runner.run(run_test, jobs, kind), strict=True):
            entry.tests[kind] = [outcomes]


def policy_rows(suite: Suite, classes: Sequence[ClassRecord]) -> list[TestRow]:
    """Return a row for every policy at every price."""
    return [
        TestRow(
            entry.setting.name, entry.name, kind, seed, share, o.price, float(o.cost.mean()),
            float(o.error.mean()), float(o.tokens.mean()), o.mse, o.rate,
            "" if kind == "agent" else o.policy,
        )
        for entry in classes
        for kind, every in entry.tests.items()
        for seed, outcomes in enumerate(every)
        for share, o in zip(suite.shares, outcomes, strict=True)
    ]  # fmt: skip


def point_rows(suite: Suite, classes: Sequence[ClassRecord]) -> list[PointRow]:
    """Return the difference to the searched rule at every price."""
    places: list[tuple[ClassRecord, str, float, float]] = []
    results: list[Difference] = []
    for entry in classes:
        reference = entry.tests[REFERENCE][0]
        for kind, every in entry.tests.items():
            if kind == REFERENCE:
                continue
            for place, price in enumerate(entry.prices):
                costs = [outcomes[place].cost for outcomes in every]
                places.append((entry, kind, suite.shares[place], price))
                results.append(cost_difference(costs, reference[place].cost))
    counts = discoveries([item.p for item in results])
    return [
        PointRow(entry.setting.name, entry.name, kind, share, price, d.mean, d.low, d.high, counted)
        for (entry, kind, share, price), d, counted in zip(places, results, counts, strict=True)
    ]


def class_rows(classes: Sequence[ClassRecord]) -> list[ClassRow]:
    """Return the mean difference to the searched rule over a class's prices.

    The proven bound is a kind of its own, without an interval.
    """
    rows = [
        ClassRow(entry.setting.name, entry.name, kind, d.mean, d.low, d.high)
        for entry in classes
        for kind, every in entry.tests.items()
        if kind != REFERENCE
        for d in [over_prices(every, entry.tests[REFERENCE][0])]
    ]
    for entry in classes:
        if entry.bounds:
            costs = [float(outcome.cost.mean()) for outcome in entry.tests[REFERENCE][0]]
            below = float(np.mean(np.divide(entry.bounds, costs))) - 1.0
            rows.append(ClassRow(entry.setting.name, entry.name, "bound", below, below, below))
    return rows


def choice_rows(classes: Sequence[ClassRecord]) -> list[ChoiceRow]:
    """Return the policy of each class with the least validation cost, and the effect of memory."""
    rows = []
    for entry in classes:
        kind, seed = entry.choice
        d = over_prices([entry.tests[kind][seed]], entry.tests[REFERENCE][0])
        memory = float("nan")
        if entry.memoryless is not None:
            costs = [
                entry.memoryless.best(price).cost / entry.sweep.best(price).cost
                for price in entry.prices
            ]
            memory = float(np.mean(costs)) - 1.0
        rows.append(
            ChoiceRow(
                entry.setting.name, entry.name, kind, d.mean, d.low, d.high, memory, entry.rule
            )
        )
    return rows


def case_rows(classes: Sequence[ClassRecord]) -> list[CaseRow]:
    """Return the costs of every scheduler's rule and agent in the perturbed cases."""
    rows = []
    for entry in classes:
        for case, (rule, agent) in entry.cases.items():
            base = entry.cases["as assumed"][0]
            d = over_prices([agent], rule)
            change = over_prices([rule], base).mean
            rows.append(CaseRow(entry.setting.name, case, change, d.mean, d.low, d.high))
    return rows
