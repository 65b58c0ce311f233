"""Agents of several frames, trained under Stable-Baselines3's VecFrameStack."""

from pathlib import Path

import numpy as np
import pytest
from refusals import refused
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecFrameStack

import fusion_gym
from fusion_gym.evaluation.onnx_export import export_onnx

ENV = "fusion_gym/TobitOscillator-v1"
OPTIONS = {"horizon": 7, "filter": "tobit"}


@pytest.mark.parametrize("trust", [False, True])
def test_a_stacked_agent_acts_as_in_its_own_loop(tmp_path: Path, trust: bool) -> None:
    """Over the ends of several episodes, where the frames begin anew."""
    native = fusion_gym.make_sb3_vec_env(ENV, 4, seed=0, stagger=True, **OPTIONS)
    envs = VecFrameStack(native, 3)
    model = PPO("MlpPolicy", envs, n_steps=8, batch_size=32, seed=0).learn(64)
    model.save(tmp_path / "stacked")
    text = f"model:{tmp_path / 'stacked'}"
    agent = fusion_gym.make_policy(text, envs, trust=trust)
    envs.seed(5)
    observation = envs.reset()
    for _ in range(20):
        expected, _ = model.predict(observation, deterministic=True)
        actions, _ = agent.predict(observation)
        np.testing.assert_array_equal(actions, expected)
        observation = envs.step(actions)[0]
    task = fusion_gym.make_task(ENV, **OPTIONS)
    policy = fusion_gym.make_policy(text, task, trust=trust)
    assert not getattr(policy, "stateless", True)
    refused(lambda: export_onnx(policy, task, tmp_path / "agent.onnx", ENV), "frames = 3")


def test_frames_of_another_environment_are_refused(tmp_path: Path) -> None:
    envs = VecFrameStack(fusion_gym.make_sb3_vec_env(ENV, 2, **OPTIONS), 2)
    PPO("MlpPolicy", envs, n_steps=4, batch_size=8).save(tmp_path / "stacked")
    task = fusion_gym.make_task("fusion_gym/LinearFusion-v2")
    message = "another observation layout"
    refused(lambda: fusion_gym.make_policy(f"model:{tmp_path / 'stacked'}", task), message)
