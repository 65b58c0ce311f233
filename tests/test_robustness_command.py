"""``fusion-gym robustness`` from the outside: its pieces, its table, how it goes on, its errors."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_runs import call
from small_suite import small_suite

from fusion_gym.agents.experiments import verdict
from fusion_gym.agents.experiments.classes import classes_of
from fusion_gym.agents.experiments.config import Case, load_robustness, load_suite, world
from fusion_gym.agents.experiments.robustness import error_change
from fusion_gym.agents.experiments.training import experiment_of
from fusion_gym.agents.experiments.verdict import read_cases
from fusion_gym.agents.robustness import _usual_class
from fusion_gym.agents.training.config import Experiment
from fusion_gym.agents.training.run import train
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.envelope import best_mse
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

CASES = [
    {"name": "loud", "title": "measurement noise ×2", "options": {"true_measurement_noise": 2.0}},
    {"name": "poor", "title": "half the tokens", "scaled": {"token_rate": 0.5}},
]
ODD = {"name": "odd", "title": "odd"}
COMMON = ["--class", "sensors", "--workers", "1", "--episodes", "8"]


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Intervals are made in no time."""
    monkeypatch.setattr(verdict, "RESAMPLES", 20)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a suite, its envelope, an agent and a config of cases."""
    folder = tmp_path_factory.mktemp("robust")
    suite_path = small_suite(folder)
    words = ["--config", str(suite_path), "--classes", "sensors", "--workers", "1"]
    words += ["--results", str(folder / "results"), "--work", str(folder / "tuned")]
    ended = call("envelope", words, seconds=120.0)
    assert ended.status == 0, ended.err + ended.trace
    suite = load_suite(suite_path)
    of = next(item for item in classes_of(suite.settings[0]) if item.name == "sensors")
    experiment: Experiment = experiment_of(suite, suite.settings[0], of, 0, folder / "models")
    train(experiment, quiet=True)
    write_config(folder / "robust.yaml", suite_path)
    return folder


def write_config(path: Path, suite: Path, **changes: Any) -> Path:
    setting = {
        "setting": "small",
        "shared": ["loud"],
        "own": [CASES[1]],
        "drawn": {"true_process_noise": [0.5, 2.0]},
    }
    content = {"suite": str(suite), "cases": CASES[:1], "settings": [setting | changes]}
    path.write_text(yaml.safe_dump(content))
    return path


def words_of(path: Path, results: Path, *more: str) -> list[str]:
    settings = {"--config": path / "robust.yaml", "--models": path / "models", "--results": results}
    settings |= {"--work": results / "work"}
    return [*COMMON, *(str(word) for pair in settings.items() for word in pair), *more]


def with_envelopes(result: Path, folder: Path) -> Path:
    shutil.copytree(result / "results" / "small", folder / "small")
    return folder


def test_all_of_it(folder: Path, tmp_path: Path) -> None:
    """Rules, an agent and one trained over draws in three cases; then a piece that was lost."""
    results = with_envelopes(folder, tmp_path)
    line = words_of(folder, results, "--trained", "--seeds", "1")
    ended = call("robustness", line, seconds=300.0)
    assert (ended.status, ended.trace) == (0, ""), ended.err
    place = results / "work" / "small" / "sensors"
    files = [path for path in place.glob("*/*.json") if path.stem != "verdict"]
    pieces = sorted(str(path.relative_to(place)) for path in files)
    labels = ("agent_0", "rules", "trained_0")
    assert pieces == [f"{c}/{p}.json" for c in ("as_assumed", "loud", "poor") for p in labels]
    (content,) = read_cases(results, ["small"])
    assert list(content["cases"]) == ["as_assumed", "loud", "poor"]
    nominal, loud, poor = content["cases"].values()
    assert nominal["rules"]["mean"] == 0.0
    assert loud["rules"]["low"] > 0.0
    assert poor["always"] < nominal["always"]
    trained = json.loads((place / "loud" / "trained_0.json").read_text())
    assert trained["inputs"]["environment"]["options"]["true_measurement_noise"] == 2.0
    config = yaml.safe_load((results / "work/trained/small/sensors_0/config.yaml").read_text())
    assert config["environment"]["options"]["true_process_noise"] == [0.5, 2.0]
    table = (results / "robustness" / "README.md").read_text()
    rows = re.findall(r"^\| small \| (.*?) \| (.*?) \|", table, re.M)
    assert [row[0] for row in rows] == ["as assumed", "measurement noise ×2", "half the tokens"]
    assert rows[0][1] == "+0.0% [+0.0%, +0.0%]"

    again = call("robustness", line)
    assert again.status == 1
    assert "holds 9 finished pieces of work: go on with --resume" in again.err
    before = {path: path.stat().st_mtime_ns for path in files}
    lost = place / "loud" / "rules.json"
    lost.unlink()
    ended = call("robustness", [*line, "--resume"], seconds=120.0)
    assert (ended.status, ended.trace) == (0, ""), ended.err
    changed = [path for path, time in before.items() if path.stat().st_mtime_ns != time]
    assert changed == [lost]
    assert read_cases(results, ["small"]) == [content]
    assert (results / "robustness" / "README.md").read_text() == table

    other = [word if word != "8" else "9" for word in line]
    ended = call("robustness", [*other, "--resume"])
    assert ended.status == 1
    assert "episodes = 9 differs from that of" in ended.err


def test_a_piece_holds_what_a_rule_does_in_its_case(folder: Path, tmp_path: Path) -> None:
    results = with_envelopes(folder, tmp_path)
    ended = call("robustness", words_of(folder, results), seconds=120.0)
    assert (ended.status, ended.trace) == (0, ""), ended.err
    place = results / "work" / "small" / "sensors"
    report = json.loads((place / "loud" / "rules.json").read_text())
    suite = load_suite(folder / "suite.yaml")
    environment = suite.settings[0].environment
    for name, policy in report["policies"].items():
        entry = report["inputs"]["policies"][name]
        options = environment.options | entry["options"] | {"true_measurement_noise": 2.0}
        task = make_task(environment.id, **options)
        results_of = run_episodes(task, make_policy(entry["policy"], task), 8, suite.seed)
        assert policy["mse"]["mean"] == pytest.approx(float(results_of.mse.mean()))
    assert "trained_0.json" not in [path.name for path in place.glob("*/*")]


def test_change_is_the_ratio_of_the_errors() -> None:
    """Of the same rule the ratio itself, with an interval that holds about 95 % of tries."""
    task = make_task("fusion_gym/RemoteEstimation-v0", horizon=20, tokens="unlimited")
    loud = make_task("fusion_gym/RemoteEstimation-v0", horizon=20, true_process_noise=2.0)
    names = ("never", "always")
    before, after = (
        {name: run_episodes(item, make_policy(name, item), 50, 0) for name in names}
        for item in (task, loud)
    )
    result = error_change(before, after, 0.5)
    assert result is not None
    assert result["mean"] == pytest.approx(3.0)  # four times the variance, on the same noise
    assert result["high"] - result["low"] < 1e-6
    other = {name: run_episodes(loud, make_policy(name, loud), 50, 900) for name in names}
    result = error_change(before, other, 0.5)
    assert result is not None
    assert result["low"] < 3.0 < result["high"]
    below = best_mse(before, 0.5)
    assert below is not None
    assert error_change({"always": before["always"]}, after, 0.5) is None


@pytest.mark.parametrize(
    ("words", "changes", "text"),
    [
        ([], {"own": [ODD | {"options": {"true_transition": -1.0}}]},
         "odd of small: true_transition = -1.0 is not allowed"),
        ([], {"own": [ODD | {"scaled": {"filter": 2.0}}]}, "must be a number, and is 'tobit'"),
        ([], {"own": [{"name": "loud", "title": "loud"}]}, "cases of small must differ"),
        ([], {"shared": ["silent"]}, "'silent' is none of ['loud']"),
        ([], {"setting": "large"}, "setting = 'large' is not allowed: it must be one of 'small'"),
        (["--trained"], {"drawn": {}}, "trained = True is not allowed with small"),
        (["--agents", "absent/*.zip"], {}, "agents = 'absent/*.zip'"),
    ],
)  # fmt: skip
def test_what_is_not_allowed_is_reported_before_anything_runs(
    folder: Path, tmp_path: Path, words: list[str], changes: dict[str, Any], text: str
) -> None:
    results = with_envelopes(folder, tmp_path)
    config = write_config(tmp_path / "other.yaml", folder / "suite.yaml", **changes)
    line = [str(config) if word == str(folder / "robust.yaml") else word
            for word in words_of(folder, results, *words)]  # fmt: skip
    ended = call("robustness", line)
    assert (ended.status, ended.trace) == (1, "")
    assert text in ended.err.splitlines()[-1]
    assert not list((results / "work").glob("*/*/*"))


def test_shipped_cases_fit_the_shipped_suite() -> None:
    """Every case of every setting makes a task, and none is the setting itself."""
    config = load_robustness("robustness")
    suite = load_suite(config.suite)
    by_name = {setting.name: setting for setting in suite.settings}
    assert {setting.setting for setting in config.settings} == set(by_name)
    for item in config.settings:
        for case in config.cases_of(item):
            changed = world(by_name[item.setting], case).environment
            make_task(changed.id, **changed.options)
            same = changed == by_name[item.setting].environment
            assert same == (case.name == "as_assumed")
        drawn = by_name[item.setting].environment.options | item.drawn
        assert make_task(by_name[item.setting].environment.id, **drawn)


def test_scaled_options_have_defaults() -> None:
    """An option that the setting does not name is scaled from the environment's default."""
    suite = load_suite("benchmark")
    setting = next(setting for setting in suite.settings if setting.name == "tobit_oscillator")
    case = Case(name="a", title="a", scaled={"token_capacity": 0.5, "token_rate": 0.5})
    options = world(setting, case).environment.options
    assert (options["token_capacity"], options["token_rate"]) == (15.0, 1.0)
    with pytest.raises(ConfigurationError, match="must be a number, and is None"):
        world(setting, Case(name="a", title="a", scaled={"nothing": 2.0}))
    assert np.isfinite(options["token_rate"])


def test_without_a_class_it_takes_the_scheduler_that_knows_most() -> None:
    suite = load_suite("benchmark")
    taken = {setting.name: _usual_class(suite, setting) for setting in suite.settings}
    assert {name for name, of in taken.items() if of == "sensors"} == {
        "markov_jump",
        "remote_estimation",
    }
    assert set(taken.values()) == {"sensors", "sensors_memory"}
