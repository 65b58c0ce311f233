"""The scripts, used as a user does: configs, evaluation, training with interrupts, the demo."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_runs import call, refusal, succeed
from paths import ROOT
from refusals import refused
from training_configs import ENV, read_records, small_config

import fusion_gym
from fusion_gym.commands import demo
from fusion_gym.evaluation.metrics import METRICS
from fusion_gym.training import run as train
from fusion_gym.training.config import TABLE, Experiment, load_checked
from fusion_gym.validation import ConfigurationError

CONFIGS = ROOT / "configs"
EXPERIMENTS = [f for f in sorted(CONFIGS.glob("*.yaml")) if "\ntraining:" in f.read_text()]


@pytest.mark.parametrize("path", EXPERIMENTS, ids=lambda path: path.stem)
def test_committed_experiments_are_valid(path: Path) -> None:
    experiment = load_checked(Experiment, path)
    task = fusion_gym.make_task(experiment.environment.id, **experiment.environment.options)
    if task.options.access != "single":
        assert task.options.action in TABLE[experiment.algorithm.name].actions
    binary = "binary" in TABLE[experiment.algorithm.name].actions
    assert (task.options.action == "binary") == (binary or task.options.access == "single")


UNREADABLE = {
    "absent": (None, ["unreadable.yaml"]),
    "half": (b"a: [1,", ["not YAML"]),
    "bytes": (b"\xff\xfe\x00", ["not UTF-8 text"]),
    "twice": (
        b"a: &base {seed: 1}\nb:\n  <<: *base\n  seed: 2\nc:\n  seed: 1\n  seed: 2\n",
        ["the key 'seed' appears twice", "line 7"],
    ),
}


@pytest.mark.parametrize("name", UNREADABLE)
def test_a_config_that_cannot_be_read(tmp_path: Path, name: str) -> None:
    path, (content, message) = tmp_path / "unreadable.yaml", UNREADABLE[name]
    if content is not None:
        path.write_bytes(content)
    refused(lambda: load_checked(Experiment, path), *message)


def test_numbers_with_an_exponent_are_numbers(tmp_path: Path) -> None:
    """YAML 1.1 takes 1e-3 for a word."""
    path = small_config(tmp_path)
    path.write_text(path.read_text().replace("name: ppo", "name: ppo\n  learning_rate: 1e-3"))
    assert load_checked(Experiment, path).algorithm.learning_rate == 0.001


def test_validation_counts_episodes_by_their_price(tmp_path: Path) -> None:
    """A record's return weighs the returns as training does."""
    path = small_config(tmp_path)
    content = yaml.safe_load(path.read_text())
    content["environment"]["options"] |= {"cost_weight": "random", "price_range": [0.01, 1.0]}
    content["training"] |= {"price_exponent": 1.0, "timesteps": 2048}
    path.write_text(yaml.safe_dump(content))
    train.train(load_checked(Experiment, path), quiet=True)
    record = read_records(tmp_path / "run")[-1]
    costs = np.array([row["cost"] for row in record["prices"]])
    weights = 0.1 / np.array([row["price"] for row in record["prices"]])
    horizon = content["environment"]["options"].get("horizon", 100)
    assert record["return"] == pytest.approx(-horizon * float((weights * costs).mean()))


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_an_interrupted_training_loses_nothing(tmp_path: Path, number: signal.Signals) -> None:
    config = small_config(tmp_path, training={"timesteps": 10_000_000, "num_envs": 8})
    command = [sys.executable, "-m", "fusion_gym.commands", "train", "--config", str(config)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    folder = tmp_path / "run"
    deadline = time.monotonic() + 120
    while not (folder / "latest.zip").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    os.kill(process.pid, number)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    message, again = error.decode().splitlines()[-1].split("continue with: ")
    assert message == "interrupted; "
    assert shlex.split(again) == ["fusion-gym", *command[3:], "--resume"]
    summary = json.loads((folder / "summary.json").read_text())
    assert not summary["finished"]
    records = len(read_records(folder))
    _, name, *words = shlex.split(again)
    assert call(name, [*words, "--timesteps", str(summary["timesteps"] + 1500)]).status == 0
    later = json.loads((folder / "summary.json").read_text())
    assert later["finished"]
    assert later["timesteps"] >= summary["timesteps"] + 1500
    assert len(read_records(folder)) > records


def test_evaluation_writes_the_promised_json(tmp_path: Path) -> None:
    file = tmp_path / "deep" / "result.json"
    words = ["--env", ENV, "--set", "filter=tobit", "horizon=20", "--set", "tokens=unlimited"]
    words += ["--policies", "always", "random:rate=0.5", "--episodes", "30", "--seed", "3"]
    succeed("evaluate", [*words, "--reference", "always", "--json", str(file)])
    written = json.loads(file.read_text())
    assert list(written) == [
        *("env", "episodes", "seed", "horizon", "settings", "states", "policies", "quantiles"),
        "reference",
    ]
    assert (written["env"], written["episodes"], written["horizon"]) == (ENV, 30, 20)
    assert written["settings"]["filter"] == "tobit"
    always = written["policies"]["always"]
    assert always["rate"] == [1.0, 1.0, 1.0]
    assert len(written["states"]) == len(always["armse"]) == 2
    assert set(always) == {name for name, metric in METRICS.items() if not metric.loop}
    for key in ("mse", "bound_trace", "nees", "tokens", "denied", "return"):
        assert always[key]["low"] <= always[key]["mean"] <= always[key]["high"]
    difference = written["reference"]["differences"]["random:rate=0.5"]
    random = written["policies"]["random:rate=0.5"]
    assert difference["mean"] == pytest.approx(random["mse"]["mean"] - always["mse"]["mean"])


def test_demo_from_training_to_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the demo's agents, with short episodes and small batches."""
    for name, config in demo.CONFIGS.items():  # the process beside trains with its own config
        content = yaml.safe_load((CONFIGS / f"{config}.yaml").read_text())
        content["environment"]["options"] |= {"horizon": 10, "price_range": [0.01, 1.0]}
        content["training"]["num_envs"] = content["validation"]["episodes"] = 16
        content["calibration"] = {"episodes": [2, 4]}
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump(content))
        monkeypatch.setitem(demo.CONFIGS, name, str(tmp_path / f"{name}.yaml"))
    words = ["--output", str(tmp_path), "--episodes", "2", "--timesteps", "256"]
    printed = succeed("demo", words).out
    *_, trained, rules, trigger, pictures = filter(str.strip, printed.splitlines())
    assert trained.split()[:3] == ["trained", "2", "agents,"]
    assert re.fullmatch(r"saved against the best rule at each price +-?[\d.]+%, -?[\d.]+%", rules)
    assert re.fullmatch(r"saved .* paper's trigger \(tobit_oscillator\) +-?[\d.]+%", trigger)
    assert pictures.endswith("pareto.png")
    for name in demo.CONFIGS:
        folder = tmp_path / name
        assert (folder / "comparison" / "pareto.png").stat().st_size > 20_000
        assert json.loads((folder / "agent" / "summary.json").read_text())["finished"]
        rows = json.loads((folder / "comparison" / "comparison.json").read_text())["prices"]
        assert len(rows) == 7
        for row in rows:
            assert f"{row['policies']['model:calibrated_model.zip']['mean']:.4g}" in printed
    assert "--resume" in refusal("demo", words)
    succeed("demo", [*words, "--resume", "--only", "tobit_oscillator"])


@pytest.mark.slow
def test_an_interrupted_demo_ends_both_trainings(tmp_path: Path) -> None:
    """With a checkpoint of each, also if only the command receives the signal."""
    command = [sys.executable, "-m", "fusion_gym.commands", "demo", "--output", str(tmp_path)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    folders = [tmp_path / name / "agent" for name in demo.CONFIGS]
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        if all((folder / "validation.jsonl").exists() for folder in folders):
            break
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGTERM)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert error.decode().rstrip().endswith("--resume")
    for folder in folders:
        assert (folder / "latest.zip").exists()
        assert not json.loads((folder / "summary.json").read_text())["finished"]


def test_a_failed_process_of_the_demo_names_its_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["program", f"--output={tmp_path}", "--episodes=0"])
    process = demo.Demo(output=tmp_path).process("linear_fusion")
    with pytest.raises(ConfigurationError, match=r"demo\.log"), process:
        pass
    assert "episodes" in (tmp_path / "linear_fusion" / "demo.log").read_text()
