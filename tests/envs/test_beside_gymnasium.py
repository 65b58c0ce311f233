"""What other libraries ask of an environment: the length of its episodes, rewards of two terms."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TimeAwareObservation

import fusion_gym
from fusion_gym.validation import ConfigurationError

TOBIT = "fusion_gym/TobitOscillator-v1"


def steps_of(env: Any) -> int:
    env.reset(seed=0)
    count, over = 0, False
    while not over:
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        over, count = terminated or truncated, count + 1
    return count


@pytest.mark.parametrize("horizon", [7, 130])
def test_the_specification_knows_the_horizon(horizon: int) -> None:
    env = gym.make(TOBIT, horizon=horizon)
    assert env.spec is not None
    assert env.spec.max_episode_steps == horizon
    assert steps_of(env) == horizon
    assert steps_of(gym.make(env.spec)) == horizon
    assert steps_of(gym.make(TOBIT, horizon=horizon, max_episode_steps=5)) == 5
    vector = gym.make_vec(TOBIT, num_envs=2, horizon=horizon)
    assert vector.spec is not None
    assert vector.spec.max_episode_steps == horizon
    aware = TimeAwareObservation(env)
    observation, _ = aware.reset(seed=0)
    first = aware.step(np.zeros(3, dtype=np.int8))[0]
    assert aware.observation_space.contains(first)
    assert first[-1] > observation[-1]
    assert steps_of(aware) == horizon


def test_a_vector_of_rewards_sums_to_the_reward() -> None:
    options: dict[str, Any] = {"filter": "tobit", "horizon": 6, "cost_weight": 0.3}
    env: Any = gym.make(TOBIT, reward="vector", disable_env_checker=True, **options)
    plain = gym.make(TOBIT, **options)
    env.reset(seed=3)
    plain.reset(seed=3)
    assert env.unwrapped.reward_space.shape == (2,)
    for _ in range(6):
        action = plain.action_space.sample()
        _, pair, _, _, info = env.step(action)
        _, reward, _, _, _ = plain.step(action)
        assert env.unwrapped.reward_space.contains(pair)
        assert pair.sum() == pytest.approx(reward)
        assert pair.tolist() == [info["reward_error"], info["reward_cost"]]


def test_interfaces_of_one_number_refuse_two() -> None:
    for make in (lambda **o: fusion_gym.make_sb3_vec_env(TOBIT, 2, **o),
                 lambda **o: fusion_gym.parallel_env(TOBIT, **o)):  # fmt: skip
        with pytest.raises(ConfigurationError, match="reward = 'vector'"):
            make(reward="vector")
    with pytest.raises(ConfigurationError, match="reward = 'both'"):
        gym.make(TOBIT, reward="both")
