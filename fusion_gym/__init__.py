"""fusion-gym: Gymnasium environments for networked estimation under a limit on transmissions.

Importing the package registers its environments with Gymnasium.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from fusion_gym.envs.registration import make_task, register
from fusion_gym.policies.registry import make_policy, policy_names, register_policy
from fusion_gym.validation import ConfigurationError
from fusion_gym.version import __version__

if TYPE_CHECKING:
    from fusion_gym import evaluation, wrappers, zoo
    from fusion_gym.core.control import Controller
    from fusion_gym.core.estimator import Estimator, Reception
    from fusion_gym.core.knowledge import Block, Signal, age_block
    from fusion_gym.core.plant import Plant
    from fusion_gym.core.task import CommonOptions, Scenario, Task
    from fusion_gym.envs.parallel import FusionParallelEnv, parallel_env
    from fusion_gym.envs.privileged import make_sb3_vec_env
    from fusion_gym.envs.sb3 import FusionSB3VecEnv
    from fusion_gym.envs.single import FusionEnv
    from fusion_gym.envs.vector import FusionVectorEnv
    from fusion_gym.policies.base import Policy, Rule, parameter
    from fusion_gym.systems.nonlinear import NonlinearSystem
    from fusion_gym.training.config import Experiment
    from fusion_gym.training.run import train

__all__ = [
    "Block",
    "CommonOptions",
    "ConfigurationError",
    "Controller",
    "Estimator",
    "Experiment",
    "FusionEnv",
    "FusionParallelEnv",
    "FusionSB3VecEnv",
    "FusionVectorEnv",
    "NonlinearSystem",
    "Plant",
    "Policy",
    "Reception",
    "Rule",
    "Scenario",
    "Signal",
    "Task",
    "__version__",
    "age_block",
    "evaluation",
    "make_policy",
    "make_sb3_vec_env",
    "make_task",
    "parallel_env",
    "parameter",
    "policy_names",
    "register",
    "register_policy",
    "train",
    "wrappers",
    "zoo",
]

# Names that are imported on first access, by module; some need an extra.
_PLACES = {
    "core.control": ("Controller",),
    "core.estimator": ("Estimator", "Reception"),
    "core.knowledge": ("Block", "Signal", "age_block"),
    "core.plant": ("Plant",),
    "core.task": ("CommonOptions", "Scenario", "Task"),
    "envs.parallel": ("FusionParallelEnv", "parallel_env"),
    "envs.privileged": ("make_sb3_vec_env",),
    "envs.sb3": ("FusionSB3VecEnv",),
    "envs.single": ("FusionEnv",),
    "envs.vector": ("FusionVectorEnv",),
    "policies.base": ("Policy", "Rule", "parameter"),
    "systems.nonlinear": ("NonlinearSystem",),
    "training.config": ("Experiment",),
    "training.run": ("train",),
}

_EXTRAS = {"envs.parallel": "marl", "envs.privileged": "sb3", "envs.sb3": "sb3"}

register()


def __dir__() -> list[str]:
    """Return all public names, including the names that are imported on first access."""
    return sorted({*globals(), *__all__})


if not TYPE_CHECKING:  # type checkers see only the names above

    def __getattr__(name: str) -> Any:
        """Import a name and its optional packages on first access."""
        for module, names in _PLACES.items():
            if name in names:
                try:
                    return getattr(importlib.import_module(f"{__name__}.{module}"), name)
                except ModuleNotFoundError as error:
                    extra = _EXTRAS.get(module, "agents")
                    missing = f"{error}: install fusion-gym with its extra {extra!r}"
                    raise ModuleNotFoundError(missing, name=error.name) from None
        if name in ("evaluation", "jax", "wrappers", "zoo"):
            return importlib.import_module(f"{__name__}.{name}")
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
