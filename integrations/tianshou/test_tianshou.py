"""Tianshou: a value of every action, independent requests, sensors in turn."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from pettingzoo.utils.conversions import parallel_to_aec
from tianshou.algorithm import PPO
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.env import DummyVectorEnv, PettingZooEnv, SubprocVectorEnv
from tianshou.trainer import OffPolicyTrainerParams, OnPolicyTrainerParams
from tianshou.utils.net.common import Net
from tianshou.utils.net.discrete import DiscreteActor, DiscreteCritic
from torch.distributions import Bernoulli, Independent

import fusion_gym
from integrations.page import run

NAME = "fusion_gym:fusion_gym/TobitOscillator-v1"


def make() -> gym.Env[Any, Any]:
    return gym.make(NAME, filter="tobit", horizon=20)


def weights(module: torch.nn.Module) -> torch.Tensor:
    return torch.nn.utils.parameters_to_vector(module.parameters()).detach().clone()


def test_the_page() -> None:
    names = run("Tianshou")
    assert names["result"].update_step == 10  # of 40 steps of the environments
    assert -20.0 < names["result"].best_score < 0.0
    collected = names["collector"].buffer
    assert len(collected) == 400
    total = collected.info.reward_error + collected.info.reward_cost
    np.testing.assert_allclose(collected.rew, total, rtol=1e-6)
    assert collected.truncated.sum() == 4 * (100 // 20)
    assert not collected.terminated.any()
    before = weights(names["network"])
    params = OffPolicyTrainerParams(
        training_collector=names["collector"], max_epochs=1, epoch_num_steps=40, batch_size=32,
        collection_step_num_env_steps=40, show_progress=False, verbose=False,
    )  # fmt: skip
    names["agent"].run_training(params)
    after = weights(names["network"])
    assert torch.isfinite(after).all()
    assert not torch.equal(after, before)


@pytest.mark.parametrize("kind", [DummyVectorEnv, SubprocVectorEnv])
def test_ppo_with_independent_requests(kind: Any) -> None:
    envs, env = kind([make] * 4), make()
    shape = env.observation_space.shape
    actor = DiscreteActor(
        preprocess_net=Net(state_shape=shape, hidden_sizes=[32]),
        action_shape=3,
        softmax_output=False,
    )
    policy = ProbabilisticActorPolicy(
        actor=actor,
        dist_fn=lambda logits: Independent(Bernoulli(logits=logits), 1),
        action_space=env.action_space,
        action_scaling=False,
    )
    critic = DiscreteCritic(preprocess_net=Net(state_shape=shape, hidden_sizes=[32]))
    agent = PPO(policy=policy, critic=critic, optim=AdamOptimizerFactory(lr=1e-3), gamma=0.97)
    before = weights(actor)
    collector = Collector(agent, envs, VectorReplayBuffer(1_000, 4))
    result = agent.run_training(
        OnPolicyTrainerParams(
            training_collector=collector, max_epochs=1, epoch_num_steps=320, batch_size=64,
            collection_step_num_env_steps=160, update_step_num_repetitions=2,
            show_progress=False, verbose=False,
        )
    )  # fmt: skip
    assert (result.train_step, result.train_episode) == (320, 16)
    assert torch.isfinite(weights(actor)).all()
    assert not torch.equal(weights(actor), before)
    envs.close()


def test_sensors_in_turn() -> None:
    env = PettingZooEnv(parallel_to_aec(fusion_gym.parallel_env(NAME.split(":")[1], horizon=3)))
    observation, _ = env.reset(seed=0)
    turns, rewards, over = [], [], False
    while not over:
        turns.append(observation["agent_id"])
        assert observation["mask"] == [True, True]
        observation, reward, terminated, truncated, _ = env.step(1)
        rewards.append(list(reward))
        over = terminated or truncated
    assert turns == ["sensor_0", "sensor_1", "sensor_2"] * 3
    assert all(reward < 0.0 for reward in rewards[-1])
