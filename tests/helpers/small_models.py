"""New models of every kind, whose weights are far enough from zero that their decisions differ."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from sb3_contrib import MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm

import fusion_gym
from fusion_gym.core.task import Task

ENV = "fusion_gym/TobitOscillator-v1"
OPTIONS: dict[str, Any] = {"filter": "tobit", "horizon": 20}
DISCRETE, LOCAL, MEMORY = {"action": "discrete"}, {"local": True}, {"memory": True}
MULTI = {"action": "multidiscrete"}
RELU = {"net_arch": {"pi": [8], "vf": [6, 5]}, "activation_fn": torch.nn.ReLU}
NUMPY = {"net_arch": {"pi": [np.int64(8)], "vf": [np.int64(6), 5]}}
GELU = {"activation_fn": torch.nn.GELU}
SHARED = {"lstm_hidden_size": 6, "n_lstm_layers": 2, "shared_lstm": True}
LINEAR = {"lstm_hidden_size": 6, "net_arch": []}
ACTOR = {"enable_critic_lstm": False}


@dataclass(frozen=True)
class Recipe:
    """What a model is made of; the options are those of its environment."""

    algorithm: Any
    policy: Any = "MlpPolicy"
    options: dict[str, Any] = field(default_factory=dict)
    arguments: dict[str, Any] = field(default_factory=dict)

    def build(self) -> tuple[BaseAlgorithm, Task]:
        """Build the model and its task."""
        env = fusion_gym.make_sb3_vec_env(ENV, 2, **OPTIONS, **self.options)
        arguments = {"seed": 0, "device": "cpu"} | self.arguments
        model = self.algorithm(self.policy, env, **arguments)
        with torch.no_grad():
            for weight in model.policy.parameters():
                weight.mul_(3.0)
        return model, env.task


def recurrent(options: dict[str, Any], **kwargs: Any) -> Recipe:
    return Recipe(RecurrentPPO, "MlpLstmPolicy", options, {"policy_kwargs": kwargs})


MODELS = {
    "ppo": Recipe(PPO),
    "ppo_memory": Recipe(PPO, options=MEMORY, arguments={"policy_kwargs": GELU}),
    "ppo_discrete": Recipe(PPO, options=DISCRETE, arguments={"policy_kwargs": RELU}),
    "ppo_numpy": Recipe(PPO, arguments={"policy_kwargs": NUMPY}),
    "ppo_local_memory": Recipe(PPO, options=MEMORY | LOCAL),
    "a2c_centre": Recipe(A2C, options={"information": "centre"}),
    "dqn": Recipe(DQN, options=DISCRETE, arguments={"buffer_size": 10}),
    "dqn_local": Recipe(DQN, options=LOCAL, arguments={"buffer_size": 10, "seed": 2}),
    "maskable_binary": Recipe(MaskablePPO),
    "ppo_multidiscrete": Recipe(PPO, options=MULTI),
    "maskable_multidiscrete": Recipe(MaskablePPO, options=MULTI),
    "recurrent_multidiscrete": recurrent(MULTI, ortho_init=False),
    "maskable_single": Recipe(MaskablePPO, options={"access": "single"}),
    "maskable_discrete": Recipe(MaskablePPO, options=DISCRETE),
    "maskable_local": Recipe(MaskablePPO, options=LOCAL),
    "recurrent": recurrent(DISCRETE),
    "recurrent_shared": recurrent({}, **SHARED, **ACTOR),
    "recurrent_linear": recurrent(DISCRETE, **LINEAR, **ACTOR),
    "recurrent_local": recurrent(LOCAL),
}
