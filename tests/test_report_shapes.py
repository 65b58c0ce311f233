"""Tables of another shape than theirs are refused by their column, before anything is drawn."""

import copy
import json
import shutil
import struct
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from command_runs import call, refusal, succeed
from hostile_folder import contents
from hypothesis import given
from hypothesis import strategies as st
from small_results import CLASSES, ENV, SETTING, small_model, small_results

from agents.benchmark import pareto_figure
from agents.benchmark.pareto_figure import Differences, Limits, Panel, Series
from agents.benchmark.tables import read_rows, write_rows
from fusion_gym.commands.compare import Point, price_table, rate_table
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.envelope import compare_at_price, compare_with_envelope
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.output.palette import AGENTS, RULES
from fusion_gym.policies.registry import make_policy

ABSENT = "ABSENT"
ROOT = Path(__file__).parents[1]
REPORT = ["--parts", "report", "--results"]


def change(file: Path, column: str, value: str) -> None:
    """Write another value into the first cell of a column, or take the column away."""
    frame = pd.read_csv(file, dtype=str, keep_default_na=False)
    if value == ABSENT:
        frame = frame.drop(columns=column)
    else:
        frame.loc[0, column] = value
    frame.to_csv(file, index=False)


@pytest.mark.parametrize(
    ("table", "column", "value", "message"),
    [
        ("verdict", "title", ABSENT, "has other columns than the table 'verdict': 'title'"),
        ("verdict", "always", "0.0", "always = [0.0] is not allowed"),
        ("fronts", "mode", "nobody", "mode = 'nobody' is not allowed: Input should be 'centre',"),
        ("fronts", "rates", "[1", "rates = '[1' is not allowed: Invalid JSON"),
        ("fronts", "seeds", "1.5", "seeds = '1.5' is not allowed: Input should be a valid integer"),
        ("worth", "rules_low", "", "rules.low is not allowed: Field required"),
        ("points", "mse", "", "mse is not allowed: Field required"),
    ],
)
def test_results_of_another_shape(
    tmp_path: Path, table: str, column: str, value: str, message: str
) -> None:
    setting = small_results(tmp_path / "results")
    change(setting / f"{table}.csv", column, value)
    before = contents(setting)
    error = refusal("benchmark", [*REPORT, str(setting.parent)])
    assert contents(setting) == before
    assert error.startswith("error: results = ")
    assert message in error


@pytest.mark.parametrize(
    "table", ["envelope", "equal_rates", "fronts", "points", "policies", "runs", "verdict"]
)
def test_a_table_of_results_without_rows_is_refused(tmp_path: Path, table: str) -> None:
    file = small_results(tmp_path) / f"{table}.csv"
    file.write_text(file.read_text().splitlines()[0] + "\n")
    error = refusal("benchmark", [*REPORT, str(tmp_path)])
    assert error.startswith("error: results = ")
    assert "rows" in error
    if table != "fronts":
        assert str(file) in error


@pytest.mark.parametrize("table", ["classes", "robustness", "rollout", "setting", "vertices"])
def test_a_committed_table_without_rows_is_refused(tmp_path: Path, table: str) -> None:
    shutil.copytree(ROOT / "results" / SETTING, tmp_path / SETTING)
    file = tmp_path / SETTING / f"{table}.csv"
    file.write_text(file.read_text().splitlines()[0] + "\n")
    assert f"{str(file)!r} has no rows" in refusal("benchmark", [*REPORT, str(tmp_path)])


def test_json_of_an_earlier_version_is_refused(tmp_path: Path) -> None:
    (tmp_path / SETTING).mkdir()
    (tmp_path / SETTING / "verdict.json").write_text("{}")
    error = refusal("benchmark", [*REPORT, str(tmp_path)])
    assert "and not JSON of an earlier version" in error


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1))
def test_numbers_are_read_back_bit_for_bit(tmp_path_factory: Any, values: list[float]) -> None:
    folder = tmp_path_factory.mktemp("table")
    rows = [{"class": "a", "name": "b", "rate": value, "mse": value} for value in values]
    write_rows(folder, "envelope", rows)
    again = [row["mse"] for row in read_rows(folder, "envelope")]
    assert struct.pack(f"{len(values)}d", *again) == struct.pack(f"{len(values)}d", *values)


def test_the_zoo_takes_all_agents_or_none(tmp_path: Path) -> None:
    """The second of two has no model; then both are there."""
    results, work = tmp_path / "results", tmp_path / "work"
    for name in (SETTING, "zz"):  # the other stands first, in the order in which they are copied
        small_results(results, name, classes=["sensors"], seeds=1)
    small_model(work / SETTING / "sensors_0" / "best_model.zip")
    words = ["--results", str(results), "--work", str(work), "--zoo", str(tmp_path / "zoo")]
    assert "best_model.zip is missing" in refusal("zoo", words)
    assert not (tmp_path / "zoo").exists()
    shutil.copytree(work / SETTING, work / "zz")
    assert call("zoo", words).status == 0
    assert len(list((tmp_path / "zoo").iterdir())) == 4


def test_the_zoo_takes_a_choice_and_removes_what_is_not_in_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results, work, folder = (tmp_path / name for name in ("results", "work", "zoo"))
    small_results(results)
    for name in CLASSES:
        small_model(work / SETTING / f"{name}_0" / "best_model.zip")
    words = ["--results", str(results), "--work", str(work), "--zoo", str(folder)]
    folder.mkdir()
    (folder / "notes.json").write_text("{}")
    assert call("zoo", words).status == 0
    assert {path.stem for path in folder.glob("*.zip")} == {f"{SETTING}_{name}" for name in CLASSES}
    card = json.loads((folder / f"{SETTING}_local_packets_memory.json").read_text())
    assert card["class"] == "local_packets_memory"
    assert card["knows"] == "own_memory"
    assert card["options"] == {"horizon": 4, "memory": True, "broadcast": "packets"}
    line = f"benchmark --envs {SETTING} --classes local_packets_memory, training seed 0"
    assert card["command"].endswith(line)
    assert call("zoo", [*words, "--classes", "centre", "sensors"]).status == 0
    left = {f"{SETTING}_{name}.{end}" for name in ("centre", "sensors") for end in ("zip", "json")}
    assert {path.name for path in folder.iterdir()} == left | {"notes.json"}
    for wrong, message in ((["--classes", "sensor"], "sensors"), (["--envs", "x"], "envs = 'x'")):
        assert message in refusal("zoo", [*words, *wrong])
    monkeypatch.setattr("agents.zoo.zoo.MOST", 200)
    assert "all together must have at most 200; name fewer" in refusal("zoo", words)
    assert {path.name for path in folder.iterdir()} == left | {"notes.json"}


def test_what_is_not_there_yet_is_said(tmp_path: Path) -> None:
    """No agents, no references, no envelopes: a report all the same, which says so."""
    folder = small_results(tmp_path, classes=[])
    policies = read_rows(folder, "policies")
    write_rows(folder, "policies", [row for row in policies if row["run"] != "informed"])
    succeed("benchmark", [*REPORT, str(tmp_path)])
    text = (tmp_path / "README.md").read_text()
    assert "Agents of a class: none so far." in text
    assert "nothing to remember" in text
    assert "no agent has a price in the middle of the front so far" in text


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
def test_no_error_at_all_can_be_drawn_and_compared(tmp_path: Path) -> None:
    """Over a perfect channel whoever always transmits has none: no axis and no share of it."""
    panel = Panel(
        "perfect",
        [Series(RULES, [(0.0, 1.0), (1.0, 0.0)]), Series(AGENTS, [], [(1.0, 0.0)])],
        differences=[Differences(AGENTS, [])],
    )
    limits = Limits((0.04, 1.0), (0.5, 2.0))
    paths = [tmp_path / "x.png", tmp_path / "x.svg"]
    pareto_figure.draw_pareto(paths, "a title", panel, [panel], limits)
    assert all(path.stat().st_size > 10_000 for path in paths)
    task = make_task(ENV, horizon=3)
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
