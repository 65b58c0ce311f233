"""The command ``fusion-gym search`` from the user's side: its line is a policy elsewhere."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from command_runs import call, refusal, succeed

from fusion_gym.evaluation import rule_search

pytest.importorskip("cmaes")
ENV = "fusion_gym/LinearFusion-v2"
PLANT = """
transition: [[0.9, 0.1], [0, 0.8]]
process_covariance: [[0.04, 0], [0, 0.1]]
measurement_matrices: [[1, 0], [0, 1]]
measurement_covariances: 0.01
token_rate: 0.5
memory: true
"""
LOCAL = ("--class", "local")
FILES = ("generations.json", "search.json")


@pytest.fixture(autouse=True)
def plant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plant.yaml").write_text(PLANT)


def words(folder: str, *more: str) -> list[str]:
    sizes = ["--prices", "2", "--generations", "3"]
    options = ["--set", "system=plant.yaml", "horizon=8"]
    return ["--env", ENV, *options, "--output", folder, *sizes, *more]


def contents(folder: str) -> list[Any]:
    return [json.loads((Path(folder) / name).read_text()) for name in FILES]


def test_the_line_is_a_policy_of_other_commands() -> None:
    ended = succeed("search", words("made"))
    generations, result = contents("made")
    assert [item["number"] for item in generations["generations"]] == [0, 1, 2]
    line, *table = ended.out.splitlines()
    assert [line] * 2 == result["policies"]
    assert line.startswith("priced_threshold:own=false,score=value,")
    for price, cost, single in zip(
        *(result[name] for name in ("prices", "costs", "threshold_costs")), strict=True
    ):
        row = f"{price:.4g} {cost:.4g} {single:.4g} {cost / single - 1:+.1%}"
        assert row in {" ".join(text.split()) for text in table}
    assert "writing the generations and the rule into made" in ended.err
    assert "3/3 generations" in ended.err
    options = ["--set", "system=plant.yaml", "horizon=8", "--episodes", "2"]
    succeed("evaluate", ["--env", ENV, *options, "--policies", line])


def test_any_rule_is_searched_at_each_price() -> None:
    ended = succeed("search", words("made", "--rule", "report_on_change:min_interval=2"))
    generations, result = contents("made")
    assert [item["number"] for item in generations["generations"]] == [*range(6)]
    lines = ended.out.splitlines()[:2]
    assert lines == result["policies"]
    for line in lines:
        name, _, settings = line.partition(":")
        change, interval = settings.removeprefix("min_interval=2,").split(",")
        assert (name, len(change.split("/"))) == ("report_on_change", 2)
        assert int(interval.removeprefix("max_interval=")) >= 2
    assert "6/6 generations" in ended.err
    options = ["--set", "system=plant.yaml", "horizon=8", "--episodes", "2"]
    succeed("evaluate", ["--env", ENV, *options, "--policies", *lines])
    for more, message in (
        (("--rule", "always"), "rule = 'always' is not allowed: it must be a rule with parameters"),
        (("--rule", "model:x.zip"), "rule = 'model:x.zip' is not allowed"),
        (("--rule", "paced", "--class", "local"), "class = 'local' is not allowed with --rule"),
    ):
        assert message in refusal("search", words("other", *more))


def test_compare_asks_the_rule_at_every_price() -> None:
    options = {**yaml.safe_load(PLANT), "horizon": 8, "cost_weight": "random"}
    training = {
        "environment": {"id": ENV, "options": options | {"price_range": [0.5, 2.0]}},
        "algorithm": {"name": "ppo"},
        "training": {"timesteps": 64},
        "output": "unused",
    }
    Path("training.yaml").write_text(yaml.safe_dump(training))
    sizes = ["--prices", "2", "--generations", "1"]
    line = succeed("search", ["--config", "training.yaml", "--output", "made", *sizes, *LOCAL])
    policy = line.out.splitlines()[0]
    assert policy.startswith("priced_threshold:own=true,score=innovation,")
    assert contents("made")[1]["prices"] == [0.5, 2.0]
    files = ["--config", "training.yaml", "--episodes", "4", "--prices", "3"]
    succeed("compare", [*files, "--policies", policy, "never", "--output", "compared"])
    rows = json.loads(Path("compared/comparison.json").read_text())["prices"]
    assert [row["price"] for row in rows] == [0.5, 1.0, 2.0]
    evaluated = json.loads(Path("compared/evaluation.json").read_text())["policies"]
    settings = policy.partition(":")[2]
    rates = [sum(own["rate"]) for text, own in evaluated.items() if text.endswith(settings)]
    assert len(rates) > 3
    assert rates[0] > rates[-1]
    based = "rollout:samples=2,base=value_of_information:threshold=0.1"
    succeed("compare", [*files, "--policies", based, "never", "--output", "based"])
    evaluated = json.loads(Path("based/evaluation.json").read_text())["policies"]
    prices = [text.partition("price=")[2].partition(",")[0] for text in evaluated]
    assert prices == ["0.5", "1.0", "2.0", ""]


@pytest.mark.slow
def test_an_interrupted_search_ends_as_the_uninterrupted_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    succeed("search", words("whole"))
    searched = rule_search.search_rule

    def interrupt(search: Any, earlier: Any, progress: Any) -> Any:
        def count(generation: Any) -> None:
            progress(generation)
            if generation.number == 1:
                raise KeyboardInterrupt

        return searched(search, earlier, count)

    with monkeypatch.context() as patch:
        patch.setattr(rule_search, "search_rule", interrupt)
        ended = call("search", words("parts"))
    assert ended.status == 130
    assert ended.err.splitlines()[-1].startswith("interrupted; continue with: fusion-gym search ")
    assert ended.err.splitlines()[-1].endswith("--resume")
    assert not Path("parts/search.json").exists()
    succeed("search", words("parts", "--resume"))
    assert contents("parts") == contents("whole")
    succeed("search", words("whole", "--resume"))  # nothing is left to do
    assert contents("parts") == contents("whole")


def test_what_a_search_refuses() -> None:
    assert "holds no search" in refusal("search", words("made", "--resume"))
    assert "output = 'made' holds" not in call("search", words("made", "--prices", "1")).err
    assert not Path("made").exists()
    succeed("search", words("made"))
    before = contents("made")
    assert "output = 'made' already holds a search" in refusal("search", words("made"))
    other = words("made", *LOCAL, "--resume")
    assert "class = 'local' differs" in refusal("search", other)
    path = Path("made/generations.json")
    for damage in ("", "{}", path.read_text().replace('"number": 1', '"number": 7')):
        whole = path.read_text()
        path.write_text(damage)
        message = refusal("search", words("made", "--resume"))
        assert "made" in message
        path.write_text(whole)
    assert contents("made") == before
