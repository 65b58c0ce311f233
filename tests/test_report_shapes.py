"""JSON of another shape than its reader needs is refused by its field, before anything is drawn."""

from __future__ import annotations

import copy
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from command_runs import call
from hostile_folder import ENV, ROOT, contents

from agents.output import figures
from agents.suite.comparison import comparison_table
from agents.suite.reports import read_setting
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.envelope import Comparison
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.evaluation.intervals import Interval
from fusion_gym.policies.registry import make_policy

SETTING = "tobit_oscillator"
ABSENT = object()


def changed(content: dict[str, Any], place: str, value: Any) -> dict[str, Any]:
    """The content with another value in a place, or without it."""
    result = copy.deepcopy(content)
    *above, last = place.split("/")
    inner: Any = result
    for key in above:
        inner = inner[int(key) if key.isdigit() else key]
    if value is ABSENT:
        del inner[last]
    else:
        inner[last] = value
    return result


@pytest.fixture
def setting(tmp_path: Path) -> Path:
    """A folder with one setting's results."""
    folder = tmp_path / "results" / SETTING
    folder.mkdir(parents=True)
    for name in ("verdict", "baselines", "informed", "agent_sensors_0", "agent_sensors_1"):
        shutil.copy(ROOT / "results" / SETTING / f"{name}.json", folder)
    read_setting(folder)
    return folder


@pytest.mark.parametrize(
    ("name", "place", "value", "message"),
    [
        ("verdict", "title", ABSENT, "title is not allowed: Field required"),
        ("verdict", "modes", {}, "modes = {} is not allowed"),
        ("verdict", "modes/sensors", [1], "modes.sensors = [1]"),
        ("verdict", "modes/sensors/points", [], "modes.sensors.points = []"),
        ("verdict", "modes/sensors/points/0/mse", None, "modes.sensors.points.0.mse = None"),
        ("verdict", "modes/sensors/points/0/mse", float("nan"), "points.0.mse = nan"),
        ("verdict", "modes/sensors/points/0/mse", -1.0, "points.0.mse = -1.0"),
        ("verdict", "modes/sensors/points/0/rate", "0.5", "points.0.rate = '0.5'"),
        ("verdict", "modes/sensors/points/0/difference", None, "points.0.difference = None"),
        ("verdict", "modes/sensors/closed", ABSENT, "room stands without closed"),
        ("verdict", "modes/sensors/envelope/0/name", "ghost", "no policy 'ghost'"),
        ("baselines", "curves/always/policies", ["ghost"], "no policy 'ghost'"),
        ("baselines", "curves", {}, "curves = {}"),
        ("baselines", "policies/always/mse", 3, "policies.always.mse = 3"),
        ("baselines", "policies/always/rate", [], "policies.always.rate = []"),
        ("informed", "policies", [], "policies = []"),
    ],
)
def test_results_of_another_shape(
    setting: Path, name: str, place: str, value: Any, message: str
) -> None:
    file = setting / f"{name}.json"
    content = changed(json.loads(file.read_text(encoding="utf-8")), place, value)
    file.write_text(json.dumps(content), encoding="utf-8")
    before = contents(setting)
    ended = call("report", ["--results", str(setting.parent)])
    assert (ended.status, ended.trace, contents(setting)) == (1, "", before)
    assert ended.err.startswith("error: results = ")
    assert message in ended.err
    assert len(ended.err.splitlines()) == 1


def test_the_zoo_takes_all_agents_or_none(setting: Path, tmp_path: Path) -> None:
    """The second of two has no model; a setting's name is no path; then both are there."""
    second = setting.parent / "zz"  # behind the other, in the order in which they are copied
    shutil.copytree(setting, second)
    file = second / "agent_sensors_0.json"
    agent = json.loads(file.read_text(encoding="utf-8"))
    model = tmp_path / "work" / SETTING / "sensors_0" / "best_model.zip"
    model.parent.mkdir(parents=True)
    model.write_bytes(b"a model")
    for folder in (setting, second):
        (folder / "agent_sensors_1.json").unlink()
    words = ["--results", str(setting.parent), "--work", str(tmp_path / "work")]
    words += ["--zoo", str(tmp_path / "zoo")]
    for value, message in (("second", "best_model.zip is missing"), ("../../x", "setting = ")):
        file.write_text(json.dumps(agent | {"setting": value}), encoding="utf-8")
        ended = call("zoo", words)
        assert (ended.status, ended.trace) == (1, "")
        assert message in ended.err
        assert not (tmp_path / "zoo").exists()
    file.write_text(json.dumps(agent | {"setting": "second"}), encoding="utf-8")
    shutil.copytree(model.parent.parent, tmp_path / "work" / "second")
    assert call("zoo", words).status == 0
    assert len(list((tmp_path / "zoo").iterdir())) == 4


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
        file.write_text(json.dumps(changed(whole, place, ABSENT)), encoding="utf-8")
        ended = call("evaluate", [*words, "--resume"])
        assert (ended.status, ended.trace) == (1, "")
        assert message in ended.err
    file.write_text(json.dumps(whole), encoding="utf-8")
    assert call("evaluate", [*words, "--resume"]).status == 0
    assert json.loads(file.read_text(encoding="utf-8")) == whole


@pytest.mark.filterwarnings("error")
def test_no_error_at_all_can_be_drawn_and_compared(tmp_path: Path) -> None:
    """Over a perfect channel whoever always transmits has none: no axis and no share of it."""
    point = [(1.0, 0.0)]
    curves = {"always": point, "never": [(0.0, 1.0)]}
    figures.fronts(tmp_path / "x.png", "perfect", curves, [], {"sensors": point}, None)
    assert (tmp_path / "x.png").stat().st_size > 10_000
    task = make_task(ENV, horizon=3)
    found = run_episodes(task, make_policy("always", task), 2, 0)
    table = comparison_table(Comparison(Interval(0.0, 0.0, 0.0), 0.0, ("always",)), found)
    assert list(table.columns[4].cells) == ["–"]
