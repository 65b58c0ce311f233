"""Results of evaluations and comparisons: read again, and without any error."""

import copy
import json
from pathlib import Path

import pytest
from command_runs import call, refusal

from fusion_gym.commands.compare import Point, price_table, rate_table
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.envelope import compare_at_price, compare_with_envelope
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
    assert "another evaluation" in refusal("evaluate", [*words, "--resume", "--seed", "1"])


@pytest.mark.filterwarnings("error")
def test_no_error_at_all_can_be_compared() -> None:
    """Over a perfect channel whoever always transmits has none: no share of it."""
    task = make_task("fusion_gym/RemoteEstimation-v1", horizon=3)
    results = run_episodes(task, make_policy("always", task), 2, 0)
    point = Point(
        "always",
        1.0,
        0.0,
        compare_at_price(results, {"always": results}, 0.0),
        compare_with_envelope(results, {"always": results}),
    )
    assert list(rate_table([point]).columns[5].cells) == ["–"]
    assert list(price_table([point], {"always": results}).columns[6].cells) == ["–"]
