"""SuperSuit's wrappers around sensors as agents."""

from __future__ import annotations

import numpy as np
import pytest
import supersuit
import torch
from gymnasium.error import ResetNeeded
from pettingzoo.test import parallel_api_test

import fusion_gym
from integrations.page import run

TOBIT = "fusion_gym/TobitOscillator-v1"


def test_the_page() -> None:
    names = run("SuperSuit")
    model = names["model"]
    assert model.num_timesteps == 768  # two rollouts of 32 steps of 12 rows
    assert np.isfinite(model.logger.name_to_value["train/loss"])
    entries = len(fusion_gym.parallel_env(TOBIT).observation_names)
    assert model.observation_space.shape == (3 * entries,)
    for parameter in model.policy.parameters():
        assert torch.isfinite(parameter).all()


def test_rows_of_sensors_are_those_of_one_batch() -> None:
    """SuperSuit's rows of one run beside the native ones, over two episodes."""
    rows = supersuit.pettingzoo_env_to_vec_env_v1(fusion_gym.parallel_env(TOBIT, horizon=6))
    native = fusion_gym.make_sb3_vec_env(TOBIT, 1, seed=2, local=True, horizon=6)
    observation, _ = rows.reset(seed=2)
    np.testing.assert_array_equal(observation, native.reset())
    random = np.random.default_rng(0)
    for step in range(1, 13):
        actions = random.integers(0, 2, 3)
        observation, reward, terminated, truncated, _ = rows.step(actions)
        expected, pay, done, _ = native.step(actions)
        np.testing.assert_array_equal(observation, expected)
        np.testing.assert_allclose(reward, pay, rtol=1e-6)
        assert (terminated | truncated).tolist() == done.tolist() == [step % 6 == 0] * 3


@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: supersuit.frame_stack_v1(env, 4),
        lambda env: supersuit.agent_indicator_v0(env),
        lambda env: supersuit.delay_observations_v0(env, 2),
        lambda env: supersuit.pad_action_space_v0(supersuit.pad_observations_v0(env)),
        lambda env: supersuit.clip_reward_v0(env, -1, 0),
        lambda env: supersuit.sticky_actions_v0(env, 0.5),
    ],
)
def test_wrappers(wrap: object) -> None:
    assert callable(wrap)
    parallel_api_test(wrap(fusion_gym.parallel_env(TOBIT, horizon=10)), num_cycles=25)


def test_black_death_waits_for_an_end_of_both_kinds() -> None:
    """SuperSuit takes an episode as over that is terminated and truncated; these are truncated."""
    env = supersuit.black_death_v3(fusion_gym.parallel_env(TOBIT, horizon=2))
    env.reset(seed=0)
    for _ in range(2):
        actions = dict.fromkeys(env.agents, 0)
        env.step(actions)
    assert env.agents
    with pytest.raises(ResetNeeded):
        env.step(actions)


def test_rows_in_processes() -> None:
    rows = supersuit.pettingzoo_env_to_vec_env_v1(fusion_gym.parallel_env(TOBIT, horizon=6))
    rows = supersuit.concat_vec_envs_v1(rows, 2, num_cpus=2, base_class="gymnasium")
    try:
        rows.reset(seed=0)
        for step in range(1, 13):
            _, reward, _, truncated, _ = rows.step(np.ones(6, dtype=np.int64))
            assert reward.shape == (6,)
            assert (reward < 0.0).all()
            assert truncated.astype(bool).tolist() == [step % 6 == 0] * 6
    finally:
        rows.close()
