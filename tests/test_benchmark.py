"""The benchmark of policies: tuning, verdict, report, zoo, resuming, and hyper-parameters."""

import hashlib
import json
import multiprocessing
import sys
import xml.etree.ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pandas as pd
import pytest
import yaml
from command_runs import call, refusal, succeed
from small_results import small_results
from small_suite import ENV, SMALL, small_suite
from training_configs import small_config

import fusion_gym
from agents.benchmark import training as jobs
from agents.benchmark.classes import classes_of, trained_classes
from agents.benchmark.config import load_suite
from agents.benchmark.envelopes import envelope_task, read_envelopes, searches_of
from agents.benchmark.figures import report_text
from agents.benchmark.markup import code, page_of
from agents.benchmark.report import SettingResults, read_results
from agents.benchmark.tables import read_rows, write_rows
from agents.workers import Folders
from fusion_gym.commands import tune
from fusion_gym.core.system import covers
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.training.checked import load_checked
from fusion_gym.training.config import Experiment
from fusion_gym.validation import ConfigurationError

ROOT = Path(__file__).parent.parent


@pytest.mark.usefixtures("few_resamples")
def test_from_tuning_to_report_and_zoo(tmp_path: Path) -> None:
    results, work = tmp_path / "results", tmp_path / "work"
    arguments = [
        "--config", str(small_suite(tmp_path)), "--results", str(results), "--work", str(work),
        "--workers", "1",
    ]  # fmt: skip
    succeed("benchmark", [*arguments, "--seeds", "1", "--classes", "sensors"])
    folder = work / "small"
    assert SettingResults(results / "small").classes["sensors"]["seeds"] == 1
    stamp = (folder / "sensors_0" / "latest.zip").stat().st_mtime_ns
    assert "--resume" in refusal("benchmark", arguments)
    succeed("benchmark", [*arguments, "--resume"])
    assert (folder / "sensors_0" / "latest.zip").stat().st_mtime_ns == stamp
    error = refusal("benchmark", [*arguments, "--resume", "--timesteps", "512"])
    assert "training.timesteps = 512 differs" in error
    classes = SettingResults(results / "small").classes
    assert {name: front["seeds"] for name, front in classes.items()} == {
        "centre": 2, "local_estimate": 2, "local_packets_memory": 2, "sensors": 2,
    }  # fmt: skip
    policies = pd.read_csv(results / "small" / "policies.csv")
    assert set(policies[policies["family"] == "gain"]["knows"]) == {"centre"}
    assert list(policies[policies["run"] == "genie"]["name"]) == ["everything arrives"]
    runs = pd.read_csv(results / "small" / "runs.csv").set_index("run")
    assert runs["episodes"]["hindsight"] == 5
    dear = policies[policies["run"] == "hindsight"].set_index("name")["tokens"]
    assert dear["hindsight at price 0.1"] < dear["hindsight at price 0.001"]
    # The envelope that an agent was compared with, and that it is one of the agent's inputs.
    committed = read_envelopes(results / "small")["classes"]
    front = classes["local_estimate"]
    assert front["sha256"] == committed["local_estimate"]["sha256"]
    stored = json.loads(runs["inputs"]["agent_local_estimate_1"])["envelope"]
    assert stored == {"class": "local_estimate", "sha256": front["sha256"]}
    in_local = {point["name"] for point in classes["local_estimate"]["envelope"]}
    assert not any(name.startswith("information_gain") for name in in_local)
    training = json.loads(runs["inputs"]["agent_local_estimate_1"])["training"]
    assert training["environment"]["local"]
    agent = policies[policies["run"] == "agent_local_estimate_1"]
    assert len(agent) == 3
    # The written numbers are those that the saved model reaches on the test seeds.
    visible = ["difference", "value"]  # as rules without memory look at it
    task = fusion_gym.make_task(ENV, filter="tobit", horizon=10, belief_features=visible)
    path = work / "small" / "local_estimate_1" / "best_model.zip"
    model = f"model:{path},price={float(agent['price'].iloc[1])!r}"
    again = run_episodes(task, make_policy(model, task), 12, seed=0)
    assert agent["mse"].iloc[1] == pytest.approx(again.mse.mean())

    text = (results / "README.md").read_text()
    assert "| local_packets_memory | 2 |" in text
    assert "Agents of a class: 2 training seeds." in text
    page = (results / "report.html").read_text()
    assert page.count('src="data:image/png;base64,') == 2
    for figure in ("overview", "small/pareto"):
        assert f'src="{figure}' not in page
        xml.etree.ElementTree.parse(results / f"{figure}.svg")

    words = ["--results", str(results), "--work", str(work), "--zoo", str(tmp_path / "zoo")]
    assert "zoo:small_local_estimate" in succeed("zoo", words).out
    card = json.loads((tmp_path / "zoo" / "small_sensors.json").read_text())
    assert card["env"] == ENV
    content = (tmp_path / "zoo" / "small_sensors.zip").read_bytes()
    assert card["sha256"] == hashlib.sha256(content).hexdigest()
    assert (tmp_path / "zoo" / "small_sensors.zip").stat().st_size < 300_000
    journal_entry = json.loads((tmp_path / "zoo" / "small_local_packets_memory.json").read_text())
    task = fusion_gym.make_task(ENV, **journal_entry["options"])
    smaller = f"model:{tmp_path / 'zoo' / 'small_local_packets_memory.zip'},price=0.01"
    seed = journal_entry["training"]["training"]["seed"]
    whole = f"model:{work / 'small' / f'local_packets_memory_{seed}' / 'best_model.zip'},price=0.01"
    first, second = (run_episodes(task, make_policy(p, task), 4, seed=0) for p in (smaller, whole))
    np.testing.assert_array_equal(first.mse, second.mse)


@pytest.mark.usefixtures("unsearched")
def test_the_committed_suite_fits_its_environments(monkeypatch: pytest.MonkeyPatch) -> None:
    # More than one optimum of two sources would take minutes.
    tasks: dict[str, Any] = {}

    def task_of(setting: Any, options: Any = ()) -> Any:
        name = f"{setting.name} {options}"
        tasks[name] = tasks.get(name) or envelope_task(setting, options)
        return tasks[name]

    monkeypatch.setattr("agents.benchmark.envelopes.envelope_task", task_of)
    suite = load_suite(ROOT / "configs" / "benchmark.yaml")
    assert load_suite(ROOT / "configs" / "benchmark.yaml", quick=True).settings == suite.settings
    for setting in suite.settings:
        task = envelope_task(setting)
        optima = [name for name in setting.informed if name.startswith("optimal:")]
        for name in (*setting.points, *setting.informed, *setting.references):
            if name not in optima[1:]:
                make_policy(name, task)
        for search in searches_of(suite, setting, list(classes_of(setting))):
            search.check()
        if setting.genie is not None:
            fusion_gym.make_task(
                setting.environment.id, **(setting.environment.options | setting.genie.options)
            )


@pytest.mark.parametrize(
    "path", sorted((ROOT / "results").glob("*/classes.csv")), ids=lambda path: path.parent.name
)
def test_envelopes_hold_rules_that_know_no_more_than_their_class(path: Path) -> None:
    """What the committed envelopes say of a rule's knowledge is the rule's own word."""
    stored, tasks = read_envelopes(path.parent), {}
    for content in stored["classes"].values():
        for vertex in content["vertices"]:
            key = json.dumps(vertex["options"], sort_keys=True)
            if key not in tasks:
                env = stored["env"].replace("-v0", "-v1")  # measured in an earlier version
                tasks[key] = fusion_gym.make_task(env, **(stored["options"] | vertex["options"]))
            assert make_policy(vertex["policy"], tasks[key]).knowledge == vertex["knows"]
            assert covers(content["knows"], vertex["knows"])


def test_trainings_of_the_committed_suite(tmp_path: Path) -> None:
    """Agents see what their class knows and the price, nothing else; settings override."""
    suite = load_suite(ROOT / "configs" / "benchmark.yaml")
    visited: set[tuple[str, str]] = set()
    for setting in suite.settings:
        for of in trained_classes(suite, setting):
            visited.add((setting.name, of.name))
            experiment = jobs.experiment_of(suite, setting, of, 3, tmp_path)
            options, training = experiment.environment.options, experiment.training
            assert experiment.environment.local == (of.mode == "local")
            assert options.get("memory", False) == of.memory
            assert options.get("packet", "measurement") == of.packet
            assert ("belief_features" in options) == (of.mode != "centre" and not of.memory)
            assert (options.get("information") == "centre") == (of.mode == "centre")
            assert options["price_range"] == list(setting.price_range)
            task = jobs.agent_task(setting, of)
            if of.mode == "local":
                assert task.broadcast == of.broadcast
            assert training.seed == 3
            length = setting.lengths.get(of.name, setting.lengths.get(of.mode, 1.0))
            assert training.timesteps == suite.timesteps * setting.longer * length
            assert training.error == (setting.error or suite.error)
            changes = setting.algorithm | suite.algorithms.get(of.mode, {})
            changes |= setting.algorithms.get(of.mode, {})
            arguments = experiment.algorithm.model_dump()
            assert all(arguments[key] == changes[key] for key in changes.keys() - {"network"})
    every = {(s.name, c.name) for s in suite.settings for c in classes_of(s)}
    # Nodes that remember by themselves, and sources that leave nothing to remember.
    left = ("markov_jump", "remote_estimation")
    assert every - visited == {
        (name, class_name)
        for name, class_name in every
        if name in left and class_name.endswith("_memory")
    }  # fmt: skip


def test_a_work_folder_of_an_earlier_version_is_refused(tmp_path: Path) -> None:
    (tmp_path / "work" / "small" / "tuned").mkdir(parents=True)
    with pytest.raises(ConfigurationError, match=r"of an earlier version: give another --work"):
        Folders.create(tmp_path, tmp_path / "work", quick=False)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"famlies": []}, "famlies"),
        ({"prices": 0}, "prices = 0"),
        (
            {"families": [SMALL["families"][0] | {"parameters": {"a": {"low": 2, "high": 1}}}]},
            "low = 2.0 must be below high = 1.0",
        ),
        *(
            ({"settings": [SMALL["settings"][0] | {field: value}]}, message)
            for field, value, message in (
                ("families", ["none"], "'none' is none of"),
                ("agents", ["local_none"], "agents of small = 'local_none' is not allowed"),
                ("envs", {"locale": 2}, "envs of small = 'locale' is not"),
                ("lengths", {"locale": 2}, "lengths of small = 'locale' is not"),
            )
        ),
    ],
)
def test_a_suite_that_is_not_allowed(tmp_path: Path, changes: Any, message: str) -> None:
    def check(path: Path) -> None:
        suite = load_suite(path)
        trained_classes(suite, suite.settings[0])

    with pytest.raises(ConfigurationError, match=message):
        check(small_suite(tmp_path, **changes))


def test_the_report_shows_what_it_is_reported_as_text(tmp_path: Path) -> None:
    """Titles, policies and folders in HTML, Markdown and with a table's bars stay what they are."""
    folder = small_results(tmp_path, "a<b>_[c](javascript:d)")
    title = 'x <script>alert(1)</script> | *y* [z](javascript:alert(2)) `<img src=x onerror="e">`'
    (verdict,) = read_rows(folder, "verdict")
    verdict["title"] = title + "\n\n<script>alert(3)</script>"
    verdict["env"] = "a`<script>alert(4)</script>|b"
    write_rows(folder, "verdict", [verdict])
    text = report_text(read_results(tmp_path))
    text += "\n\n<script>alert(5)</script> <b onclick='f'>g</b>\n"
    page = page_of(text, tmp_path, "<script>alert(6)</script>")
    assert "<title>&lt;script&gt;alert(6)&lt;/script&gt;</title>" in page
    inside = page[page.index("<body>") :].partition("</html")[0]
    body = xml.etree.ElementTree.fromstring(inside)
    assert not {"script", "a", "b"} & {element.tag for element in body.iter()}
    assert not any("onerror" in element.attrib for element in body.iter())
    message = "".join(body.itertext())
    assert " ".join(verdict["title"].split()) in message
    assert "a`<script>alert(4)</script>" in message
    assert "<script>alert(5)</script>" in message
    assert code("a|b``c") == "``` a\\|b``c ```"  # a bar would end the cell on other pages


@pytest.mark.parametrize("name", fusion_gym.zoo.names())
def test_agents_of_the_zoo_reach_their_numbers(name: str) -> None:
    """The card's first 60 episodes at its middle price, to what their mean allows."""
    card = fusion_gym.zoo.card(name)
    centre = {"information": "centre"} if card["mode"] == "centre" else {}
    task = fusion_gym.make_task(card["env"], **(card["options"] | centre))
    place = len(card["test"]["prices"]) // 2
    policy = make_policy(f"zoo:{name},price={card['test']['prices'][place]!r}", task)
    results = run_episodes(task, policy, 60, card["test"]["seed"])
    received = card["test"]["points"][place]
    deviation = results.mse.std() / np.sqrt(60)
    assert results.mse.mean() == pytest.approx(received["mse"]["mean"], abs=4.5 * deviation)
    assert np.mean(received["rate"]) == pytest.approx(results.rate.mean(), abs=0.03)


def small_tuning(folder: Path, seed: int = 0) -> Path:
    training = {"timesteps": 512, "num_envs": 8, "seed": seed}
    return small_config(folder, training=training, validation={"every": 256, "episodes": 4})


def test_processes_share_a_study(tmp_path: Path) -> None:
    """Two at once make so many trials in all; a third finds them made, and says what was best.

    They are forks of this process, which has imported everything.
    """
    config, storage = small_tuning(tmp_path), f"sqlite:///{tmp_path / 'shared.db'}"

    def begun(name: str) -> Any:
        words = ["--config", str(config), "--trials", "4", "--storage", storage]
        words += ["--output", str(tmp_path / name)]
        forking = multiprocessing.get_context("fork")
        process = forking.Process(target=lambda: sys.exit(call("tune", words).status))
        process.start()
        return process

    for names in (("one", "two"), ("three",)):
        processes = [begun(name) for name in names]
        for process in processes:
            process.join(120)
            assert process.exitcode == 0
    (name,) = optuna.get_all_study_names(storage)
    study = optuna.load_study(study_name=name, storage=storage)
    folders = [path.name for item in ("one", "two") for path in (tmp_path / item).glob("trial_*")]
    assert len(folders) == len(set(folders)) == len(study.trials)
    assert 4 <= len(study.trials) <= 5  # both may begin the last one
    assert not list((tmp_path / "three").glob("trial_*"))
    content = yaml.safe_load((tmp_path / "three" / "best.yaml").read_text())
    assert content["algorithm"]["learning_rate"] == study.best_params["learning_rate"]
    for wrong in ("nonsense://x", "sqlite:////nowhere/x.db"):
        with pytest.raises(ConfigurationError, match=f"storage = '{wrong}' is not allowed"):
            tune.tune(load_checked(Experiment, config), 1, tmp_path / "four", wrong)


def test_tuning_goes_on_with_its_study(tmp_path: Path) -> None:
    config, folder = small_tuning(tmp_path), tmp_path / "study"

    def words(folder: Path, trials: int, *more: str) -> list[str]:
        given = ["--config", str(config), "--output", str(folder), "--trials", str(trials)]
        return [*given, *more]

    def trials_of(folder: Path) -> list[Any]:
        study = optuna.load_study(study_name="tune", storage=f"sqlite:///{folder / 'study.db'}")
        return [(t.params, t.value) for t in study.trials if t.state.is_finished() and t.values]

    class Killed(BaseException):
        """The process is gone."""

    def killed(*_: Any) -> None:
        raise Killed

    succeed("tune", words(folder, 1))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fusion_gym.training.monitor.Progress.finish", killed)
        assert "Killed" in call("tune", words(folder, 3)).trace
    for trials in (2, 3, 3):
        succeed("tune", words(folder, trials))
    succeed("tune", words(tmp_path / "whole", 3))
    assert trials_of(folder) == trials_of(tmp_path / "whole")
    rates = {parameters["learning_rate"] for parameters, _ in trials_of(folder)}
    assert len(rates) == 3, "random trials are not repeated"
    study = optuna.load_study(study_name="tune", storage=f"sqlite:///{folder / 'study.db'}")
    assert len(study.trials) == 4, "the killed one is there, and counts for nothing"
    trainings = sorted(path.name for path in folder.glob("trial_*"))
    assert trainings == ["trial_0", "trial_1", "trial_2"], "it was gone on with"
    best = (folder / "best.yaml").read_text()
    assert best.startswith("# Found by fusion-gym tune --config")
    assert ": best of 3 trials, " in best.splitlines()[0]
    shorter = refusal("tune", words(folder, 4, "--timesteps", "256"))
    assert "timesteps = 256 differs" in shorter
    small_tuning(tmp_path, seed=7)
    assert "training.seed = 7 differs" in refusal("tune", words(folder, 4))
    assert trials_of(folder) == trials_of(tmp_path / "whole")
    algorithm = yaml.safe_load(best)["algorithm"]
    assert algorithm["learning_rate"] == study.best_params["learning_rate"]
    assert "trials = 0" in refusal("tune", words(tmp_path / "x", 0))
