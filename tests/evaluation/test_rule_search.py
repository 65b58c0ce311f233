"""The search over the numbers of a rule: it lowers the cost, goes on where it stopped, repeats."""

import dataclasses
import functools
import json
from typing import Any, ClassVar

import numpy as np
import pytest
from refusals import refused

import fusion_gym
from fusion_gym.core.knowledge import Signals
from fusion_gym.core.task import Task
from fusion_gym.evaluation import rule_search
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes, run_priced
from fusion_gym.evaluation.rule_search import (
    Generation,
    RuleSearch,
    ThresholdTrial,
    make_loop,
    run_generations,
    search_of_class,
    search_result,
    search_rule,
    try_thresholds,
)
from fusion_gym.policies.base import Requests, Rule, shape_of
from fusion_gym.policies.registry import make_policy, policy_maker, policy_names, search_ranges
from fusion_gym.policies.rules import InnovationThreshold
from fusion_gym.validation import ConfigurationError

pytest.importorskip("cmaes")
PRICES = (0.01, 0.1, 1.0)


@functools.cache
def task_of(**options: Any) -> Task:
    options = {"filter": "tobit", "horizon": 40, "memory": True} | options
    return fusion_gym.make_task("fusion_gym/TobitOscillator-v1", **options)


def small(**changes: Any) -> RuleSearch:
    options = {"generations": 4, "population": 4, "episodes": (4, 8), "seed": 10**6}
    return RuleSearch(task_of(), PRICES, **(options | changes))


def means_of(error_cost: Any, tokens: Any) -> EpisodeResults:
    others = {field.name: error_cost for field in dataclasses.fields(EpisodeResults)}
    return EpisodeResults(**others | {"tokens": tokens})


def test_costs_beside_each_other_are_those_of_episodes() -> None:
    task, text = task_of(), "priced_threshold:threshold=0.3"
    rules = [f"{text},price={price}" for price in PRICES]
    seeds, prices = np.tile(np.arange(5, 11), 3), np.repeat(PRICES, 6)
    priced = run_priced(task, make_policy(text, task), seeds, prices)
    singles = [run_episodes(task, make_policy(rule, task), 6, 5) for rule in rules]
    every = zip(singles, PRICES, strict=True)
    costs = [single.error_cost + price * single.tokens for single, price in every]
    np.testing.assert_allclose(priced.cost(prices), np.concatenate(costs), rtol=1e-12)
    assert len({float(single.tokens.mean()) for single in singles}) == 3


@pytest.mark.slow
def test_a_search_from_a_bad_start_lowers_the_cost() -> None:
    """Bounds allow too large thresholds only: the search saves a quarter on fresh episodes."""
    search = small(bounds=(0.5, 1.0), generations=16, population=8, episodes=(4, 16))
    every: list[Generation] = []
    result = search_rule(search, progress=every.append)
    assert [generation.number for generation in every] == list(range(16))
    assert all(len(generation.objectives) == 8 for generation in every)
    costs = np.zeros((2, len(PRICES)))
    for place, price in enumerate(PRICES):
        policies = f"{result.policies[place]},price={price}", search.start[place].policy
        for row, text in zip(costs, policies, strict=True):
            single = run_episodes(task_of(), make_policy(text, task_of()), 100, 0)
            row[place] = (single.error_cost + price * single.tokens).mean()
    assert (costs[0] / costs[1]).mean() < 0.75
    assert result.relative < -0.25
    assert result.relative == pytest.approx((costs[0] / costs[1]).mean() - 1.0, abs=0.15)


@pytest.mark.slow
def test_a_resumed_search_is_the_uninterrupted_one() -> None:
    every = list(run_generations(small()))
    assert len(every) == 4
    assert every == list(run_generations(small()))
    assert every != list(run_generations(small(seed=7)))
    states = json.loads(json.dumps([dataclasses.asdict(item) for item in every[:2]]))
    earlier = [Generation(**state) for state in states]
    assert list(run_generations(small(), earlier)) == every[2:]
    result = search_rule(small(), earlier)
    assert result == search_result(small(), every) == search_rule(small(), every)
    assert result.policies[0].startswith("priced_threshold:reference_price=0.1,threshold=")
    make_policy(result.policies[0], task_of())
    refused(lambda: list(run_generations(small(seed=7), earlier)), "earlier[0]")
    refused(lambda: search_result(small(), []), "generations = [] ", "one or more at each price")


@pytest.fixture
def seeds(monkeypatch: pytest.MonkeyPatch) -> list[set[int]]:
    """The seeds of every batch of a search, whose episodes are not run."""
    batches: list[set[int]] = []

    def means(seeds: Any) -> EpisodeResults:
        batches.append(set(np.asarray(seeds).tolist()))
        return means_of(np.ones(len(seeds)), np.ones(len(seeds)))

    def policy(task: Task, rule: Any, episodes: int, seed: int) -> EpisodeResults:
        return means(seed + np.arange(episodes))

    def policies(task: Task, rules: Any, episodes: int, seed: int) -> list[EpisodeResults]:
        return [policy(task, None, episodes, seed)] * len(rules)

    monkeypatch.setattr(rule_search, "run_several", policies)
    return batches


def test_a_search_runs_no_episode_twice(seeds: list[set[int]]) -> None:
    """Of the start, of each generation and of the end, which measures both rules on the same."""
    search_rule(small())
    phases = [batch for place, batch in enumerate(seeds) if batch not in seeds[:place]]
    assert [len(batch) for batch in phases] == [16, 4, 5, 6, 8, 32]
    assert len(set().union(*phases)) == sum(map(len, phases))
    assert phases[-1] == seeds[-1] == seeds[-2]


@pytest.mark.usefixtures("seeds")
def test_the_result_is_the_mean_of_the_second_half() -> None:
    search, zero = small(), np.zeros(len(small().coordinates))
    means = [zero + value for value in (9.0, 7.0, 0.2, 0.4)]
    halves = [Generation(place, (), mean.tolist()) for place, mean in enumerate(means)]
    single = Generation(0, (), (zero + 0.3).tolist())
    assert search_result(search, halves).policies == search_result(search, [single]).policies


def test_a_cost_without_number_is_the_worst(monkeypatch: pytest.MonkeyPatch) -> None:
    """NaN or infinite; other objectives are the mean ratio to the single thresholds."""
    search = small()
    singles = [ThresholdTrial("", 1.0, 10.0, error) for error in (0.9, 1.0, 0.0)]
    search.__dict__["start"] = tuple(singles)  # at the prices .01, .1, 1 they cost 1, 2, 10

    def run(task: Task, rules: Any, episodes: int, seed: int) -> list[EpisodeResults]:
        errors = {1.0: 1.0, float(np.exp(2.0)): np.nan, float(np.exp(1.0)): np.inf}
        every = (np.full(episodes, errors[rule.margin]) for rule in rules)
        return [means_of(error, np.zeros(episodes)) for error in every]

    monkeypatch.setattr(rule_search, "run_several", run)
    points = np.zeros((3, len(search.coordinates)))
    points[:, search.coordinates.index("margin")] = 0.0, 2.0, 1.0
    costs = rule_search._objectives(search, points, 4, 0)
    assert costs[0] == pytest.approx((1.0 + 0.5 + 0.1) / 3.0)
    assert np.all((np.array(costs[1:]) > 1e29) & np.isfinite(costs[1:]))


def test_trials_are_what_each_policy_does_alone() -> None:
    task, template = task_of(), "value_of_information:threshold={value},at_most=1"
    values = np.geomspace(0.001, 3.0, 6).tolist()
    trials = try_thresholds(task, template, values, 8, 3)
    for value, trial in zip(values, trials, strict=True):
        assert trial.policy == template.format(value=f"{value:.5g}")
        single = run_episodes(task, make_policy(trial.policy, task), 8, 3)
        cost = float((single.error_cost + 0.1 * single.tokens).mean())
        assert trial.cost(0.1) == pytest.approx(cost)
    message = r"template = 'always' .*: it must be a policy with"
    with pytest.raises(ConfigurationError, match=message):
        try_thresholds(task, "always", values, 2, 0)


LOOP_RULES = (
    *("innovation_threshold:threshold={value},whitened=true", "send_on_delta:threshold={value}"),
    *("variance_threshold:threshold={value},at_most=1", "information_gain:threshold={value}"),
    *("estimate_difference:threshold={value}", "kullback_leibler:threshold={value},at_most=1"),
    *("value_of_information:own=true,threshold={value}", "paced:rate={value}"),
    *("innovation_threshold:threshold={value}", "value_of_information:threshold={value}"),
    "priced_threshold:threshold={value},margin=1.5,token_exponent=-0.3,reference_price=0.1",
)
LOOP_TASKS: dict[str, tuple[str, dict[str, Any]]] = {
    "tobit": ("TobitOscillator-v1", {"filter": "tobit", "memory": True, "token_rate": 2.0}),
    "linear": (
        "LinearFusion-v2",
        {"memory": True, "cost_weight": "random", "price_range": (0.01, 1.0)},
    ),
    "biased": ("BiasedTracking-v1", {"access": "any", "tokens": "limited", "token_rate": 1.0}),
    "remote": ("RemoteEstimation-v1", {"sensors": 3, "channel": "gilbert_elliott"}),
}


@pytest.mark.parametrize(
    "name",
    [*(pytest.param(n, marks=pytest.mark.slow) for n in ("tobit", "biased")), "linear", "remote"],
)
def test_the_loop_in_machine_code_has_the_figures_of_numpy(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("llvmlite")
    env_id, options = LOOP_TASKS[name]
    task, loops = fusion_gym.make_task(f"fusion_gym/{env_id}", horizon=30, **options), []
    different = 0
    monkeypatch.setattr(
        rule_search, "make_loop", lambda *_: loops.append(make_loop(*_)) or loops[-1]
    )
    every = LOOP_RULES if name == "tobit" else LOOP_RULES[-4:]
    for rule in every:
        values, trials = [0.01, 0.2, 1.5] if "rate" not in rule else [0.1, 0.3, 0.6], []
        for fewest in (10**9, 0):
            monkeypatch.setattr(rule_search, "_FEWEST", fewest)
            try:
                trials.append(try_thresholds(task, rule, values, 30, 7))
            except ConfigurationError:  # a rule of another environment
                break
        else:
            assert loops[-1] is not None
            numpy, ours = (np.array([(t.tokens, t.error) for t in each]) for each in trials)
            np.testing.assert_allclose(ours, numpy, rtol=1e-10, err_msg=rule)
            different += len({*numpy[:, 0]}) > 1
    assert different > len(every) / 2


def test_a_search_in_machine_code_is_the_search_of_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("llvmlite")
    results = []
    for fewest in (10**9, 0):
        monkeypatch.setattr(rule_search, "_FEWEST", fewest)
        search = small()
        assert (search.loop is None) == (fewest > 0)
        results.append((every := list(run_generations(search)), search_result(search, every)))
    (numpy, one), (ours, other) = results
    for first, second in zip(numpy, ours, strict=True):
        np.testing.assert_allclose(second.objectives, first.objectives, rtol=1e-9)
        np.testing.assert_allclose(second.mean, first.mean, rtol=1e-7, atol=1e-9)
    assert other.policies == one.policies
    np.testing.assert_allclose(other.costs, one.costs, rtol=1e-9)
    np.testing.assert_allclose(other.threshold_costs, one.threshold_costs, rtol=1e-12)


@dataclasses.dataclass
class EveryOtherStep(Rule):
    """A rule with a variable."""

    knowledge: ClassVar[Any] = "clock"
    number: float

    def reset(self, runs: int, seed: int = 0) -> None:
        self.steps = 0

    def __call__(self, signals: Signals) -> Requests:
        self.steps += 1
        return np.full(shape_of(signals), self.steps % 2 == 0)


@dataclasses.dataclass
class Sometimes(InnovationThreshold):
    """A rule that draws in its call, and declares nothing of it."""

    def __call__(self, signals: Signals) -> Requests:
        return super().__call__(signals) & (np.random.default_rng().random() < 0.5)


@pytest.mark.parametrize(
    ("rule", "options"),
    [
        ("stochastic_event:weight={value}", {}),  # draws numbers
        ("innovation_threshold:threshold={value}", {"true_process_noise": 2.0}),
        ("innovation_threshold:threshold={value}", {"delay": 1, "memory": False}),
    ],
)
def test_numpy_runs_what_the_loop_does_not(
    rule: str, options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rule_search, "_FEWEST", 0)
    monkeypatch.setattr(rule_search.RuleLoop, "costs", None)
    assert len(try_thresholds(task_of(**options), rule, [0.5, 1.0], 3, 0)) == 2
    alternating = [EveryOtherStep(number) for number in (1.0, 2.0)]
    assert rule_search._means(task_of(), alternating, 2, 0)[1] == pytest.approx(4.5)
    drawing = [Sometimes(threshold) for threshold in (0.5, 1.0)]
    assert len(rule_search._means(task_of(), drawing, 2, 0)[1]) == 2


def test_coordinates_are_those_that_matter() -> None:
    names = ("threshold",) * 3 + ("price_exponent",) * 3 + ("mixture", "token_exponent")
    assert small().coordinates == (*names, "age_exponent", "margin", "margin_exponent")
    own = small(rule="priced_threshold:own=true")
    assert own.coordinates == (*names, "age_exponent")
    free = dataclasses.replace(small(), task=task_of(tokens="unlimited"), prices=(0.1,))
    assert free.coordinates == (*names[:3], "mixture", "age_exponent", "margin")
    values = free.values(np.zeros((2, 6)))
    assert [column.shape for column in values.values()] == [(3, 2)] + [(1, 2)] * 3
    assert [float(column[0, 0]) for column in values.values()] == [1.0, 0.0, 0.0, 1.0]


def test_the_start_fits_the_margin_to_the_prices() -> None:
    search = small()
    cheap, dear = search.start[0], search.start[-1]
    trials = (
        dataclasses.replace(cheap, policy="priced_threshold:margin=1"),
        *(dataclasses.replace(dear, policy="priced_threshold:margin=20") for _ in range(2)),
    )
    search.__dict__["start"] = trials
    point = dict(zip(search.coordinates, search.first_point(), strict=True))
    assert point["margin_exponent"] == pytest.approx(np.log(20.0) / np.log(100.0))
    assert point["margin"] == pytest.approx(2.0 / 3.0 * np.log(20.0))
    two = dataclasses.replace(search, prices=PRICES[::2])
    two.__dict__["start"] = trials[:2]
    assert two.coordinates == search.coordinates
    assert two.first_point()[-1] == pytest.approx(np.log(20.0) / np.log(100.0))
    rule: Any = make_policy("priced_threshold:margin=4,margin_exponent=1,price=0.1", task_of())
    same: Any = make_policy("priced_threshold:margin=1,price=0.1", task_of())  # 4 · 0.1 is below 1
    results = [run_episodes(task_of(), policy, 4, 0) for policy in (rule, same)]
    np.testing.assert_array_equal(results[0].tokens, results[1].tokens)


def test_a_class_is_searched_by_its_cheapest_score() -> None:
    options = {"generations": 1, "population": 4, "episodes": (4, 8)}
    search = search_of_class("local", task_of(), PRICES, **options)
    costs = {}
    for score in ("value", "innovation"):
        single: Any = dataclasses.replace(search, rule=f"priced_threshold:own=true,score={score}")
        costs[score] = np.log(single.start_costs(single.start)).sum()
    text = "priced_threshold:own={},score={}".format
    assert search.rule == text("true", min(costs, key=costs.__getitem__))
    assert search_of_class("scheduler", task_of(), PRICES).rule == text("false", "value")
    assert search_of_class("centre", task_of(), PRICES).rule == text("false", "variance")


@pytest.mark.parametrize(
    ("options", "score"),
    [({"information": "centre", "memory": False}, "variance"), ({}, "innovation")],
)
def test_other_scores_are_searched_too(options: dict[str, Any], score: Any) -> None:
    task = task_of(**options)
    changes = {"rule": f"priced_threshold:score={score}", "generations": 2}
    search = dataclasses.replace(small(bounds=(0.01, 10.0)), task=task, **changes)
    result = search_rule(search)
    assert f"score={score}" in result.policies[0]
    assert np.isfinite(result.costs).all()
    policy: Any = make_policy(result.policies[0], task)
    assert policy.knowledge == ("centre" if score == "variance" else "scheduler")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"prices": ()}, "prices = "),
        ({"prices": (0.1, 0.1)}, r"prices = .* it must be one or more different numbers$"),
        ({"prices": (0.1, -1.0)}, "prices = "),
        ({"generations": 0}, "generations = 0"),
        ({"population": 2}, "population = 2"),
        ({"episodes": (0, 4)}, "episodes = 0"),
        ({"seed": -1}, "seed = -1"),
        ({"rule": "priced_threshold:score=worth"}, "score = 'worth'"),
        ({"rule": "never"}, "rule = 'never' is not allowed: it must be a rule with parameters"),
        ({"parameters": ("price",)}, r"parameters = \['price'\] .* names of threshold, price_exp"),
    ],
)
def test_what_a_search_refuses(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        dataclasses.replace(small(), **changes)


@pytest.mark.parametrize("name", policy_names())
def test_the_ends_of_every_range_are_allowed(name: str) -> None:
    """With the default between them, alone and with the other parameters at the same end."""
    maker, ranges = policy_maker(name), search_ranges(name)
    fields: dict[str, Any] = {}
    if dataclasses.is_dataclass(maker):
        fields = {field.name: field.default for field in dataclasses.fields(maker)}
        task = {"task": task_of()} if "task" in fields else {}
        for end in (0, 1):
            ends = {n: own[end] for n, own in ranges.items() if np.isfinite(own[end])}
            maker(**task, **ends)
    for parameter, own in ranges.items():
        value = fields.get(parameter)
        fixed = own.low == own.high
        assert value is None or fixed or own.low <= value <= own.high
        if value is not None and own.logarithmic and own.low < value:
            assert own.value(own.coordinate(np.array(value))) == pytest.approx(value)


def test_the_parameters_of_a_search_are_allowed_together() -> None:
    task = fusion_gym.make_task("fusion_gym/UnknownInput-v1", horizon=20)
    search = RuleSearch(task, (0.1,), "adaptive_threshold", episodes=(2, 2))
    assert search.text == "adaptive_threshold:scale=10000"
    assert np.isfinite([trial.error for trial in search.start]).all()
    assert (search.values(search.first_point()[None])["rho_bar"] <= 1.0).all()
    points = np.random.default_rng(0).normal(0.0, 6.0, (50, len(search.coordinates)))
    values = search.values(points)
    assert (values["rho_initial"] <= values["rho_bar"]).all()
    assert (values["rho_bar"] <= 1.0).all()
    assert (values["max_interval"] >= values["min_interval"]).all()
    assert values["min_interval"].dtype.kind == "i"
    for point, rule in zip(points, search.rules(values, 0.1), strict=True):
        same: Any = make_policy(search.policy(point), task)
        assert same.rho_initial == pytest.approx(rule.rho_initial, rel=1e-4)
        assert (same.min_interval, same.max_interval) == (rule.min_interval, rule.max_interval)


def test_a_threshold_a_source_is_nearly_the_optimum() -> None:
    """Two sources of different noise share nothing: each has an optimal threshold of its own."""
    options = {"sensors": 2, "noise_deviation": (0.3, 3.0), "state_weights": (100.0, 0.01)}
    options |= {"tokens": "unlimited", "horizon": 100}
    task = fusion_gym.make_task("fusion_gym/RemoteEstimation-v1", access="any", **options)
    rule = "innovation_threshold:min_interval=1,max_interval=none"
    search = RuleSearch(task, (1.0,), rule, generations=20, population=8, episodes=(4, 16))
    result = search_rule(search)
    best = run_episodes(task, make_policy("optimal:price=1", task), 64, 10**6)
    optimum = float(best.cost(1.0).mean())
    assert 0.95 * optimum < result.costs[0] < 1.05 * optimum
    assert result.threshold_costs[0] > 1.2 * optimum


def test_rules_with_variables_and_tables_are_searched_too() -> None:
    task = fusion_gym.make_task("fusion_gym/RemoteEstimation-v1", sensors=2, horizon=20)
    for rule in ("dynamic_event", "whittle", "paced:staggered=false"):
        search = RuleSearch(task, (0.5,), rule, generations=2, population=3, episodes=(2, 4))
        result = search_rule(search)
        assert make_policy(result.policies[0], task).knowledge
        assert np.isfinite(result.costs).all()


def test_a_search_starts_with_the_better_of_two_scores() -> None:
    """Of the innovation in the sensor's unit and in deviations, whose start would cost more."""
    task = fusion_gym.make_task("fusion_gym/CorrelatedTracking-v1", horizon=30, token_rate=3.0)
    search = RuleSearch(task, (0.1, 2.0), "priced_threshold:score=innovation", episodes=(2, 8))
    starts = [[min(t.cost(p) for t in sweep) for p in search.prices] for sweep in search.sweeps]
    assert np.log(starts[1]).sum() < np.log(starts[0]).sum()
    point = dict(zip(search.coordinates, search.first_point(), strict=True))
    assert point["mixture"] == 1.0
