"""Results of evaluations and comparisons: read again, and without any error."""

import copy
import json
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
from command_runs import call, refusal, succeed

from fusion_gym.commands.compare import Point, _label, price_table, rate_table
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.evaluation.metrics import compare_at_price, compare_with_envelope
from fusion_gym.output import figures
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
    every = {"always": results}
    at_price, at_rate = compare_at_price(results, every, 0.0), compare_with_envelope(results, every)
    point = Point("always", 1.0, 0.0, at_price, at_rate)
    assert list(rate_table([point]).columns[5].cells) == ["–"]
    assert list(price_table([point], every).columns[6].cells) == ["–"] * 2


@pytest.mark.slow
def test_a_rule_is_compared_under_its_name_in_few_curves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No word of an agent; a title in words and at most six curves, of the sweep's fourteen."""
    drawn: list[plt.Figure] = []
    monkeypatch.setattr(figures, "save_figure", lambda figure, *_: drawn.append(figure))
    words = ["--config", "tobit_oscillator_ppo", "--sweep", "tobit_oscillator_sweep"]
    words += ["--policy", "innovation_threshold:threshold=1", "--episodes", "3"]
    printed = succeed("compare", [*words, "--output", str(tmp_path)])
    (figure,) = drawn
    labels = [str(curve.get_label()) for axes in figure.axes for curve in axes.containers]
    assert 3 <= len(labels) <= 6
    assert "innovation_threshold" in labels
    rest = "innovation_threshold against the best rule at the same price"
    assert figure.get_suptitle() == f"Tobit oscillator, 3 sensors: {rest}"
    assert "agent" not in " ".join([printed.out, printed.err, *labels])
    *_, last = filter(str.strip, printed.out.splitlines())
    assert last.split()[:4] == ["innovation_threshold,", "mean", "over", "prices"]


def test_saved_agents_alone_are_called_agents() -> None:
    assert _label("zoo:tobit_oscillator_centre") == _label("model:a.zip") == "the agent"
    assert _label("model:runs/calibrated_model.zip,price=1") == "the calibrated agent"
    assert _label("my_rules:Mine") == "my_rules:Mine"
