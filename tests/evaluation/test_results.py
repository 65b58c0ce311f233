"""Results of evaluations and comparisons: read again, and without any error."""

import copy
import json
from pathlib import Path

import numpy as np
import pytest
from command_runs import call, refusal

from fusion_gym.commands.compare import cell, short_text
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.curves import compare, cost_at_price, error_at_rate
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy

ENV = "fusion_gym/TobitOscillator-v1"


def test_an_evaluation_goes_on_with_whole_policies_alone(tmp_path: Path) -> None:
    file = tmp_path / "evaluation.json"
    words = ["--env", ENV, "--set", "horizon=3", "--policies", "always", "--episodes", "2"]
    words += ["--json", str(file)]
    assert call("evaluate", words).status == 0
    whole = json.loads(file.read_text(encoding="utf-8"))
    for place, message in (
        ("quantiles/always", "quantiles of ['always'] are missing"),
        ("policies/always/return", "policies.always.return is not allowed"),
    ):
        content = copy.deepcopy(whole)
        above, name, *inner = place.split("/")
        del (content[above][name] if inner else content[above])[inner[0] if inner else name]
        file.write_text(json.dumps(content), encoding="utf-8")
        assert message in refusal("evaluate", [*words, "--resume"])
    file.write_text(json.dumps(whole), encoding="utf-8")
    assert call("evaluate", [*words, "--resume"]).status == 0
    assert json.loads(file.read_text(encoding="utf-8")) == whole
    assert "seed = 1 differs from json" in refusal("evaluate", [*words, "--resume", "--seed", "1"])


@pytest.mark.filterwarnings("error")
def test_no_error_at_all_can_be_compared() -> None:
    """Over a perfect channel whoever always transmits has none: no share of it."""
    task = make_task("fusion_gym/RemoteEstimation-v1", horizon=3)
    results = run_episodes(task, make_policy("always", task), 2, 0)
    compared = compare({"always": results.mse, "same": results.mse, "absent": None})
    assert [cell(own) for own in compared.values()] == ["0", "0", "–"]


def test_a_difference_is_to_the_best_other_policy() -> None:
    samples = {"a": np.array([1.0, 3.0]), "b": np.array([4.0, 4.0]), "c": np.array([3.0, 3.0])}
    compared = compare(samples)
    shares = {name: own.relative.mean for name, own in compared.items() if own}
    assert shares == pytest.approx({"a": 2 / 3 - 1, "b": 1.0, "c": 0.5})
    assert compared["c"] is not None
    low, high = compared["c"].difference[1:]
    assert (low, high) == (0.0, 2.0)
    assert "+100 ± " in cell(compared["b"])


@pytest.mark.filterwarnings("ignore:1 of 2 episodes diverged")
def test_a_lost_episode_leaves_errors_and_costs_infinitely_much() -> None:
    task = make_task("fusion_gym/RemoteEstimation-v1", horizon=3)
    results = run_episodes(task, make_policy("never", task), 2, 0)
    whole = {"never": results}
    for part in (results.mse, results.rate, results.error_cost, results.tokens):
        part[0] = np.nan
    error = error_at_rate(whole, 0.0)
    assert error is not None
    assert cell(compare({"never": error, "other": 2.0 * error})["other"]).endswith("+100 ± 0 %")
    assert cost_at_price(whole, 1.0)[0] == np.inf  # so that another policy of the curve is taken


def test_a_file_is_named_without_its_folder() -> None:
    assert short_text("model:runs/front/a.zip,price=1") == "model:a.zip,price=1"
    assert short_text("my/rules:Mine") == "my/rules:Mine"
