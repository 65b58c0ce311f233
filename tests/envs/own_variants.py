"""A user's registrations by Gymnasium."""

from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import WrapperSpec

from fusion_gym.envs import registered

OURS = "fusion_gym.envs.registered:TobitOscillator"
GIVEN: Any = {"kwargs": {"filter": "tobit", "token_rate": 2.0}, "max_episode_steps": 7}
gym.register("mine/Tobit-v0", f"{OURS}Env", vector_entry_point=f"{OURS}VectorEnv", **GIVEN)
SINGLE, VECTOR = registered.TobitOscillatorEnv, registered.TobitOscillatorVectorEnv
gym.register("mine/OfClass-v0", SINGLE, vector_entry_point=VECTOR, **GIVEN)
gym.register("mine/Foreign-v0", "gymnasium.envs.classic_control.cartpole:CartPoleEnv")
CLIPPED = WrapperSpec("ClipAction", "gymnasium.wrappers:ClipAction", {})
gym.register("mine/Wrapped-v0", f"{OURS}Env", additional_wrappers=(CLIPPED,))
