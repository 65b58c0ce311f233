"""Registration of the environments with Gymnasium, and the way to a task by its id."""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium.envs.registration import load_env_creator

from fusion_gym.core.task import Task
from fusion_gym.envs.vector import FusionVectorEnv
from fusion_gym.validation import ConfigurationError, keys

ENVIRONMENTS = {
    "fusion_gym/TobitOscillator-v0": "fusion_gym.systems.tobit.oscillator:TobitOscillator",
    "fusion_gym/CorrelatedTracking-v0": "fusion_gym.systems.correlated.environment:CorrelatedTracking",
    "fusion_gym/MarkovJumpTracking-v0": "fusion_gym.systems.markov_jump.environment:MarkovJumpTracking",
    "fusion_gym/UnknownInput-v0": "fusion_gym.systems.unknown_input.environment:UnknownInput",
    "fusion_gym/BiasedOscillator-v0": "fusion_gym.systems.tobit.biased:BiasedOscillator",
    "fusion_gym/BiasedTracking-v0": "fusion_gym.systems.tobit.biased:BiasedTracking",
    "fusion_gym/RemoteEstimation-v0": "fusion_gym.systems.remote.environment:RemoteEstimation",
}


def register() -> None:
    """Register every environment with Gymnasium (again: no effect)."""
    for name, prefix in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name, entry_point=f"{prefix}Env", vector_entry_point=f"{prefix}VectorEnv"
            )


def make_task(env_id: str, **options: Any) -> Task:
    """The task of a registered environment with these options.

    Raises:
        ConfigurationError: an id that is not one of this suite's, an unknown option, or a value
            that is not allowed.
    """
    known = {
        name
        for name, spec in gymnasium.registry.items()
        if spec.vector_entry_point is not None and name.startswith("fusion_gym/")
    }
    keys("environment", [env_id], known)
    for name in ("num_envs", "autoreset_mode", "render_mode"):
        if name in options:
            raise ConfigurationError(
                f"{name} = {options[name]!r} is not allowed: it is no option of a task"
            )
    spec = gymnasium.spec(env_id)
    entry = spec.vector_entry_point
    creator = load_env_creator(entry) if isinstance(entry, str) else entry
    assert creator is not None
    env = creator(num_envs=1, **(spec.kwargs | options))
    assert isinstance(env, FusionVectorEnv)
    return env.task
