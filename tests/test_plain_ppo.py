"""What PPO reaches is told on a scale whose ends are rules, in pieces that survive a kill."""

import argparse
from pathlib import Path

import pytest

from benchmarks import plain_ppo
from benchmarks.plain_ppo import SETTINGS, TRAININGS, Setting, judge
from fusion_gym.envs.registration import ENVIRONMENTS
from fusion_gym.training.checked import load_checked
from fusion_gym.training.sweeps import Sweep


def test_every_environment_is_there() -> None:
    others = {setting.environment for setting in SETTINGS.values()} ^ set(ENVIRONMENTS)
    assert others == {"fusion_gym/RecordedFusion-v1"}  # agents learn on its fitted plant


@pytest.mark.parametrize("setting", SETTINGS.values(), ids=SETTINGS)
def test_a_setting_shows_values_without_memory(setting: Setting) -> None:
    task = setting.task(belief_features=["value"])
    assert task.belief_features == ("value",)
    assert not task.memory
    assert load_checked(Sweep, setting.sweep).policies(task.reward.price)


def test_pieces_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plain_ppo, "run_rules", lambda *_, **__: {"always": -2.0, "best": -1.0})
    monkeypatch.setattr(plain_ppo, "SIMPLE", ["always"])
    monkeypatch.delitem(TRAININGS, "default_0")
    asked = argparse.Namespace(
        output=tmp_path, episodes=2, timesteps=512, gamma=0.95, n_steps=8, resume=True
    )
    row = judge("remote_estimation", asked)
    assert row.simple == ("always", -2.0)
    assert row.best == ("best", -1.0)
    monkeypatch.setattr(plain_ppo, "run_rules", lambda *_, **__: pytest.fail("stored already"))
    (tmp_path / "remote_estimation" / "value_1.json").unlink()  # a kill before its end
    again = judge("remote_estimation", asked)
    assert again.shares == row.shares
    asked.gamma = 0.5  # another question, another answer
    other = judge("remote_estimation", asked)
    assert other.shares != row.shares
