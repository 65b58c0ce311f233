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
    from fusion_gym import evaluation, jax, zoo
    from fusion_gym.envs.parallel import FusionParallelEnv, parallel_env
    from fusion_gym.envs.privileged import make_sb3_vec_env
    from fusion_gym.envs.sb3 import FusionSB3VecEnv
    from fusion_gym.envs.single import FusionEnv
    from fusion_gym.envs.vector import FusionVectorEnv

__all__ = [
    "ConfigurationError",
    "FusionEnv",
    "FusionParallelEnv",
    "FusionSB3VecEnv",
    "FusionVectorEnv",
    "__version__",
    "evaluation",
    "jax",
    "make_policy",
    "make_sb3_vec_env",
    "make_task",
    "parallel_env",
    "policy_names",
    "register",
    "register_policy",
    "zoo",
]

# Interfaces and their modules; most need the extra "agents".
_INTERFACES = {
    "FusionEnv": "single",
    "FusionVectorEnv": "vector",
    "FusionSB3VecEnv": "sb3",
    "make_sb3_vec_env": "privileged",
    "FusionParallelEnv": "parallel",
    "parallel_env": "parallel",
}

register()


def __dir__() -> list[str]:
    """Return all public names, including the names that are imported on first access."""
    return sorted({*globals(), *__all__})


if not TYPE_CHECKING:  # type checkers see only the names above

    def __getattr__(name: str) -> Any:
        """Import an interface and its optional packages on first access."""
        if name in _INTERFACES:
            try:
                return getattr(
                    importlib.import_module(f"{__name__}.envs.{_INTERFACES[name]}"), name
                )
            except ModuleNotFoundError as error:
                missing = f"{error}: pip install 'fusion-gym[agents]'"
                raise ModuleNotFoundError(missing, name=error.name) from None
        if name in ("evaluation", "jax", "zoo"):
            return importlib.import_module(f"{__name__}.{name}")
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
