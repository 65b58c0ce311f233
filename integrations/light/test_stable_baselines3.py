"""Stable-Baselines3: agents by id, in this process and in others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

import fusion_gym
from integrations.page import run

NAME = "fusion_gym:fusion_gym/TobitOscillator-v1"
OPTIONS: dict[str, Any] = {"filter": "tobit", "horizon": 20, "token_rate": 2.0}


def weights(model: PPO) -> torch.Tensor:
    return torch.nn.utils.parameters_to_vector(model.policy.parameters()).detach().clone()


def test_the_page() -> None:
    names = run("Stable-Baselines3")
    assert names["model"].num_timesteps == 128
    assert names["envs"].get_attr("task")[1].settings["filter"] == "tobit"


def play(envs: VecEnv) -> np.ndarray:
    """All that 25 steps show, which are more than an episode."""
    rows = [envs.reset()]
    for step in range(25):
        observation, reward, done, _ = envs.step(np.full((2, 3), step % 2))
        rows += [observation, reward.astype(np.float32), done]
    return np.concatenate([np.ravel(row) for row in rows])


@pytest.fixture(scope="module")
def seen() -> np.ndarray:
    envs = fusion_gym.make_sb3_vec_env(NAME.split(":")[1], 2, seed=5, **OPTIONS)
    return play(envs)


@pytest.mark.parametrize("kind", [DummyVecEnv, SubprocVecEnv])
def test_ppo_learns_on_single_environments(
    kind: type[DummyVecEnv] | type[SubprocVecEnv], seen: np.ndarray
) -> None:
    """In this process or in others: the episodes are those of one batch, and PPO learns."""
    envs = make_vec_env(NAME, 2, seed=5, vec_env_cls=kind, env_kwargs=OPTIONS)
    try:
        np.testing.assert_array_equal(play(envs), seen)
        model = PPO("MlpPolicy", envs, n_steps=64, batch_size=64, seed=0)
        before = weights(model)
        model.learn(256)
        after = weights(model)
        assert torch.isfinite(after).all()
        assert not torch.equal(before, after)
        logged: dict[str, Any] = model.logger.name_to_value
        assert np.isfinite(logged["train/loss"])
        episodes = model.ep_info_buffer
        assert len(episodes) == 2 * (128 // 20)
        assert {episode["l"] for episode in episodes} == {20}
        returns, lengths = evaluate_policy(model, envs, 4, return_episode_rewards=True)
        assert lengths == [20] * 4
        assert all(value < 0.0 for value in returns)
    finally:
        envs.close()
