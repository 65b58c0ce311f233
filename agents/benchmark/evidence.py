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
class Evidence:
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


def gather(suite: Suite, runner: Runner) -> list[Evidence]:
    """Run unfinished work, and return all classes."""
    classes = find_prices(suite, runner)
    find_rules(suite, runner, classes)
    train_agents(suite, runner, classes)
    jobs = [BoundJob(item.setting, item.name, item.prices) for item in classes]
    for item, bounds in zip(classes, runner.run(run_bound, jobs, "bounds"), strict=True):
        item.bounds = bounds
    test_all(suite, runner, classes)
    test_cases(suite, runner, [item for item in classes if item.name == "scheduler"])
    return classes


def find_prices(
    suite: Suite, runner: Runner, names: Sequence[ClassName] = CLASSES
) -> list[Evidence]:
    """Tune the rules with one threshold, and freeze the prices of the classes."""

    def sweep(
        setting: Setting, name: ClassName, memory: bool, prices: tuple[float, ...] = ()
    ) -> SweepJob:
        rules = rules_of(setting, name, suite.rules, memory)
        return SweepJob(setting, name, memory, rules, suite.shares, suite.tuning_episodes, prices)

    places = [(setting, name) for setting in suite.settings for name in names]
    jobs = [sweep(setting, name, setting.has_memory(name)) for setting, name in places]
    results = runner.run(run_sweep, jobs, "single thresholds")
    classes = [Evidence(*place, result) for place, result in zip(places, results, strict=True)]
    others = [item for item in classes if item.setting.has_memory(item.name)]
    jobs = [sweep(item.setting, item.name, False, item.prices) for item in others]
    results = runner.run(run_sweep, jobs, "single thresholds without memory")
    for item, result in zip(others, results, strict=True):
        item.memoryless = result
    return classes


def find_rules(suite: Suite, runner: Runner, classes: Sequence[Evidence]) -> None:
    """Search one rule for all prices of each class."""
    jobs = [
        SearchJob(
            item.setting, item.name, item.prices, suite.generations, runner.folder / "searches"
        )
        for item in classes
    ]
    for item, text in zip(classes, runner.run(run_search, jobs, "searches"), strict=True):
        item.rule = f"{text},price={{price}}"


def train_agents(suite: Suite, runner: Runner, classes: Sequence[Evidence]) -> None:
    """Train one agent per class and seed."""
    places = [(item, seed) for item in classes for seed in range(suite.training_seeds)]
    jobs = []
    for item, seed in places:
        folder = runner.folder / "agents" / f"{item.setting.name}_{item.name}_{seed}"
        experiment = suite.experiment(item.setting, item.name, item.prices, seed)
        jobs.append(TrainingJob(item.setting, item.name, experiment, folder))
    runner.run(run_training, jobs, "trainings")
    for (item, _), job in zip(places, jobs, strict=True):
        item.models.append(job.model)


def test_all(suite: Suite, runner: Runner, classes: Sequence[Evidence]) -> None:
    """Test every kind of policy on the test episodes, and rules and agents in validation."""
    places: list[tuple[Evidence, str, bool]] = []
    jobs: list[TestJob] = []
    for item in classes:
        for kind, policies in policies_of(item):
            case = item.setting.trigger.case if kind == "trigger" else None
            places.append((item, kind, True))
            jobs.append(item.test(policies, suite.episodes, case=case))
            if kind in (REFERENCE, "agent"):
                places.append((item, kind, False))
                jobs.append(item.test(policies, suite.validation_episodes, VALIDATION_SEED))
    for (item, kind, final), outcomes in zip(
        places, runner.run(run_test, jobs, "tests"), strict=True
    ):
        tests = item.tests if final else item.validations
        tests.setdefault(kind, []).append(outcomes)


def policies_of(item: Evidence) -> Iterator[tuple[str, list[str]]]:
    """Yield the kinds of policy of a class, each with one policy per price."""
    count = len(item.prices)
    yield REFERENCE, [item.rule] * count
    yield "threshold", [item.sweep.best(price).policy for price in item.prices]
    trigger = item.setting.trigger.policy
    if any(tuned.rule == trigger for tuned in item.sweep.tuned):
        yield "trigger", [item.sweep.best(price, trigger).policy for price in item.prices]
    if item.setting.optimum is not None and item.name == "scheduler":
        yield "optimum", [item.setting.optimum] * count
    for model in item.models:
        yield "agent", [f"model:{model},price={{price}}"] * count


def test_cases(suite: Suite, runner: Runner, classes: Sequence[Evidence]) -> None:
    """Test the rule, and the agent with the least validation cost, in every perturbed case."""
    places: list[tuple[Evidence, str]] = []
    jobs: list[TestJob] = []
    for item in classes:
        agent = f"model:{item.models[item.best_agent]},price={{price}}"
        prices = item.prices[1:4]  # the middle ones
        for case in (None, *suite.cases_of(item.setting)):
            places.append((item, "as assumed" if case is None else case.name))
            for text in (item.rule, agent):
                policies = [text] * len(prices)
                jobs.append(item.test(policies, suite.case_episodes, case=case, prices=prices))
    results = runner.run(run_test, jobs, "perturbed cases")
    for place, (item, name) in enumerate(places):
        item.cases[name] = results[2 * place], results[2 * place + 1]


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


def evaluate_policy(suite: Suite, runner: Runner, text: str, name: ClassName) -> list[Evidence]:
    """Test a policy in a class of every setting, together with the searched rule."""
    classes = find_prices(suite, runner, (name,))
    find_rules(suite, runner, classes)
    kinds = {REFERENCE: [item.rule for item in classes], "policy": [text] * len(classes)}
    test_texts(suite, runner, classes, kinds)
    return classes


def search_again(suite: Suite, runner: Runner) -> list[Evidence]:
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
        suite, runner, classes, {REFERENCE: [item.rule for item in classes], "second": texts}
    )
    return classes


def test_texts(
    suite: Suite, runner: Runner, classes: Sequence[Evidence], kinds: dict[str, list[str]]
) -> None:
    """Test one policy of every kind for each class, at all prices."""
    for kind, texts in kinds.items():
        jobs = [
            item.test([text] * len(item.prices), suite.episodes)
            for item, text in zip(classes, texts, strict=True)
        ]
        for item, outcomes in zip(classes, runner.run(run_test, jobs, kind), strict=True):
            item.tests[kind] = [outcomes]


def policy_rows(suite: Suite, classes: Sequence[Evidence]) -> list[TestRow]:
    """Return a row for every policy at every price."""
    return [
        TestRow(
            item.setting.name, item.name, kind, seed, share, o.price, float(o.cost.mean()),
            float(o.error.mean()), float(o.tokens.mean()), o.mse, o.rate,
            "" if kind == "agent" else o.policy,
        )
        for item in classes
        for kind, every in item.tests.items()
        for seed, outcomes in enumerate(every)
        for share, o in zip(suite.shares, outcomes, strict=True)
    ]  # fmt: skip


def point_rows(suite: Suite, classes: Sequence[Evidence]) -> list[PointRow]:
    """Return the difference to the searched rule at every price."""
    places: list[tuple[Evidence, str, float, float]] = []
    results: list[Difference] = []
    for item in classes:
        reference = item.tests[REFERENCE][0]
        for kind, every in item.tests.items():
            if kind == REFERENCE:
                continue
            for place, price in enumerate(item.prices):
                costs = [outcomes[place].cost for outcomes in every]
                places.append((item, kind, suite.shares[place], price))
                results.append(cost_difference(costs, reference[place].cost))
    counts = discoveries([item.p for item in results])
    return [
        PointRow(item.setting.name, item.name, kind, share, price, d.mean, d.low, d.high, counted)
        for (item, kind, share, price), d, counted in zip(places, results, counts, strict=True)
    ]


def class_rows(classes: Sequence[Evidence]) -> list[ClassRow]:
    """Return the mean difference to the searched rule over a class's prices.

    The proven bound is a kind of its own, without an interval.
    """
    rows = [
        ClassRow(item.setting.name, item.name, kind, d.mean, d.low, d.high)
        for item in classes
        for kind, every in item.tests.items()
        if kind != REFERENCE
        for d in [over_prices(every, item.tests[REFERENCE][0])]
    ]
    for item in classes:
        if item.bounds:
            costs = [float(outcome.cost.mean()) for outcome in item.tests[REFERENCE][0]]
            below = float(np.mean(np.divide(item.bounds, costs))) - 1.0
            rows.append(ClassRow(item.setting.name, item.name, "bound", below, below, below))
    return rows


def choice_rows(classes: Sequence[Evidence]) -> list[ChoiceRow]:
    """Return the policy of each class with the least validation cost, and the effect of memory."""
    rows = []
    for item in classes:
        kind, seed = item.choice
        d = over_prices([item.tests[kind][seed]], item.tests[REFERENCE][0])
        memory = float("nan")
        if item.memoryless is not None:
            costs = [
                item.memoryless.best(price).cost / item.sweep.best(price).cost
                for price in item.prices
            ]
            memory = float(np.mean(costs)) - 1.0
        rows.append(
            ChoiceRow(item.setting.name, item.name, kind, d.mean, d.low, d.high, memory, item.rule)
        )
    return rows


def case_rows(classes: Sequence[Evidence]) -> list[CaseRow]:
    """Return the costs of every scheduler's rule and agent in the perturbed cases."""
    rows = []
    for item in classes:
        for case, (rule, agent) in item.cases.items():
            base = item.cases["as assumed"][0]
            d = over_prices([agent], rule)
            change = over_prices([rule], base).mean
            rows.append(CaseRow(item.setting.name, case, change, d.mean, d.low, d.high))
    return rows
