"""rl-zoo3 with the shipped file of hyper-parameters: training, evaluation, playing."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from rl_zoo3.enjoy import enjoy
from rl_zoo3.train import train

import fusion_gym
from fusion_gym.evaluation import run_episodes
from integrations.page import ROOT, command

ENTRIES = yaml.safe_load((ROOT / "configs" / "rl_zoo3" / "ppo.yml").read_text())
TOBIT = "fusion_gym/TobitOscillator-v1"


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The page's command, for two rollouts of fewer runs; its folder and what it said."""
    folder = tmp_path_factory.mktemp("zoo")
    short = ["-n", "4096", "--eval-freq", "2048", "-f", str(folder), "--seed", "0"]
    words = [*command("rl-zoo3"), *short, "--hyperparams", "n_envs:32", "batch_size:512"]
    assert words[0] == "python"
    done = subprocess.run(
        [sys.executable, *words[1:]], cwd=ROOT, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return folder, done.stdout


def test_the_pages_command_trains_in_one_batch(trained: tuple[Path, str]) -> None:
    folder, output = trained
    run = folder / "ppo" / "fusion_gym-TobitOscillator-v1_1"
    assert (run / "best_model.zip").exists()
    assert "one_batch" in (run / "fusion_gym-TobitOscillator-v1" / "config.yml").read_text()
    evaluated = np.load(run / "evaluations.npz")
    assert set(evaluated["ep_lengths"].ravel().tolist()) == {100}
    assert (evaluated["results"] < 0.0).all()
    losses = [float(text) for text in re.findall(r"\|\s+loss\s+\|\s+(\S+)\s+\|", output)]
    assert losses
    assert np.isfinite(losses).all()
    assert int(re.findall(r"total_timesteps\s+\|\s+(\d+)", output)[-1]) == 2 * 64 * 32


def test_its_model_is_a_policy_of_this_package(trained: tuple[Path, str]) -> None:
    """Evaluated here as rl-zoo3 evaluated it: the options of the file, both times."""
    folder, _ = trained
    model = folder / "ppo" / "fusion_gym-TobitOscillator-v1_1" / "best_model.zip"
    ((_, options),) = ENTRIES[TOBIT]["vec_env_wrapper"][0].items()
    task = fusion_gym.make_task(TOBIT, **options)
    policy = fusion_gym.make_policy(f"model:{model}", task)
    results = run_episodes(task, policy, 20, seed=0)
    assert np.isfinite(results.returns).all()
    other = fusion_gym.make_task(TOBIT, information="centre")
    with pytest.raises(fusion_gym.ConfigurationError):
        fusion_gym.make_policy(f"model:{model}", other)


def test_it_plays(
    trained: tuple[Path, str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--algo", "ppo", "--env", TOBIT, "--gym-packages", "fusion_gym", "-f", str(trained[0])]
    words += ["--no-render", "--load-best", "-n", "300"]
    monkeypatch.setattr(sys, "argv", ["enjoy", *words])
    enjoy()
    assert "Mean episode length: 100.00" in capsys.readouterr().out


def test_options_of_the_command_line_come_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In training and in evaluation; and the file serves every environment that it names."""
    words = ["-n", "100", "-f", str(tmp_path), "--eval-freq", "8"]
    words += ["--env", "fusion_gym/RemoteEstimation-v1", "--env-kwargs", "horizon:7"]
    words += ["--hyperparams", "n_envs:4", "n_steps:16", "batch_size:32"]
    monkeypatch.setattr(sys, "argv", [*command("rl-zoo3")[2:], *words])
    monkeypatch.chdir(ROOT)
    train()
    output = capsys.readouterr().out
    assert "Episode length: 7.00 +/- 0.00" in output
    assert float(re.findall(r"ep_len_mean\s+\|\s+(\S+)", output)[-1]) == 7.0


def test_the_command_of_the_page_on_training_tunes(tmp_path: Path) -> None:
    """With one short trial of fewer runs."""
    page = (ROOT / "docs" / "training.md").read_text()
    (line,) = re.findall(r"^```\n(python -m rl_zoo3.*?)^```", page, re.DOTALL | re.MULTILINE)
    words = shlex.split(line.replace("\\\n", " "))
    assert words[: len(command("rl-zoo3"))] == command("rl-zoo3")
    short = ["-n", "64", "--n-trials", "1", "--hyperparams", "n_envs:2", "-f", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, *words[1:], *short, "--seed", "0"],
        cwd=ROOT, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    assert "Number of finished trials:  1" in done.stdout
