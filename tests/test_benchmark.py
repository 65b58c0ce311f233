"""The benchmark: prices, searched rules, agents, verdict, pages and the zoo made from it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_runs import refusal, succeed
from scipy import stats

import fusion_gym
from agents.benchmark import rules, settings, tables
from agents.benchmark.report import headline_text
from agents.benchmark.settings import CLASSES, knowledge_of, load_suite
from agents.benchmark.verdict import cost_difference, discoveries
from fusion_gym.core.system import covers
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.evaluation.rule_search import ThresholdTrial
from fusion_gym.policies.registry import make_policy

SMALL = {
    "episodes": 20,
    "validation_episodes": 4,
    "tuning_episodes": [4, 4],
    "case_episodes": 4,
    "generations": 2,
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
    setting["options"] |= {"horizon": 12}
    content["settings"] = [setting]
    (tmp_path / "settings.yaml").write_text(yaml.safe_dump(content))
    monkeypatch.setattr(settings, "FILE", tmp_path / "settings.yaml")
    places = ["--work", str(tmp_path / "work"), "--results", str(tmp_path / "results")]
    return [*places, "--workers", "1"]


def test_from_prices_to_pages_and_zoo(
    small: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    printed = succeed("benchmark", small).out
    folder = tmp_path / "results"
    policies = tables.read_rows(folder, tables.TestRow)
    for name in CLASSES:
        for kind, seeds in (("rule", 1), ("threshold", 1), ("agent", 2)):
            own = [row for row in policies if (row.name, row.kind) == (name, kind)]
            assert len(own) == 5 * seeds
            prices = [row.price for row in own[:5]]
            assert prices == sorted(set(prices))
            for row in own:
                assert row.cost == pytest.approx(row.error + row.price * row.tokens, rel=1e-4)
    assert {row.name for row in policies if row.kind == "optimum"} == {"scheduler"}
    means = tables.read_rows(folder, tables.ClassRow)
    points = tables.read_rows(folder, tables.PointRow)
    for mean in means:
        key = (mean.name, mean.kind)
        own_points = [point.difference for point in points if (point.name, point.kind) == key]
        assert mean.difference == pytest.approx(np.mean(own_points), abs=1e-4)
    cases = tables.read_rows(folder, tables.CaseRow)
    assert [row.case for row in cases] == ["as assumed", "half the tokens"]
    assert cases[0].rule == 0.0
    page = (folder / "README.md").read_text()
    assert headline_text({"remote_estimation": "Remote estimation"}, means) in page
    assert (folder / "remote_estimation.png").stat().st_size > 20_000
    assert "remote_estimation" in printed
    # Finished pieces are not done again.
    monkeypatch.setattr("agents.workers._fill", pytest.fail)
    succeed("benchmark", small)
    assert (folder / "README.md").read_text() == page
    place = ["--work", str(tmp_path / "work"), "--zoo", str(tmp_path / "zoo"), "--workers", "1"]
    succeed("zoo", place)
    card = json.loads((tmp_path / "zoo" / "remote_estimation_local.json").read_text())
    rows = [row for row in policies if (row.name, row.kind) == ("local", "agent")]
    costs = {f"{row.cost:.4g}" for row in rows}
    assert {f"{point['cost']:.4g}" for point in card["test"]["points"]} <= costs


def test_a_policy_of_ones_own_has_the_same_verdict(small: list[str]) -> None:
    text = "value_of_information:price={price}"
    printed = succeed("benchmark", [*small, "--policy", text, "--class", "scheduler"]).out
    assert "policy" in printed
    error = refusal("benchmark", [*small, "--policy", text, "--class", "centre"])
    assert "it declares knowledge = 'scheduler', and the class has 'centre'" in error
    assert "class = None is not allowed" in refusal("benchmark", [*small, "--policy", text])
    both = refusal("benchmark", [*small, "--second-search", "--policy", text, "--class", "local"])
    assert "second_search = True is not allowed" in both


def test_the_make_target_is_a_command() -> None:
    makefile = (Path(__file__).parent.parent / "Makefile").read_text()
    _, words = makefile.split("python -m agents.benchmark", 1)
    error = refusal("benchmark", [*words.splitlines()[0].split(), "--settings", "nowhere"])
    assert "settings = 'nowhere' is not allowed" in error


def test_a_second_search_has_other_episodes_and_more_of_them(
    small: list[str], tmp_path: Path
) -> None:
    printed = succeed("benchmark", [*small, "--second-search"]).out
    assert sum("second" in line for line in printed.splitlines()) >= 3
    searches = [json.loads(path.read_text()) for path in (tmp_path / "work").rglob("*000000.json")]
    assert sorted(map(len, searches)) == [2, 2, 2, 8, 8, 8]
    assert len({json.dumps(generations[0]) for generations in searches}) == 6


def test_one_seed_has_the_interval_of_students_test() -> None:
    generator = np.random.default_rng(0)
    reference = generator.gamma(2.0, size=50)
    cost = reference + generator.normal(0.1, 0.3, 50)
    result = cost_difference([cost], reference)
    test = stats.ttest_1samp((cost - reference) / reference.mean(), 0.0)
    interval = test.confidence_interval(0.95)
    assert result.p == pytest.approx(test.pvalue)
    assert (result.low, result.high) == pytest.approx((interval.low, interval.high))


def test_intervals_over_seeds_and_episodes_cover_the_mean() -> None:
    """Of crossed effects of three seeds and 100 episodes: at least 93 in 100 intervals."""
    generator = np.random.default_rng(1)
    covered = 0
    for _ in range(1000):
        seeds, episodes = generator.normal(0.0, 0.02, (3, 1)), generator.normal(0.0, 0.2, 100)
        noise = generator.normal(0.0, 0.1, (3, 100))
        result = cost_difference(list(1.0 + seeds + episodes + noise), np.ones(100))
        covered += result.low <= 0.0 <= result.high
    assert covered >= 930


def test_discoveries_are_those_of_the_procedure() -> None:
    assert discoveries([0.001, 0.02, 0.04, 0.9]) == [True, True, False, False]
    assert discoveries([0.04, 0.04]) == [True, True]
    assert discoveries([]) == []


def test_prices_are_slopes_of_the_front(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where error = 1 / tokens, the best at price p spends p^(-1/2)."""
    trials = [
        ThresholdTrial(f"x:y={value}", value, value, 1.0 / value)
        for value in np.geomspace(0.01, 1.0, 200).tolist()
    ]
    always = type("Brief", (), {"tokens": np.ones(3)})
    monkeypatch.setattr(rules, "run_policies", lambda *_: [always])
    monkeypatch.setattr(rules, "make_policy", lambda *_: None)
    shares = (0.5, 0.25, 0.12, 0.06, 0.03)
    job = rules.SweepJob(load_suite().settings[0], "scheduler", True, (), shares, (3, 3))
    task: Any = None
    prices = rules._prices(task, trials, job)
    assert prices == pytest.approx([share**-2 for share in shares], rel=0.02)


def test_all_tasks_and_rules_of_the_benchmark_exist(monkeypatch: pytest.MonkeyPatch) -> None:
    suite, tasks, make = load_suite(), {}, settings.Setting.task

    def task_once(setting: Any, name: Any, memory: bool | None = None, case: Any = None) -> Any:
        memory = setting.has_memory(name) if memory is None else memory
        key = setting.name, memory, case and case.name
        tasks[key] = tasks.get(key) or make(setting, name, memory, case)
        return tasks[key]

    monkeypatch.setattr(settings.Setting, "task", task_once)
    assert len(suite.settings) == 8
    for setting in suite.settings:
        for name in CLASSES:
            own = rules.rules_of(setting, name, suite.rules, setting.has_memory(name))
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
