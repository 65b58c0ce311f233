"""The benchmark: prices, searched rules, agents, verdict, pages and the zoo made from it."""

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
import yaml
from benchmark_rows import read_rows
from command_runs import refusal, succeed
from paths import ROOT
from scipy import stats

import fusion_gym
from agents import cache
from agents.benchmark import evidence, rules, settings, training, verdict
from agents.benchmark.calibration import CalibrationResult
from agents.benchmark.report import draw_class, mean_text
from agents.benchmark.settings import CLASSES, knowledge_of, load_suite
from agents.benchmark.verdict import cost_difference, discoveries, mean_difference
from fusion_gym import zoo
from fusion_gym.core.knowledge import covers
from fusion_gym.evaluation.episodes import run_episodes, seeded
from fusion_gym.policies.base import guard
from fusion_gym.policies.registry import make_policy
from fusion_gym.policies.saved import CalibrationPoint, read_calibration
from fusion_gym.seeds import TEST

SMALL = {
    "episodes": 20,
    "tuning_episodes": [4, 4],
    "calibration_episodes": [2, 4],
    "case_episodes": 4,
    "generations": 1,
    "training_seeds": 2,
    "steps": 0.001,
    "cases": [{"name": "half the tokens", "tokens": 0.5}],
    "rules": [
        {"policy": "paced:rate={value}", "ends": [0.01, 1]},
        {"policy": "value_of_information:threshold={value}", "ends": [0.01, 60]},
        {"policy": "value_of_information:own=true,threshold={value}", "ends": [0.01, 60]},
    ],
}


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The words of a benchmark of one small setting."""
    content = yaml.safe_load(settings.FILE.read_text()) | SMALL
    (setting,) = (item for item in content["settings"] if item["name"] == "remote_estimation")
    setting |= {"cases": [], "num_envs": 8}
    setting["timesteps"]["scheduler"] = {
        "branching_ppo": 40_000_000,
        "counterfactual_ppo": 1_000_000,
    }
    setting["options"] |= {"horizon": 12}
    content["settings"] = [setting]
    (tmp_path / "settings.yaml").write_text(yaml.safe_dump(content))
    monkeypatch.setattr(settings, "FILE", tmp_path / "settings.yaml")
    places = ["--work", str(tmp_path / "work"), "--results", str(tmp_path / "results")]
    return [*places, "--workers", "1"]


@pytest.mark.slow
def test_from_prices_to_pages_and_zoo(
    small: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    printed = succeed("benchmark", small).out
    folder = tmp_path / "results"
    policies = read_rows(folder, evidence.TestRow)
    for name in CLASSES:
        for kind, seeds in (("rule", 1), ("threshold", 1), ("agent", 2), ("learned", 2)):
            own = [row for row in policies if (row.name, row.kind) == (name, kind)]
            assert len(own) == 5 * seeds
            prices = [row.price for row in own[:5]]
            assert prices == sorted(set(prices))
            for row in own:
                assert row.cost == pytest.approx(row.error + row.price * row.tokens, rel=1e-4)
    for kind in ("optimum", "other", "other_calibrated"):
        assert {row.name for row in policies if row.kind == kind} == {"scheduler"}
    means = read_rows(folder, evidence.ClassRow)
    points = read_rows(folder, evidence.PointRow)
    for mean in means:
        key = (mean.name, mean.kind)
        own_points = [point.difference for point in points if (point.name, point.kind) == key]
        assert mean.difference == pytest.approx(np.mean(own_points), abs=1e-4)
    trainings = read_rows(folder, evidence.TrainingRow)
    algorithms = [row.algorithm for row in trainings if row.name == "scheduler"]
    assert algorithms == ["branching_ppo"] * 2 + ["counterfactual_ppo"] * 2
    assert all(
        row.algorithm == "counterfactual_ppo" for row in trainings if row.name != "scheduler"
    )
    best = [row for row in trainings if row.best]
    assert sorted((row.name, row.seed) for row in best) == [
        (name, seed) for name in sorted(CLASSES) for seed in (0, 1)
    ]
    for row in best:
        own = [p for p in policies if (p.name, p.kind, p.seed) == (row.name, "learned", row.seed)]
        every = {
            kind: np.array([p.cost for p in policies if (p.name, p.kind) == (row.name, kind)])
            for kind in ("rule", "threshold", "thresholds", "trigger")
        }
        excess = [p.difference for p in points if (p.name, p.kind) == (row.name, "rule")]
        best = every["rule"] / (1.0 + np.array(excess))
        assert np.isclose(best, [*filter(len, every.values())], rtol=1e-4).any(axis=0).all()
        ratios = np.divide([p.cost for p in own], best)
        assert row.learned == pytest.approx(ratios.mean() - 1.0, abs=1e-4)
        # Where a rule remains alone, both policies are the same.
        assert 0 <= row.rule_points <= np.isclose(ratios, 1.0, atol=1e-4).sum()
    savings = {row.kind: row for row in read_rows(folder, evidence.SavingRow)}
    costs = {
        (kind, name): np.array([p.cost for p in policies if (p.kind, p.name) == (kind, name)])
        for kind in ("rule", "trigger")
        for name in CLASSES
    }
    expected = 1.0 - np.mean(costs["rule", "local"] / costs["trigger", "local"])
    assert savings["rule"].saving == pytest.approx(expected, abs=1e-4)
    assert savings["rule"].low <= savings["rule"].saving <= savings["rule"].high
    assert {row.name for row in savings.values()} == {"local"}
    assert {*savings} == {"thresholds", "rule", "informed", "learned"}
    cases = read_rows(folder, evidence.CaseRow)
    assert [row.case for row in cases] == ["as assumed", "half the tokens"]
    assert cases[0].rule == 0.0
    page = (folder / "README.md").read_text()
    assert re.search(
        r"\| Remote estimation +\| Whittle's index \(literature\), local sensors +\|", page
    )
    assert (folder / "remote_estimation.png").stat().st_size > 20_000
    assert "remote_estimation" in printed
    # Finished pieces are not done again.
    monkeypatch.setattr("agents.benchmark.jobs.Call", pytest.fail)
    succeed("benchmark", small)
    assert (folder / "README.md").read_text() == page
    place = ["--work", str(tmp_path / "work"), "--zoo", str(tmp_path / "zoo"), "--workers", "1"]
    succeed("zoo", place)
    card = json.loads((tmp_path / "zoo" / "remote_estimation_local.json").read_text())
    rows = [row for row in policies if (row.name, row.kind) == ("local", "calibrated")]
    costs = {f"{row.cost:.4g}" for row in rows}
    assert {f"{point['cost']:.4g}" for point in card["test"]["points"]} <= costs
    card = json.loads((tmp_path / "zoo" / "remote_estimation_scheduler.json").read_text())
    assert card["training"]["algorithm"]["name"] in algorithms


@pytest.mark.slow
def test_the_optimum_gains_mainly_in_the_last_steps() -> None:
    """With the rule before them most of its gain remains, as the page says."""
    card = zoo.card("remote_estimation_scheduler")
    rule = read_calibration(Path(zoo.model_path("remote_estimation_scheduler")))[0]
    (setting,) = load_suite(settings=("remote_estimation",)).settings
    task, numbers = setting.task("scheduler"), TEST[10_000_000] + np.arange(1500)
    costs = {"rule": 0.0, "late": 0.0, "optimum": 0.0}
    for price in card["test"]["prices"]:
        policies = [make_policy(f"{text}price={price}", task) for text in (f"{rule},", "optimal:")]
        for kind, change in (("rule", 100), ("late", 85), ("optimum", 0)):
            batch = seeded(task, None, numbers)
            decisions = [guard(policy, task) for policy in policies]
            for step in range(task.horizon):
                outcome = batch.step(decisions[step >= change](batch.signals()))
                costs[kind] += np.mean(price * outcome.cost - outcome.reward_error) / price
    gain = costs["rule"] - costs["optimum"]
    assert gain > 0.0
    assert costs["rule"] - costs["late"] > 0.6 * gain


@pytest.mark.slow
def test_the_suite_of_channels_tests_each_rule_and_agents_that_assign(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = yaml.safe_load(settings.FILE.with_stem("channels").read_text())
    for setting in content["settings"]:
        setting["options"] |= {"horizon": 12}
        setting |= {"num_envs": 8, "cases": setting.get("cases", [])[:1]}
    small = {name: value for name, value in SMALL.items() if name not in ("rules", "cases")}
    quick = {"steps": 1e-4, "training_seeds": 1}
    (tmp_path / "channels.yaml").write_text(yaml.safe_dump(content | small | quick))
    monkeypatch.setattr(settings, "FILE", tmp_path / "settings.yaml")
    monkeypatch.chdir(tmp_path)
    succeed("benchmark", ["--suite", "channels", "--workers", "1"])
    folder = tmp_path / "results" / "channels"
    rows, page = read_rows(folder, evidence.TestRow), (folder / "README.md").read_text()
    for setting in content["settings"]:
        costs = {
            kind: [row.cost for row in rows if (row.setting, row.kind) == (setting["name"], kind)]
            for kind in {row.kind for row in rows if row.setting == setting["name"]}
        }
        assert {len(own) for own in costs.values()} == {5}
        assert costs.keys() >= {"trigger", *setting["named_rules"], "agent", "learned"}
        assert (costs["agent"] == costs["calibrated"]) == (setting["name"] == "many_plants")
        others = [own for kind, own in costs.items() if kind not in ("learned", "agent")]
        assert all(cost in each for cost, *each in zip(costs["learned"], *others, strict=True))
        assert all(
            re.search(rf"\| {setting['title']} +\| {kind} +\|", page)
            for kind in setting["named_rules"]
        )
    assert "](../../docs/benchmark.md)" in page
    assert {row.name for row in rows} == {"centre", "scheduler"}
    algorithms = {row.algorithm for row in read_rows(folder, evidence.TrainingRow)}
    assert algorithms == {"counterfactual_ppo"}


def test_a_policy_of_ones_own_has_the_same_verdict(small: list[str]) -> None:
    text = "value_of_information:price={price}"
    printed = succeed("benchmark", [*small, "--policy", text, "--class", "scheduler"]).out
    assert "policy" in printed
    error = refusal("benchmark", [*small, "--policy", text, "--class", "centre"])
    assert "it declares knowledge = 'scheduler', and the class has 'centre'" in error
    assert "class = None is not allowed" in refusal("benchmark", [*small, "--policy", text])


def test_the_make_target_is_a_command() -> None:
    makefile = (ROOT / "Makefile").read_text()
    _, words = makefile.split("python -m agents.benchmark", 1)
    error = refusal("benchmark", [*words.splitlines()[0].split(), "--settings", "nowhere"])
    assert "settings = 'nowhere' is not allowed" in error


def test_one_seed_has_the_interval_of_students_test() -> None:
    generator = np.random.default_rng(0)
    reference = generator.gamma(2.0, size=50)
    cost = reference + generator.normal(0.1, 0.3, 50)
    result = cost_difference([cost], reference)
    test = stats.ttest_1samp((cost - reference) / reference.mean(), 0.0)
    interval = test.confidence_interval(0.95)
    assert result.p == pytest.approx(test.pvalue)
    assert (result.low, result.high) == pytest.approx((interval.low, interval.high))


def results_of(costs: Any) -> list[verdict.TestResult]:
    """The results of a policy with these costs of episodes, at one price."""
    return [verdict.TestResult("policy", 1.0, np.asarray(costs), np.zeros(len(costs)), 0.0, 0.0)]


@pytest.mark.parametrize("seeds", [[3], [5, 3, 3]])
def test_intervals_over_seeds_and_episodes_cover_the_mean(seeds: list[int]) -> None:
    """Of crossed effects of seeds and 100 episodes, in one or three classes: at least 93 in 100."""
    generator = np.random.default_rng(1)
    covered = 0
    for _ in range(1000):
        episodes, pairs = generator.normal(0.0, 0.2, 100), []
        for count in seeds:
            noise = generator.normal(0.0, 0.1, (count, 100))
            costs = 1.0 + generator.normal(0.0, 0.02, (count, 1)) + episodes + noise
            pairs.append(([results_of(own) for own in costs], results_of(np.ones(100))))
        result = mean_difference(pairs)
        covered += result.low <= 0.0 <= result.high
    assert covered >= 930


def test_a_mean_over_classes_weighs_classes_and_not_seeds() -> None:
    reference = results_of([1.0, 3.0])
    pairs = [([results_of([2.0, 4.0])] * 5, reference), ([results_of([1.0, 3.0])] * 3, reference)]
    assert mean_difference(pairs).mean == pytest.approx(0.25)


def test_a_median_stands_beside_a_mean_that_an_outlier_moves() -> None:
    assert mean_text(evidence.ClassRow("a", "b", "c", 0.1, 0.05, 0.15, 0.01)) == (
        "+10.0 ± 5.0 (median +1.0)"
    )
    assert mean_text(evidence.ClassRow("a", "b", "c", -0.1, -0.12, -0.08, -0.105)) == "−10.0 ± 2.0"
    assert mean_text(evidence.ClassRow("a", "b", "bound", -0.1, -0.1, -0.1, -0.1)) == "−10.0"


def test_points_without_tokens_stand_at_zero() -> None:
    rows = [
        evidence.TestRow("a", "local", "trigger", 0, 0.1, price, 1.0, error, tokens, 0.0, 0.0, "")
        for price, error, tokens in ((0.1, 0.2, 2.0), (1.0, 0.5, 0.02), (9.0, 0.9, 0.0))
    ]
    figure, panel = plt.subplots()
    assert list(draw_class(panel, rows)) == ["tuned trigger"]
    (line,) = panel.get_lines()
    assert list(line.get_xdata()) == [0.0, 0.02, 2.0]
    figure.canvas.draw()
    assert {"0", "0.1", "1"} <= {label.get_text() for label in panel.get_xticklabels()}
    assert panel.get_xlim()[0] == 0.0
    plt.close()


def test_discoveries_are_those_of_the_procedure() -> None:
    assert discoveries([0.001, 0.02, 0.04, 0.9]) == [True, True, False, False]
    assert discoveries([0.04, 0.04]) == [True, True]
    assert discoveries([]) == []


def test_a_saving_has_the_interval_of_a_ratio_of_means() -> None:
    """By the delta method for one training, and wider by the spread of three trainings."""
    rng = np.random.default_rng(0)
    common = rng.gamma(9.0, 1.0, (2, 4000))

    def results(costs: Any) -> list[verdict.TestResult]:
        zero = np.zeros(costs.shape[-1])
        return [verdict.TestResult("", 1.0, cost, zero, 0.0, 0.0) for cost in costs]

    policy = 0.7 * common + rng.normal(0.0, 2.0, common.shape)
    mean, low, high = verdict.saving([results(policy)], results(common))
    ratio = policy.mean(1) / common.mean(1)
    assert mean == pytest.approx(1.0 - ratio.mean())
    errors = (policy - ratio[:, None] * common) / common.mean(1)[:, None]
    reach = 1.96 * errors.mean(0).std() / 4000**0.5
    assert (mean - low, high - mean) == pytest.approx((reach, reach), rel=0.15)
    several = [results(policy + shift) for shift in (-1.0, 0.0, 1.0)]
    wide = verdict.saving(several, results(common))
    assert wide[0] == pytest.approx(mean)
    assert wide[2] - wide[1] > 3.0 * (high - low)


def test_the_reference_is_the_rule_that_costs_least_in_tuning() -> None:
    """Whatever it costs in the tests; the learned policy is that rule where it says so."""
    setting = load_suite().settings[0]
    item = evidence.Evidence(setting, "local", rules.SweepResult(()))
    tuning = {"rule": (1.0, 3.0, 2.0, 2.0, 2.0), "trigger": (2.0, 2.0, 2.0, 3.0, 1.0)}
    tests = {"rule": (1.0, 1.0, 1.0, 1.0, 1.0), "trigger": (5.0, 6.0, 7.0, 8.0, 9.0)}

    def results(costs: Any) -> verdict.TestResult:
        return results_of(np.full(4, costs))[0]

    item.choice = {kind: tuple(map(results, costs)) for kind, costs in tuning.items()}
    item.tests = {kind: [tuple(map(results, costs))] for kind, costs in tests.items()}
    assert item.references == ["rule", "trigger", "rule", "rule", "trigger"]
    assert [result.cost.mean() for result in item.reference] == [1.0, 6.0, 1.0, 1.0, 9.0]
    job: Any = None
    points = [CalibrationPoint(1.0, 0, share, 0.0) for share in (1.0, 0.5, 0.0, 0.0, 0.0)]
    calibration = CalibrationResult(0.0, 0.0, tuple(points))
    trained = evidence.Trained(job, 0.0, calibration, Path(), rule_places=(4,))
    own = tuple(map(results, (0.5, 0.5, 0.5, 0.5, 0.5)))
    learned = trained.learned(own, item.reference, range(5))
    assert [result.cost.mean() for result in learned] == [0.5, 0.5, 0.5, 0.5, 9.0]
    assert trained.rule_points == 2


def test_the_learned_policy_is_the_cheapest_in_tuning_of_each_seed() -> None:
    def trained(cost: float) -> evidence.Trained:
        job: Any = None
        return evidence.Trained(job, 0.0, CalibrationResult(0.0, cost, ()), Path())

    item = evidence.Evidence(load_suite().settings[0], "local", rules.SweepResult(()))
    costs = {"agent": (-0.01, -0.02, -0.03), "other": (-0.02, -0.05, 0.0)}
    item.trainings = {kind: [*map(trained, own)] for kind, own in costs.items()}
    assert item.best_of_seeds == [("other", 0), ("other", 1), ("agent", 2)]
    assert item.best == ("other", 1)


def test_a_rule_is_searched_without_its_threshold() -> None:
    assert rules.without_threshold("paced:rate={value}") == ("paced", "rate")
    text = "innovation_threshold:threshold={value},at_most=1"
    assert rules.without_threshold(text) == ("innovation_threshold:at_most=1", "threshold")
    row = rules.TunedRule("a", 1.0, "a:b=1", 2.0, None)
    other = dataclasses.replace(row, rule="b", cost=1.0)
    foreign = dataclasses.replace(row, rule="c", cost=0.5, case=settings.Case(name="devices"))
    sweep = rules.SweepResult((row, other, foreign))
    assert sweep.cheapest() == ["b", "a"]


def test_another_rule_or_middle_price_trains_nothing_again_without_branches() -> None:
    suite = load_suite()
    setting = suite.settings[0]

    def inputs(*prices: float, seed: int = 0, algorithm: str = "counterfactual_ppo") -> Any:
        experiment = suite.experiment(setting, "scheduler", prices, seed, algorithm, "a rule")
        return training.TrainingJob(experiment, Path("anywhere")).inputs

    assert "a rule" not in str(inputs(1.0, 3.0))
    assert "a rule" in str(inputs(1.0, 3.0, algorithm="branching_ppo"))
    assert inputs(1.0, 2.0, 3.0) == inputs(1.0, 2.5, 3.0)
    assert inputs(1.0, 3.0) != inputs(1.0, 4.0)
    assert inputs(1.0, 3.0) != inputs(1.0, 3.0, seed=1)
    imports = cache.read_module("agents.benchmark.training", Path(training.__file__))[1]
    assert not [name for name in imports if name.startswith("agents")]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "count"), [("settings", 8), ("channels", 2)])
def test_all_tasks_and_rules_of_the_benchmark_exist(
    name: Any, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    suite, tasks, make = load_suite(name=name), {}, settings.Setting.task

    def task_once(setting: Any, name: Any, case: Any = None) -> Any:
        key = setting.name, setting.has_memory(name), case and case.name
        tasks[key] = tasks.get(key) or make(setting, name, case)
        return tasks[key]

    monkeypatch.setattr(settings.Setting, "task", task_once)
    assert len(suite.settings) == count
    for setting in suite.settings:
        for name in setting.classes:
            own = rules.rules_of(setting, name, suite.rules)
            assert len(own) >= 4
            for rule in own:
                task = setting.task(name, case=rule.case)
                policy = make_policy(rule.policy.format(value=rule.ends[1]), task)
                assert covers(knowledge_of(setting, name), policy.knowledge)
            for case in (None, *suite.cases_of(setting)):
                options = setting.agent_environment(name, (0.01, 1.0), case)
                fusion_gym.make_task(setting.environment, **options)
    assert [item.name for item in load_suite(quick=True).settings][-1] == "remote_estimation"


@pytest.mark.parametrize("name", fusion_gym.zoo.names())
def test_agents_of_the_zoo_reach_their_numbers(name: str) -> None:
    """The card's first 60 episodes at its middle price, to what their mean allows."""
    card = fusion_gym.zoo.card(name)
    centre = {"information": "centre"} if card["class"] == "centre" else {}
    task = fusion_gym.make_task(card["env"], **(card["options"] | centre))
    place = len(card["test"]["prices"]) // 2
    policy = make_policy(f"zoo:{name},price={card['test']['prices'][place]!r}", task)
    results = run_episodes(task, policy, 60, card["test"]["seed"])
    point = card["test"]["points"][place]
    deviation = results.mse.std() / np.sqrt(60)
    assert results.mse.mean() == pytest.approx(point["mse"], abs=4.5 * deviation)
    assert results.rate.mean() == pytest.approx(point["rate"], abs=0.03)
