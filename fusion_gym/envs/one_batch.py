"""Stable-Baselines3's vector of single environments, exchanged for one batch.

Tools that make their environments one by one, as rl-zoo3 does, train at the speed of the batch: its
files of hyper-parameters name :func:`one_batch` as ``vec_env_wrapper``.
"""

from typing import Any

from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from fusion_gym.core.options import plain_options
from fusion_gym.envs.privileged import make_sb3_vec_env
from fusion_gym.envs.registration import base_of
from fusion_gym.envs.sb3 import FusionSB3VecEnv
from fusion_gym.validation import ConfigurationError, display, refusal


def one_batch(envs: VecEnv, **options: Any) -> FusionSB3VecEnv:
    """A batch with as many runs, the same environment and the same seeds; ``envs`` are closed.

    ``options`` belong to :func:`~fusion_gym.envs.privileged.make_sb3_vec_env`; what the
    environments were made with comes before them. Without options the batch's episodes are bitwise
    the episodes of ``envs``. Monitors write no files any more, their infos are the batch's own.

    Raises:
        ConfigurationError: environments of another kind or made differently, with a window, or in
            wrappers, which would be lost; an option that is unknown or has a value that is not
            allowed.
    """
    specs = envs.get_attr("spec")
    spec = specs[0]
    if spec is None:
        raise ConfigurationError("environments in one batch must be made by gym.make")
    base, _ = base_of(spec.id)  # the options are in the specification too
    if any(_made_with(other) != _made_with(spec) for other in specs):
        raise ConfigurationError(
            f"different environments {display([_made_with(other) for other in specs])} are not "
            "allowed in one batch: all must be made alike"
        )
    wrappers = [w.name for w in spec.additional_wrappers if w.name != Monitor.__name__]
    if wrappers:
        raise ConfigurationError(
            f"wrappers {display(wrappers)} are not allowed in one batch, which would lack them"
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


def _made_with(spec: EnvSpec) -> Any:
    """What two specifications have in common if their environments are alike."""
    return spec.id, spec.max_episode_steps, plain_options(spec.kwargs)
