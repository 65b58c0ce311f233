import gymnasium as gym
import numpy as np

import fusion_gym  # registers the environments

env = gym.make("fusion_gym/TobitOscillator-v1", filter="tobit", token_rate=2.0)
observation, info = env.reset(seed=0)
action = np.array([1, 0, 0], dtype=np.int8)  # sensor 0 requests to transmit
observation, reward, terminated, truncated, info = env.step(action)
print(info["granted"], info["cost"], info["reward_error"])
