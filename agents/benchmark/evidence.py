"""The benchmark from sweeps to rows: every class's prices, rule, agents, tests and verdict."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from agents.benchmark.bounds import Bound, run_bound
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
from agents.benchmark.training import Training, run_training
from agents.benchmark.verdict import (
    Difference,
    Test,
    TestOutcome,
    cost_difference,
    discoveries,
    over_prices,
    run_test,
)
from fusion_gym.core.system import covers
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

TestOutcomes = tuple[TestOutcome, ...]
REFERENCE = "rule"


@dataclass
class Class:
    """A class of a setting: what is known of it so far, by kind of policy and training seed."""

    setting: Setting
    name: ClassName
    sweep: SweepResult
    memoryless: SweepResult | None = None
    rule: str = ""
    models: list[Path] = field(default_factory=list)
    tests: dict[str, list[TestOutcomes]] = field(default_factory=dict)
    validations: dict[str, list[TestOutcomes]] = field(default_factory=dict)
    bounds: tuple[float, ...] = ()
    cases: dict[str, tuple[TestOutcomes, TestOutcomes]] = field(default_factory=dict)

    @property
    def prices(self) -> tuple[float, ...]:
        """Return the class's prices, from the lowest to the highest."""
        return self.sweep.prices

    def test(
        self, policies: Sequence[str], episodes: int, seed: int = TEST_SEED,
        case: Case | None = None, prices: Sequence[float] | None = None,
    ) -> Test:  # fmt: skip
        """Return the test of policies, one a price; an agent's file counts by its content."""
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
        return Test(
            self.setting, self.name, texts, own_prices, self.prices, episodes, seed, content,
            agent, None, case,
        )  # fmt: skip

    @property
    def best_agent(self) -> int:
        """Return the training seed of the agent with the least cost in validation."""
        reference = self.validations[REFERENCE][0]
        scores = [over_prices([outcomes], reference).mean for outcomes in self.validations["agent"]]
        return int(np.argmin(scores))

    @property
    def choice(self) -> tuple[str, int]:
        """Return the kind and the seed of the policy with the least cost in validation."""
        reference = self.validations[REFERENCE][0]
        scores = {
            (kind, seed): over_prices([outcomes], reference).mean
            for kind, every in self.validations.items()
            for seed, outcomes in enumerate(every)
        }
        return min(scores, key=scores.__getitem__)


def gather(suite: Suite, runner: Runner) -> list[Class]:
    """Do what is not finished, and return all classes."""
    classes = find_prices(suite, runner)
    find_rules(suite, runner, classes)
    train_agents(suite, runner, classes)
    jobs = [Bound(of.setting, of.name, of.prices) for of in classes]
    for of, bounds in zip(classes, runner.run(run_bound, jobs, "bounds"), strict=True):
        of.bounds = bounds
    test_all(suite, runner, classes)
    test_cases(suite, runner, [of for of in classes if of.name == "scheduler"])
    return classes


def find_prices(suite: Suite, runner: Runner, names: Sequence[ClassName] = CLASSES) -> list[Class]:
    """Tune the rules with one threshold, and freeze the prices of the classes."""

    def sweep(
        setting: Setting, name: ClassName, memory: bool, prices: tuple[float, ...] = ()
    ) -> SweepJob:
        rules = rules_of(setting, name, suite.rules, memory)
        return SweepJob(setting, name, memory, rules, suite.shares, suite.tuning_episodes, prices)

    places = [(setting, name) for setting in suite.settings for name in names]
    jobs = [sweep(setting, name, setting.has_memory(name)) for setting, name in places]
    results = runner.run(run_sweep, jobs, "single thresholds")
    classes = [Class(*place, result) for place, result in zip(places, results, strict=True)]
    others = [of for of in classes if of.setting.has_memory(of.name)]
    jobs = [sweep(of.setting, of.name, False, of.prices) for of in others]
    results = runner.run(run_sweep, jobs, "single thresholds without memory")
    for of, result in zip(others, results, strict=True):
        of.memoryless = result
    return classes


def find_rules(suite: Suite, runner: Runner, classes: Sequence[Class]) -> None:
    """Search one rule for all prices of each class."""
    jobs = [
        SearchJob(of.setting, of.name, of.prices, suite.generations, runner.folder / "searches")
        for of in classes
    ]
    for of, text in zip(classes, runner.run(run_search, jobs, "searches"), strict=True):
        of.rule = f"{text},price={{price}}"


def train_agents(suite: Suite, runner: Runner, classes: Sequence[Class]) -> None:
    """Train the agents of each class, one a seed."""
    places = [(of, seed) for of in classes for seed in range(suite.training_seeds)]
    jobs = []
    for of, seed in places:
        folder = runner.folder / "agents" / f"{of.setting.name}_{of.name}_{seed}"
        experiment = suite.experiment(of.setting, of.name, of.prices, seed)
        jobs.append(Training(of.setting, of.name, experiment, folder))
    runner.run(run_training, jobs, "trainings")
    for (of, _), job in zip(places, jobs, strict=True):
        of.models.append(job.model)


def test_all(suite: Suite, runner: Runner, classes: Sequence[Class]) -> None:
    """Test every kind of policy on the test episodes, and rules and agents in validation."""
    places: list[tuple[Class, str, bool]] = []
    jobs: list[Test] = []
    for of in classes:
        for kind, policies in policies_of(of):
            places.append((of, kind, True))
            jobs.append(of.test(policies, suite.episodes))
            if kind in (REFERENCE, "agent"):
                places.append((of, kind, False))
                jobs.append(of.test(policies, suite.validation_episodes, VALIDATION_SEED))
    for (of, kind, final), outcomes in zip(
        places, runner.run(run_test, jobs, "tests"), strict=True
    ):
        tests = of.tests if final else of.validations
        tests.setdefault(kind, []).append(outcomes)


def policies_of(of: Class) -> Iterator[tuple[str, list[str]]]:
    """Yield the policies of a class, one a price, with their kind."""
    count = len(of.prices)
    yield REFERENCE, [of.rule] * count
    yield "threshold", [of.sweep.best(price).policy for price in of.prices]
    trigger = of.setting.trigger.policy
    if any(tuned.rule == trigger for tuned in of.sweep.tuned):
        yield "trigger", [of.sweep.best(price, trigger).policy for price in of.prices]
    if of.setting.optimum is not None and of.name == "scheduler":
        yield "optimum", [of.setting.optimum] * count
    for model in of.models:
        yield "agent", [f"model:{model},price={{price}}"] * count


def test_cases(suite: Suite, runner: Runner, classes: Sequence[Class]) -> None:
    """Test the rule, and the agent that validation prefers, in every perturbed case."""
    places: list[tuple[Class, str]] = []
    jobs: list[Test] = []
    for of in classes:
        agent = f"model:{of.models[of.best_agent]},price={{price}}"
        prices = of.prices[1:4]  # the middle ones
        for case in (None, *suite.cases_of(of.setting)):
            places.append((of, "as assumed" if case is None else case.name))
            for text in (of.rule, agent):
                policies = [text] * len(prices)
                jobs.append(of.test(policies, suite.case_episodes, case=case, prices=prices))
    results = runner.run(run_test, jobs, "perturbed cases")
    for place, (of, name) in enumerate(places):
        of.cases[name] = results[2 * place], results[2 * place + 1]


def check_policy(suite: Suite, text: str, name: ClassName) -> None:
    """Check that a policy exists in every setting, and knows no more than a class.

    Raises:
        ConfigurationError: it does not, or it looks at more than its class knows.
    """
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


def evaluate_policy(suite: Suite, runner: Runner, text: str, name: ClassName) -> list[Class]:
    """Test anybody's policy in a class of every setting, beside the searched rule."""
    classes = find_prices(suite, runner, (name,))
    find_rules(suite, runner, classes)
    kinds = {REFERENCE: [of.rule for of in classes], "policy": [text] * len(classes)}
    test_texts(suite, runner, classes, kinds)
    return classes


def search_again(suite: Suite, runner: Runner) -> list[Class]:
    """Search three classes, drawn by a seed, with four times the generations and other episodes."""
    classes = find_prices(suite, runner)
    find_rules(suite, runner, classes)
    drawn = np.random.default_rng(0).choice(len(classes), min(3, len(classes)), replace=False)
    classes = [classes[place] for place in sorted(drawn)]
    jobs = [
        SearchJob(of.setting, of.name, of.prices, 4 * suite.generations, runner.folder / "searches",
                  2_000_000_000)
        for of in classes
    ]  # fmt: skip
    texts = [f"{text},price={{price}}" for text in runner.run(run_search, jobs, "second searches")]
    test_texts(suite, runner, classes, {REFERENCE: [of.rule for of in classes], "second": texts})
    return classes


def test_texts(
    suite: Suite, runner: Runner, classes: Sequence[Class], kinds: dict[str, list[str]]
) -> None:
    """Test one policy for each class, at all prices, of every kind."""
    for kind, texts in kinds.items():
        jobs = [
            of.test([text] * len(of.prices), suite.episodes)
            for of, text in zip(classes, texts, strict=True)
        ]
        for of, outcomes in zip(classes, runner.run(run_test, jobs, kind), strict=True):
            of.tests[kind] = [outcomes]


def policy_rows(suite: Suite, classes: Sequence[Class]) -> list[TestRow]:
    """Return a row for every policy at every price."""
    return [
        TestRow(
            of.setting.name, of.name, kind, seed, share, o.price, float(o.cost.mean()),
            float(o.error.mean()), float(o.tokens.mean()), o.mse, o.rate,
            "" if kind == "agent" else o.policy,
        )
        for of in classes
        for kind, every in of.tests.items()
        for seed, outcomes in enumerate(every)
        for share, o in zip(suite.shares, outcomes, strict=True)
    ]  # fmt: skip


def point_rows(suite: Suite, classes: Sequence[Class]) -> list[PointRow]:
    """Return every difference to the searched rule, price by price."""
    places: list[tuple[Class, str, float, float]] = []
    results: list[Difference] = []
    for of in classes:
        reference = of.tests[REFERENCE][0]
        for kind, every in of.tests.items():
            if kind == REFERENCE:
                continue
            for place, price in enumerate(of.prices):
                costs = [outcomes[place].cost for outcomes in every]
                places.append((of, kind, suite.shares[place], price))
                results.append(cost_difference(costs, reference[place].cost))
    counts = discoveries([item.p for item in results])
    return [
        PointRow(of.setting.name, of.name, kind, share, price, d.mean, d.low, d.high, counted)
        for (of, kind, share, price), d, counted in zip(places, results, counts, strict=True)
    ]


def class_rows(classes: Sequence[Class]) -> list[ClassRow]:
    """Return every mean difference to the searched rule over a class's prices.

    The proven bound stands there as a kind of its own, without an interval.
    """
    rows = [
        ClassRow(of.setting.name, of.name, kind, d.mean, d.low, d.high)
        for of in classes
        for kind, every in of.tests.items()
        if kind != REFERENCE
        for d in [over_prices(every, of.tests[REFERENCE][0])]
    ]
    for of in classes:
        if of.bounds:
            costs = [float(outcome.cost.mean()) for outcome in of.tests[REFERENCE][0]]
            below = float(np.mean(np.divide(of.bounds, costs))) - 1.0
            rows.append(ClassRow(of.setting.name, of.name, "bound", below, below, below))
    return rows


def choice_rows(classes: Sequence[Class]) -> list[ChoiceRow]:
    """Return what validation chooses in each class, and what memory is worth there."""
    rows = []
    for of in classes:
        kind, seed = of.choice
        d = over_prices([of.tests[kind][seed]], of.tests[REFERENCE][0])
        memory = float("nan")
        if of.memoryless is not None:
            costs = [
                of.memoryless.best(price).cost / of.sweep.best(price).cost for price in of.prices
            ]
            memory = float(np.mean(costs)) - 1.0
        rows.append(
            ChoiceRow(of.setting.name, of.name, kind, d.mean, d.low, d.high, memory, of.rule)
        )
    return rows


def case_rows(classes: Sequence[Class]) -> list[CaseRow]:
    """Return the rule and the agent of every scheduler in the perturbed cases."""
    rows = []
    for of in classes:
        for case, (rule, agent) in of.cases.items():
            base = of.cases["as assumed"][0]
            d = over_prices([agent], rule)
            change = over_prices([rule], base).mean
            rows.append(CaseRow(of.setting.name, case, change, d.mean, d.low, d.high))
    return rows
