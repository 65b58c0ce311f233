"""Rules compared at equal communication, in any environment."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_runs import refusal, succeed

import fusion_gym
from fusion_gym.core.task import Task
from fusion_gym.evaluation import run_episodes
from fusion_gym.evaluation.curves import cost_at_price, error_at_rate, sweep

LINEAR = "fusion_gym/LinearFusion-v2"


def small_task(**options: object) -> Task:
    return fusion_gym.make_task(LINEAR, horizon=40, **options)


def test_rules_are_compared_without_a_config(tmp_path: Path) -> None:
    """The printed and written numbers are costs and errors of the same episodes."""
    words = ["--env", LINEAR, "--set", "horizon=40", "--episodes", "30", "--output", str(tmp_path)]
    words += ["--policies", "always", "never", "value_of_information"]
    printed = succeed("compare", words).out
    result = json.loads((tmp_path / "comparison.json").read_text())
    assert (tmp_path / "pareto.png").stat().st_size > 10_000
    task = small_task()
    always = run_episodes(task, fusion_gym.make_policy("always", task), 30, seed=0)
    middle = result["prices"][2]
    assert middle["price"] == pytest.approx(task.reward.price.middle, rel=1e-3)
    for row in result["prices"]:
        own = row["policies"]
        expected = always.cost(row["price"]).mean()
        assert own["always"]["mean"] == pytest.approx(expected)
        assert f"{expected:.4g}" in printed
        for name, item in own.items():
            least = min(other["mean"] for text, other in own.items() if text != name)
            assert item["difference"]["mean"] == pytest.approx(item["mean"] - least)
    for row in result["rates"]:  # always has no lower rate, and never no other error
        assert row["policies"]["always"] is None
        assert row["policies"]["never"]["mean"] > row["policies"]["value_of_information"]["mean"]


def test_an_error_at_a_rate_is_a_mixture_of_the_curve() -> None:
    task = small_task()
    texts = "periodic:period=8", "periodic:period=4"
    curve = {t: run_episodes(task, fusion_gym.make_policy(t, task), 20, seed=0) for t in texts}
    low, high = (float(item.rate.mean()) for item in curve.values())
    error = error_at_rate(curve, 0.25 * low + 0.75 * high)
    assert error is not None
    np.testing.assert_allclose(error, 0.25 * curve[texts[0]].mse + 0.75 * curve[texts[1]].mse)
    assert error_at_rate(curve, 0.9 * low) is None
    assert cost_at_price(curve, 1e6) is not None
    np.testing.assert_array_equal(cost_at_price(curve, 1e6), curve[texts[0]].cost(1e6))
    np.testing.assert_array_equal(cost_at_price(curve, 0.0), curve[texts[1]].cost(0.0))


@pytest.mark.parametrize(
    ("rule", "parameter"),
    [
        ("innovation_threshold", "threshold"),
        ("periodic", "period"),
        ("priced_threshold:score=value", "price"),
        ("stochastic_event:weight={value}", "weight"),
    ],
)
def test_a_rule_runs_where_its_parameter_changes_the_tokens(rule: str, parameter: str) -> None:
    """From hardly any to nearly the most; a parameter that the text sets stays."""
    task = small_task()
    texts = sweep(task, rule, [])
    assert len(texts) > 10
    assert all(f"{parameter}=" in text for text in texts)
    results = [run_episodes(task, fusion_gym.make_policy(text, task), 16, seed=0) for text in texts]
    share = np.array([item.tokens.mean() for item in results])
    share /= share.max()
    assert share.min() < 0.1
    assert np.count_nonzero((share > 0.05) & (share < 0.95)) >= len(share) / 2
    rule = rule.partition(":weight")[0]
    joined = f"{rule}{',' if ':' in rule else ':'}{parameter}=3"
    assert sweep(task, joined, []) == [joined]
    assert sweep(task, "always", []) == ["always"]


def test_a_comparison_without_a_price_uses_what_a_token_saves(tmp_path: Path) -> None:
    words = ["--env", LINEAR, "--set", "horizon=40", "cost_weight=0", "--episodes", "20"]
    succeed("compare", [*words, "--output", str(tmp_path), "--policies", "never", "always"])
    prices = [
        row["price"] for row in json.loads((tmp_path / "comparison.json").read_text())["prices"]
    ]
    task = small_task(cost_weight=0)
    never, always = (
        run_episodes(task, fusion_gym.make_policy(name, task), 20, seed=0)
        for name in ("never", "always")
    )
    saved = (never.error_cost.mean() - always.error_cost.mean()) / always.tokens.mean()
    np.testing.assert_allclose(prices, saved * np.geomspace(0.1, 10.0, 5), rtol=1e-3)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "policies = []"),
        (["--policies", "always", "--prices", "1"], "prices = 1"),
        (["--policies", "nobody"], "nobody"),
    ],
)
def test_a_wrong_comparison_is_one_line(tmp_path: Path, words: list[str], message: str) -> None:
    words = ["--env", LINEAR, "--output", str(tmp_path / "new"), *words]
    assert message in refusal("compare", words)
    assert not (tmp_path / "new").exists()


def test_an_agent_of_several_prices_runs_at_all() -> None:
    zoo = "zoo:tobit_oscillator_scheduler"
    world = fusion_gym.zoo.card("tobit_oscillator_scheduler")["training"]["environment"]
    task = fusion_gym.make_task(world["id"], **world["options"])
    low, high = world["options"]["price_range"]
    assert sweep(task, zoo, [low, high]) == [f"{zoo},price={low!r}", f"{zoo},price={high!r}"]
    alone = f"{zoo},price={high!r}"
    assert sweep(task, alone, [low, high]) == [alone]
    options = world["options"] | {"price_range": None, "cost_weight": low}
    assert sweep(fusion_gym.make_task(world["id"], **options), zoo, []) == [zoo]
