"""Rules with one threshold at each price of a class, and the search of one rule for all."""

from __future__ import annotations

import collections
import json
import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np

from agents.benchmark.jobs import Job
from agents.benchmark.settings import Case, ClassName, Setting, ThresholdRule, knowledge_of
from fusion_gym import seeds
from fusion_gym.arrays import Array
from fusion_gym.core.knowledge import covers
from fusion_gym.core.task import Task
from fusion_gym.evaluation.rule_search import (
    Generation,
    RuleSearch,
    SearchResult,
    ThresholdTrial,
    search_of_class,
    search_rule,
    try_thresholds,
)
from fusion_gym.output.files import fingerprint, replacing
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

COUNT = 16  # thresholds of a rule over its whole range
FINER = 6  # between the neighbours of the best one
NEAR = 1.1  # rules whose cost is so near the least, as a factor, are tuned finer


@dataclass(frozen=True)
class SweepJob(Job):
    """Every rule of a class over its thresholds, on a finer grid near the best at each price."""

    rules: tuple[ThresholdRule, ...]
    prices: tuple[float, ...]
    episodes: tuple[int, int]
    weight: ClassVar[float] = 25.0


@dataclass(frozen=True)
class TunedRule:
    """The best threshold of a rule at a price, and its cost on the tuning episodes."""

    rule: str
    price: float
    policy: str
    cost: float
    case: Case | None


@dataclass(frozen=True)
class SweepResult:
    """Every rule's best threshold at each price of a class."""

    tuned: tuple[TunedRule, ...]

    def best(self, price: float, rule: str | None = None) -> TunedRule:
        """Return the best rule with the setting's options, or the best threshold of one rule."""
        own = (
            t for t in self.tuned
            if t.price == price and (t.rule == rule if rule else t.case is None)
        )  # fmt: skip
        return min(own, key=lambda item: item.cost)

    def cheapest(self) -> list[str]:
        """Return the rules with the setting's options, the one that costs least at all first."""
        costs: dict[str, float] = collections.defaultdict(float)
        for row in self.tuned:
            costs[row.rule] += math.log(row.cost) if row.case is None else math.inf
        return sorted((rule for rule in costs if costs[rule] < math.inf), key=costs.__getitem__)


@dataclass(frozen=True)
class SearchJob(Job):
    """A search of one rule for all prices of a class, or of a rule's text at each price."""

    prices: tuple[float, ...]
    generations: int
    folder: Path = field(metadata={"key": False})
    rule: str | None = None
    parameters: tuple[str, ...] = ()
    case: Case | None = None
    weight: ClassVar[float] = 110.0


def run_sweep(job: SweepJob) -> SweepResult:
    """Tune every rule at each price on the tuning episodes."""
    tasks = {rule: job.setting.task(job.name, rule.case) for rule in job.rules}
    trials = {
        rule: _try(task, rule, np.geomspace(*rule.ends, COUNT), job.episodes[0])
        for rule, task in tasks.items()
    }
    tuned = []
    for price in job.prices:
        best = {rule: min(own, key=lambda t: t.cost(price)) for rule, own in trials.items()}
        least = min(trial.cost(price) for rule, trial in best.items() if rule.case is None)
        for rule, trial in best.items():
            if trial.cost(price) <= NEAR * least or rule == job.setting.trigger:
                trial = _finer(tasks[rule], job, rule, trials[rule], trial, price)
            cost = trial.cost(price)
            tuned.append(TunedRule(rule.policy, price, trial.policy, cost, rule.case))
    return SweepResult(tuple(tuned))


def rules_of(
    setting: Setting, name: ClassName, rules: Sequence[ThresholdRule]
) -> tuple[ThresholdRule, ...]:
    """Return the rules whose declared knowledge the class covers."""
    knower = knowledge_of(setting, name)
    result = []
    for rule in dict.fromkeys((setting.trigger, *setting.named_rules.values(), *rules)):
        try:
            task = setting.task(name, rule.case)
            policy = make_policy(rule.policy.format(value=rule.ends[0]), task)
        except ConfigurationError:  # a rule of another family
            continue
        if covers(knower, policy.knowledge):
            result.append(rule)
    return tuple(result)


def without_threshold(policy: str) -> tuple[str, str]:
    """Return the text of a rule without its threshold, and the threshold's name."""
    name, _, text = policy.partition(":")
    (own,) = re.findall(r"(\w+)=\{value\}", text)
    others = [entry for entry in text.split(",") if "{value}" not in entry]
    return (f"{name}:{','.join(others)}" if others else name), own


def _try(task: Task, rule: ThresholdRule, values: Array, episodes: int) -> list[ThresholdTrial]:
    return try_thresholds(task, rule.policy, values.tolist(), episodes, seeds.TUNING.start)


def _finer(
    task: Task, job: SweepJob, rule: ThresholdRule, own: Sequence[ThresholdTrial],
    best: ThresholdTrial, price: float,
) -> ThresholdTrial:  # fmt: skip
    """Return the best threshold between the neighbours of the best one, on more episodes."""
    place = own.index(best)
    ends = own[max(place - 1, 0)].threshold, own[min(place + 1, len(own) - 1)].threshold
    trials = _try(task, rule, np.geomspace(*ends, FINER), job.episodes[1])
    return min(trials, key=lambda trial: trial.cost(price))


def run_search(job: SearchJob) -> SearchResult:
    """Return the searched rule; the folder holds unfinished generations."""
    task, count = job.setting.task(job.name, job.case), job.generations
    if job.rule is None:
        search = search_of_class(job.name, task, job.prices, generations=count)
    else:
        search = RuleSearch(task, job.prices, job.rule, job.parameters, generations=count)
    state = job.folder / f"{fingerprint(job.inputs)}.json"
    state.parent.mkdir(parents=True, exist_ok=True)
    content = json.loads(state.read_text()) if state.exists() else []
    earlier = [Generation(**item) for item in content]
    generations = list(earlier)

    def store(generation: Generation) -> None:
        generations.append(generation)
        with replacing(state) as partial:
            partial.write_text(json.dumps([asdict(item) for item in generations]))

    return search_rule(search, earlier, store)
