"""Gymnasium's and Stable-Baselines3's faces of one batched core."""

from fusion_gym.envs.batch import EpisodeBatch, Outcome
from fusion_gym.envs.single import FusionEnv
from fusion_gym.envs.task import Reward, Task
from fusion_gym.envs.vector import FusionVectorEnv

__all__ = ["EpisodeBatch", "FusionEnv", "FusionVectorEnv", "Outcome", "Reward", "Task"]
