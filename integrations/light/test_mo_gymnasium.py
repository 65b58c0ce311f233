"""MO-Gymnasium's wrappers on rewards of two terms, and Envelope of MORL-Baselines."""

from __future__ import annotations

import os
from typing import Any

import gymnasium as gym
import mo_gymnasium
import numpy as np
import pytest
import torch
from mo_gymnasium.wrappers import MOClipReward, MONormalizeReward, MORecordEpisodeStatistics
from mo_gymnasium.wrappers.vector import MORecordEpisodeStatistics as VectorStatistics
from mo_gymnasium.wrappers.vector import MOSyncVectorEnv

from integrations.page import run

os.environ.setdefault("WANDB_MODE", "disabled")
TOBIT = "fusion_gym/TobitOscillator-v1"
OPTIONS: dict[str, Any] = {"reward": "vector", "filter": "tobit", "horizon": 10}


def make(**options: Any) -> gym.Env[Any, Any]:
    return mo_gymnasium.make(TOBIT, **OPTIONS, **options)


def test_the_page_of_mo_gymnasium() -> None:
    names = run("MO-Gymnasium")
    assert names["reward"].shape == (2,)
    assert names["env"].unwrapped.reward_space.contains(names["reward"])
    names["weighted"].reset(seed=0)
    _, reward, *_, info = names["weighted"].step(np.ones(3, dtype=np.int8))
    assert reward == pytest.approx(info["vector_reward"].sum() / 2.0)


def test_returns_of_two_terms() -> None:
    env = MORecordEpisodeStatistics(make(), gamma=0.9)
    env.reset(seed=1)
    total = discounted = np.zeros(2)
    for step in range(10):
        _, reward, _, over, info = env.step(env.action_space.sample())
        total, discounted = total + reward, discounted + 0.9**step * reward
    assert over
    np.testing.assert_allclose(info["episode"]["r"], total, rtol=1e-5)
    np.testing.assert_allclose(info["episode"]["dr"], discounted, rtol=1e-5)
    assert info["episode"]["l"] == 10


def test_wrappers_of_one_term_leave_the_other() -> None:
    plain, env = make(), MOClipReward(MONormalizeReward(make(), idx=0), idx=1, min_r=-0.01, max_r=0)
    plain.reset(seed=1)
    env.reset(seed=1)
    for _ in range(10):
        action = np.ones(3, dtype=np.int8)
        (_, before, *_), (_, after, *_, info) = plain.step(action), env.step(action)
        assert after[1] == pytest.approx(max(before[1], -0.01))
        assert after[0] != before[0]
        assert info["reward_error"] == before[0]


@pytest.mark.parametrize("native", [False, True])
def test_vectors_of_vectors(native: bool) -> None:
    envs: Any = gym.make_vec(TOBIT, 3, **OPTIONS) if native else MOSyncVectorEnv([make] * 3)
    assert envs.reward_space.shape[-1] == 2
    statistics = VectorStatistics(envs)
    statistics.reset(seed=0)
    total = np.zeros((3, 2))
    for _ in range(10):
        _, rewards, _, truncated, info = statistics.step(np.ones((3, 3), dtype=np.int8))
        total += rewards
    assert truncated.all()
    np.testing.assert_allclose(info["episode"]["r"], total, rtol=1e-5)


def test_the_page_of_morl_baselines() -> None:
    names = run("MORL-Baselines")
    agent, test = names["agent"], names["test"]
    assert agent.global_step == 200
    values = torch.nn.utils.parameters_to_vector(agent.q_net.parameters())
    assert torch.isfinite(values).all()
    for moments in agent.q_optim.state.values():  # of Adam
        assert moments["step"] > 100
        assert moments["exp_avg"].abs().sum() > 0.0
    weight = np.array([0.5, 0.5])
    *_, returns, discounted = agent.policy_eval(test, num_episodes=2, weights=weight, log=False)
    assert returns.shape == discounted.shape == (2,)
    assert (returns <= 0.0).all()
    observation, _ = test.reset(seed=0)
    assert agent.eval(observation, weight) in range(8)
