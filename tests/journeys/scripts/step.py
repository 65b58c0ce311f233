import gymnasium as gym
import numpy as np

import fusion_gym  # registers the environments

env = gym.make("fusion_gym/TobitOscillator-v1", filter="tobit", token_rate=2.0)
names = env.unwrapped.observation_names
ages = [names.index(f"age[{sensor}]") for sensor in range(3)]
observation, info = env.reset(seed=0)
total, tokens, over = 0.0, 0.0, False
while not over:
    action = (observation[ages] > 0.3).astype(np.int8)  # five steps without a delivery
    observation, reward, terminated, truncated, info = env.step(action)
    total, tokens, over = total + reward, tokens + info["cost"], terminated or truncated
print(f"return {total:.2f}, tokens {tokens:.0f}")
