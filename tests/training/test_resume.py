"""A training that was interrupted or killed ends as an undisturbed one does, bitwise."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from paths import ROOT
from small_runs import meaning
from stable_baselines3.common.callbacks import BaseCallback
from training_configs import ENV, read_records, small_config

import fusion_gym
from fusion_gym.envs.sb3 import FusionSB3VecEnv
from fusion_gym.training import run
from fusion_gym.training.config import Experiment, load_checked
from fusion_gym.validation import ConfigurationError

SHORT = {"timesteps": 64, "num_envs": 4}
PRICED = {"cost_weight": "random", "price_range": [0.01, 0.1]}


class Killed(BaseException):
    """The process is gone: nothing of the training handles it."""


def experiment_of(folder: Path, kind: str, price: str = "fixed", **training: Any) -> Experiment:
    folder.mkdir()
    path = small_config(folder, kind)
    content = yaml.safe_load(path.read_text())
    content["training"] |= {"timesteps": 1024, **training}
    content["validation"] = {"every": 256, "episodes": 2}
    if price == "drawn":
        content["environment"]["options"] |= PRICED
        content["training"]["price_exponent"] = 0.5
    path.write_text(yaml.safe_dump(content))
    return load_checked(Experiment, path)


def end_at(monkeypatch: pytest.MonkeyPatch, step: int, how: str) -> None:
    """At this step of the runs the process is interrupted, or killed."""
    before, counted = FusionSB3VecEnv.step_wait, 0

    def step_wait(self: FusionSB3VecEnv) -> Any:
        nonlocal counted
        counted += 1
        if counted == step:
            if how == "killed":
                raise Killed
            os.kill(os.getpid(), signal.SIGINT)
        return before(self)

    monkeypatch.setattr(FusionSB3VecEnv, "step_wait", step_wait)


CASES = [
    ("a2c", "fixed", {}),
    *(
        pytest.param(*case, marks=pytest.mark.slow)
        for case in (
            ("ppo", "fixed", {}),
            ("ppo", "drawn", {}),
            ("dqn", "fixed", {}),
            ("maskable_ppo", "drawn", {}),
            ("recurrent_ppo", "fixed", {}),
            ("counterfactual_ppo", "fixed", {"error": "mismatch"}),
            ("counterfactual_ppo", "drawn", {"error": "excess"}),
        )
    ),
]


@pytest.mark.parametrize(
    ("kind", "price", "training"), CASES, ids=lambda value: value if isinstance(value, str) else ""
)
def test_a_resumed_training_is_the_uninterrupted_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, price: str, training: dict[str, Any]
) -> None:
    """Interrupted in the middle of a rollout, then killed after a checkpoint, then to the end."""
    whole = experiment_of(tmp_path / "whole", kind, price, **training)
    run.train(whole, quiet=True)
    parts = experiment_of(tmp_path / "parts", kind, price, **training)
    with monkeypatch.context() as patch:
        end_at(patch, 45, "interrupted")
        summary = run.train(parts, quiet=True)
    assert 45 * 8 <= summary["timesteps"] < 512
    assert not summary["finished"]
    with monkeypatch.context() as patch:
        end_at(patch, 60, "killed")
        with pytest.raises(Killed):
            run.train(parts, quiet=True, resume=True)
    run.train(parts, quiet=True, resume=True)
    assert meaning(Path(parts.output)) == meaning(Path(whole.output))
    assert len(read_records(Path(whole.output))) == 4


@pytest.mark.slow
@pytest.mark.parametrize("command", ["train", "search", "calibrate"])
def test_kills_at_random_moments_lose_nothing(command: str) -> None:
    line = [sys.executable, "tests/helpers/kills.py", command, "--kills", "3"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(line, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f"{command}: 3 kills" in done.stdout


def test_threads_timesteps_and_output_may_change_and_nothing_else(tmp_path: Path) -> None:
    begun = experiment_of(tmp_path / "a", "ppo", timesteps=128, threads=2)
    run.train(begun, quiet=True)
    moved = Path(begun.output).rename(tmp_path / "moved")
    longer = begun.changed(moved, timesteps=256, threads=1)
    assert run.train(longer, quiet=True, resume=True)["timesteps"] == 256
    before = {path: path.read_bytes() for path in moved.iterdir() if path.is_file()}
    plain = longer.model_dump()
    for place, name, value in (
        ("training", "seed", 1),
        ("training", "num_envs", 4),
        ("training", "price_exponent", 0.5),
        ("validation", "episodes", 5),
        ("algorithm", "gamma", 0.5),
        ("environment", "options", {"horizon": 30}),
    ):
        other = Experiment.model_validate(plain | {place: plain[place] | {name: value}})
        with pytest.raises(ConfigurationError, match=f"^{place}.{name}.* differs from") as caught:
            run.train(other, quiet=True, resume=True)
        assert "\n" not in str(caught.value)
    assert {path: path.read_bytes() for path in moved.iterdir() if path.is_file()} == before


def test_the_best_model_outlives_a_kill_between_its_validation_and_the_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the file itself is lost: the checkpoint holds it."""
    experiment = experiment_of(tmp_path / "a", "ppo", timesteps=512)
    folder = Path(experiment.output)
    with monkeypatch.context() as patch:
        patch.setattr("fusion_gym.training.callbacks.Progress._write_records", die_with_records(2))
        with pytest.raises(Killed):
            run.train(experiment, quiet=True)
    assert (folder / "best_model.zip").exists()
    (folder / "best_model.zip").unlink()
    run.train(experiment, quiet=True, resume=True)
    whole = experiment_of(tmp_path / "b", "ppo", timesteps=512)
    run.train(whole, quiet=True)
    assert meaning(folder) == meaning(Path(whole.output))


def die_with_records(count: int) -> Any:
    def write(self: Any) -> None:
        if len(self.journal.records) == count:
            raise Killed

    return write


def test_a_training_that_diverges_says_so(tmp_path: Path) -> None:
    algorithm = {"name": "a2c", "n_steps": 8, "learning_rate": 1e30}
    experiment = load_checked(Experiment, small_config(tmp_path, algorithm=algorithm))
    with pytest.raises(ConfigurationError, match="diverged after 128 steps") as caught:
        run.train(experiment, quiet=True)
    assert "\n" not in str(caught.value)


def test_a_finished_training_is_not_repeated_and_its_files_are_mended(tmp_path: Path) -> None:
    experiment = experiment_of(tmp_path / "a", "ppo", timesteps=256)
    folder = Path(experiment.output)
    summary = run.train(experiment, quiet=True)
    expected = meaning(folder)
    assert list((folder / "tensorboard").glob("events*"))
    for name in ("best_model.zip", "final_model.zip", "summary.json", "validation.jsonl"):
        (folder / name).write_text("damaged")
    assert run.train(experiment, quiet=True, resume=True) == summary
    assert meaning(folder) == expected


def test_two_trainings_in_one_folder_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    experiment = experiment_of(tmp_path / "a", "ppo", timesteps=256)
    tried: list[str] = []

    def log_line(_: Any) -> str:
        for resume, message in (
            (False, "already holds a training"),
            (True, "is in use by another"),
        ):
            with pytest.raises(ConfigurationError, match=message) as caught:
                run.train(experiment, quiet=True, resume=resume)
            tried.append(str(caught.value))
        return ""

    monkeypatch.setattr("fusion_gym.training.callbacks.log_line", log_line)
    run.train(experiment, quiet=True)
    assert len(tried) == 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trainig": {}}, "trainig"),
        ({"training": {"timesteps": 0}}, "training.timesteps = 0"),
        ({"environment": {}}, "environment.id"),
        ({"training": {"timesteps": 1000, "num_envs": True}}, "training.num_envs = True"),
        ({"algorithm": {"name": "ppo", "network": {"hidden": [64.0]}}}, "hidden.0 = 64.0"),
        ({"algorithm": {"name": "ppo", "batch_size": 1}}, "algorithm.batch_size = 1"),
        ({"algorithm": {"name": "dqn"}}, "action: discrete"),
        (
            {
                "environment": {"id": ENV, "options": {"access": "single"}},
                "algorithm": {"name": "ppo", "initial_rate": 0.9},
            },
            "initial_rate = 0.9",
        ),
        (
            {
                "training": {"timesteps": 64, "num_envs": 1},
                "algorithm": {"name": "ppo", "n_steps": 1},
            },
            "algorithm = 'ppo' is not allowed with these settings",
        ),
        (
            {
                "environment": {"id": ENV, "options": {"action": "discrete"}},
                "algorithm": {"name": "counterfactual_ppo", "alternatives": "flips"},
            },
            "an action is one number",
        ),
        (
            {
                "environment": {"id": ENV, "local": True},
                "algorithm": {"name": "counterfactual_ppo", "alternatives": "all"},
            },
            "sensors decide locally",
        ),
        ({"training": SHORT | {"error": "mismatch", "error_filter": "none such"}}, "filter"),
        ({"training": SHORT | {"error_filter": "adf"}}, "error_filter"),
    ],
)
def test_a_refused_config_leaves_no_folder(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigurationError) as caught:
        run.train(load_checked(Experiment, small_config(tmp_path, **changes)), quiet=True)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_a_callback_of_ones_own_sees_every_rollout_and_may_end_the_training(tmp_path: Path) -> None:
    class Log(BaseCallback):
        rollouts = 0

        def _on_step(self) -> bool:
            return self.num_timesteps < 512

        def _on_rollout_end(self) -> None:
            self.rollouts += 1

    log, experiment = Log(), experiment_of(tmp_path / "run", "ppo")
    summary = fusion_gym.train(experiment, quiet=True, callbacks=[log])
    assert log.rollouts == 512 // (16 * 8) - 1  # the last rollout is not complete
    assert (summary["timesteps"], summary["finished"]) == (512, False)
    summary = fusion_gym.train(experiment, quiet=True, resume=True)
    assert (summary["timesteps"], summary["finished"]) == (1024, True)
