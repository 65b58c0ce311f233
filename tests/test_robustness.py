"""Robustness from the outside: its pieces, its tables, how it goes on, its errors."""

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_runs import refusal, succeed
from small_suite import SMALL, small_suite

from agents.benchmark import verdict
from agents.benchmark.classes import classes_of
from agents.benchmark.config import Case, load_suite, world
from agents.benchmark.envelopes import EnvelopeStore, run_test
from agents.benchmark.robustness import RobustTrial, error_change, usual_class
from agents.benchmark.training import experiment_of
from agents.workers import Folders
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.envelope import best_mse
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.training.run import train
from fusion_gym.validation import ConfigurationError

CASES = [
    {"name": "loud", "title": "measurement noise ×2", "options": {"true_measurement_noise": 2.0}},
    {"name": "poor", "title": "half the tokens", "scaled": {"token_rate": 0.5}},
]
pytestmark = pytest.mark.usefixtures("few_resamples")
ODD = {"name": "odd", "title": "odd"}


def suite_of(folder: Path, **changes: Any) -> Path:
    drawn = {"true_process_noise": [0.5, 2.0]}
    setting = SMALL["settings"][0] | {"cases": ["loud", CASES[1]], "drawn": drawn} | changes
    return small_suite(folder, settings=[setting], cases=CASES[:1], robustness_episodes=8)


def words_of(suite: Path, folder: Path, *more: str, parts: str = "robustness report") -> list[str]:
    words = ["--config", str(suite), "--results", str(folder), "--work", str(folder / "work")]
    return [*words, "--parts", *parts.split(), "--classes", "sensors", "--workers", "1", *more]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a suite, the committed rules and an agent."""
    folder = tmp_path_factory.mktemp("robust")
    path = suite_of(folder)
    succeed("benchmark", words_of(path, folder / "results", parts="envelopes"))
    suite = load_suite(path)
    of = next(item for item in classes_of(suite.settings[0]) if item.name == "sensors")
    train(experiment_of(suite, suite.settings[0], of, 0, folder / "models"), quiet=True)
    return folder


def with_envelopes(source: Path, target: Path) -> Path:
    shutil.copytree(source / "results" / "small", target / "small")
    shutil.copytree(source / "models" / "small", target / "work" / "small")
    return target


def test_all_of_it(folder: Path, tmp_path: Path) -> None:
    """Rules, an agent and one trained over draws in three cases; then a piece that was lost."""
    path, results = folder / "suite.yaml", with_envelopes(folder, tmp_path)
    words = words_of(path, results, "--trained", "--seeds", "1")
    succeed("benchmark", words)
    (content,) = verdict.read_cases(results, ["small"])
    assert list(content["cases"]) == ["as_assumed", "loud", "poor"]
    nominal, loud, poor = content["cases"].values()
    assert nominal["rules"]["mean"] == 0.0
    assert loud["rules"]["low"] > 0.0
    assert poor["always"] < nominal["always"]
    assert all({"agents", "trained"} <= case.keys() for case in content["cases"].values())
    config = yaml.safe_load((results / "work/trained/small/sensors_0/config.yaml").read_text())
    assert config["environment"]["options"]["true_process_noise"] == [0.5, 2.0]
    table = (results / "robustness" / "README.md").read_text()
    rows = re.findall(r"^\| small \| (.*?) \| (.*?) \|", table, re.M)
    assert [row[0] for row in rows] == ["as assumed", "measurement noise ×2", "half the tokens"]
    assert rows[0][1] == "+0.0% [+0.0%, +0.0%]"

    held = "holds 1 finished pieces of work: go on with --resume"
    assert held in refusal("benchmark", words)
    pieces = sorted((results / "work").rglob("output.pkl"))
    before = {path: path.stat().st_mtime_ns for path in pieces}
    pieces[0].unlink()
    succeed("benchmark", [*words, "--resume"])
    changed = [path for path, time in before.items() if path.stat().st_mtime_ns != time]
    assert changed == pieces[:1]
    assert verdict.read_cases(results, ["small"]) == [content]
    assert (results / "robustness" / "README.md").read_text() == table


def test_a_rule_runs_as_tuned_in_the_world_of_the_case(folder: Path, tmp_path: Path) -> None:
    suite = load_suite(folder / "suite.yaml")
    (setting,) = suite.settings
    of = next(item for item in classes_of(setting) if item.name == "sensors")
    store = EnvelopeStore(suite, folder / "results")
    trial = RobustTrial(suite, setting, of, store, (), 0, Folders(tmp_path, folder / "models"))
    for vertex, test in zip(trial.envelope["vertices"], trial.rules("loud"), strict=True):
        options = setting.environment.options | vertex["options"] | {"true_measurement_noise": 2.0}
        task = make_task(setting.environment.id, **options)
        own = run_episodes(task, make_policy(vertex["policy"], task), 8, suite.seed)
        np.testing.assert_array_equal(run_test(test).mse, own.mse)


def test_change_is_the_ratio_of_the_errors() -> None:
    """Of the same rule the ratio itself, with an interval that holds about 95 % of tries."""
    task = make_task("fusion_gym/RemoteEstimation-v1", horizon=20, tokens="unlimited")
    loud = make_task("fusion_gym/RemoteEstimation-v1", horizon=20, true_process_noise=2.0)
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
        ([], {"cases": [ODD | {"options": {"true_transition": -1.0}}]},
         "odd of small: true_transition = -1.0 is not allowed"),
        ([], {"cases": [ODD | {"scaled": {"filter": 2.0}}]}, "must be a number, and is 'tobit'"),
        ([], {"cases": ["loud", {"name": "loud", "title": "loud"}]}, "cases of small must differ"),
        ([], {"cases": ["silent"]}, "'silent' is none of ['loud']"),
        (["--trained"], {"drawn": {}}, "trained = True is not allowed with small"),
        (["--agents", "absent/*.zip"], {}, "agents = 'absent/*.zip'"),
    ],
)  # fmt: skip
def test_what_is_not_allowed_is_reported_before_anything_runs(
    folder: Path, tmp_path: Path, words: list[str], changes: dict[str, Any], text: str
) -> None:
    results = with_envelopes(folder, tmp_path)
    assert text in refusal("benchmark", words_of(suite_of(tmp_path, **changes), results, *words))
    assert not (results / "work" / "pieces").exists()


def test_shipped_cases_fit_the_shipped_suite() -> None:
    """Every case of every setting makes a task, and none is the setting itself."""
    suite = load_suite("benchmark")
    for setting in suite.settings:
        assert len(suite.cases_of(setting)) > 7
        for case in suite.cases_of(setting):
            changed = world(setting, case).environment
            make_task(changed.id, **changed.options)
            assert (changed == setting.environment) == (case.name == "as_assumed")
        drawn = setting.environment.options | setting.drawn
        assert make_task(setting.environment.id, **drawn)
    assert {item.name for item in suite.settings if usual_class(suite, item) == "sensors"} == {
        "markov_jump",
        "remote_estimation",
    }


def test_scaled_options_have_defaults() -> None:
    """An option that the setting does not name is scaled from the environment's default."""
    suite = load_suite("benchmark")
    setting = next(setting for setting in suite.settings if setting.name == "tobit_oscillator")
    case = Case(name="a", title="a", scaled={"token_capacity": 0.5, "token_rate": 0.5})
    options = world(setting, case).environment.options
    assert (options["token_capacity"], options["token_rate"]) == (15.0, 1.0)
    with pytest.raises(ConfigurationError, match="must be a number, and is None"):
        world(setting, Case(name="a", title="a", scaled={"nothing": 2.0}))
