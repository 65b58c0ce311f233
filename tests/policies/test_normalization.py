"""An agent that was trained under VecNormalize runs with its statistics, or not at all."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.evaluation.onnx_export import export_onnx
from fusion_gym.validation import ConfigurationError

ENV = "fusion_gym/LinearFusion-v2"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an agent and its statistics, and with statistics of another environment."""
    folder = tmp_path_factory.mktemp("normalized")
    for name, options in (("other", {"memory": True}), ("agent", {})):
        envs = VecNormalize(fusion_gym.make_sb3_vec_env(ENV, 8, seed=0, **options))
        model = PPO("MlpPolicy", envs, n_steps=16, batch_size=128, seed=0).learn(256)
        model.save(folder / f"{name}.zip")
        envs.save(str(folder / f"{name}.pkl"))
    envs.obs_rms.mean = envs.obs_rms.mean * np.nan
    envs.save(str(folder / "damaged.pkl"))
    envs = VecNormalize(fusion_gym.make_sb3_vec_env(ENV, 8, seed=0), norm_obs=False)
    PPO("MlpPolicy", envs, n_steps=16, batch_size=128).learn(128).save(folder / "rewards.zip")
    envs.save(str(folder / "rewards.pkl"))
    (folder / "text.pkl").write_text("no pickle")
    return folder


@pytest.fixture
def task() -> Task:
    return fusion_gym.make_task(ENV)


def test_the_agent_sees_what_it_saw_in_training(folder: Path, task: Task) -> None:
    text = f"model:{folder / 'agent.zip'},normalize={folder / 'agent.pkl'}"
    agent: Any = fusion_gym.make_policy(text, task, trust=True)
    batch = EpisodeBatch.seeded(task, 40, 0)
    envs = VecNormalize.load(str(folder / "agent.pkl"), fusion_gym.make_sb3_vec_env(ENV, 8))
    expected = envs.normalize_obs(batch.observe())
    assert np.abs(expected - batch.observe()).max() > 0.1
    np.testing.assert_array_equal(agent.rows(batch.signals()), expected)
    actions = PPO.load(folder / "agent.zip").predict(expected, deterministic=True)[0]
    np.testing.assert_array_equal(agent(batch.signals()), actions.T.astype(bool))


@pytest.mark.parametrize(
    ("settings", "trust", "message"),
    [
        ("", False, "normalize = None is not allowed: it must be the file of its VecNormalize"),
        ("", True, "normalize = None is not allowed"),
        (",normalize={folder}/agent.pkl", False, "given with --trust: it is a pickle"),
        (",normalize={folder}/absent.pkl", True, "a readable file"),
        (",normalize={folder}/text.pkl", True, "a readable file"),
        (",normalize={folder}/other.pkl", True, "statistics of shape"),
        (",normalize={folder}/damaged.pkl", True, "statistics of shape"),
    ],
)
def test_an_agent_without_its_statistics_is_refused(
    folder: Path, task: Task, settings: str, trust: bool, message: str
) -> None:
    text = f"model:{folder / 'agent.zip'}{settings.format(folder=folder)}"
    with pytest.raises(ConfigurationError, match=message):
        fusion_gym.make_policy(text, task, trust=trust)


def test_an_agent_of_normalized_rewards_sees_the_observation(folder: Path, task: Task) -> None:
    text = f"model:{folder / 'rewards.zip'},normalize={folder / 'rewards.pkl'}"
    agent: Any = fusion_gym.make_policy(text, task, trust=True)
    batch = EpisodeBatch.seeded(task, 4, 0)
    np.testing.assert_array_equal(agent.rows(batch.signals()), batch.observe())


def test_no_file_has_the_statistics(folder: Path, task: Task, tmp_path: Path) -> None:
    text = f"model:{folder / 'agent.zip'},normalize={folder / 'agent.pkl'}"
    agent = fusion_gym.make_policy(text, task, trust=True)
    with pytest.raises(ConfigurationError, match=r"normalize = .* must be None"):
        export_onnx(agent, task, tmp_path / "agent.onnx", ENV)
