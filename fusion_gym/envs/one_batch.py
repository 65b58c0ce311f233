"""Replace Stable-Baselines3's vector of single environments by one batch.

rl-zoo3's hyper-parameter files name :func:`one_batch` as ``vec_env_wrapper``.
"""

from typing import Any

from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from fusion_gym.declaration import plain_options
from fusion_gym.envs.privileged import make_sb3_vec_env
from fusion_gym.envs.registration import base_of
from fusion_gym.envs.sb3 import FusionSB3VecEnv
from fusion_gym.validation import ConfigurationError, display, refusal


def one_batch(envs: VecEnv, **options: Any) -> FusionSB3VecEnv:
    """Return a batch of the same environment with as many runs and the same seeds; close ``envs``.

    Args:
        envs: Vector of environments of one registered id, made alike by ``gym.make`` and without
            wrappers other than ``Monitor``.
        **options: Options of :func:`~fusion_gym.envs.privileged.make_sb3_vec_env`, which the
            environments' own options replace. Without options the episodes are bitwise equal.

    Raises:
        ConfigurationError: The environments differ, have a window or have wrappers, or an option is
            not allowed.
    """
    specs = envs.get_attr("spec")
    spec = specs[0]
    if spec is None:
        raise ConfigurationError("gym.make must create the environments of one batch")
    base, _ = base_of(spec.id)  # the specification has the options too
    if any(_spec_key(other) != _spec_key(spec) for other in specs):
        raise ConfigurationError(
            f"different environments {display([_spec_key(other) for other in specs])} are not "
            "allowed in one batch: all must be the same"
        )
    wrappers = [w.name for w in spec.additional_wrappers if w.name != Monitor.__name__]
    if wrappers:
        raise ConfigurationError(
            f"wrappers {display(wrappers)} are not allowed in one batch: it cannot apply them"
        )
    arguments = dict(spec.kwargs)
    if arguments.pop("render_mode", None) == "human":
        raise refusal("render_mode", "human", "None or 'rgb_array'", "in one batch")
    (task,) = envs.get_attr("task", indices=0)
    if spec.max_episode_steps is not None and spec.max_episode_steps < task.horizon:
        arguments["max_episode_steps"] = spec.max_episode_steps  # a limit of gym.make
    batch = make_sb3_vec_env(base, envs.num_envs, **(options | arguments))
    batch.seed(envs._seeds[0])
    envs.close()
    return batch


def _spec_key(spec: EnvSpec) -> Any:
    """Return the id, step limit and options that equal environments share."""
    return spec.id, spec.max_episode_steps, plain_options(spec.kwargs)
