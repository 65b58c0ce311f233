"""The attributes and methods of single runs, as in Gymnasium's own vector environments."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.envs.views import SchedulerView
from fusion_gym.validation import display

# Attributes of a single environment that all runs share.
_SHARED = ("task", "view", "observation_names", "reward_space", "spec", "metadata", "render_mode")
_METHODS = ("action_masks", "render")


class Members:
    """The runs of a vector environment with the interface of ``gymnasium.vector.SyncVectorEnv``."""

    num_envs: int
    batch: EpisodeBatch
    view: SchedulerView
    single_observation_space: Any
    single_action_space: Any

    def action_masks(self) -> NDArray[np.bool_]:
        """Return the choices (N, choices), bool, that the network can grant as a single request."""
        return self.view.masks(self.batch.grantable())

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Return the result of ``action_masks`` or ``render``, or an attribute, once per run."""
        if name in _METHODS:
            result = getattr(self, name)(*args, **kwargs)
            return (None,) * self.num_envs if result is None else tuple(result)
        return (self._attribute(name),) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute once per run, the spaces without the batch axis."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Raise an ``AttributeError``, because all runs share one task."""
        raise AttributeError(
            f"cannot set {name!r} of some runs: they share one task; make a new environment"
        )

    def _attribute(self, name: str) -> Any:
        if name == "observation_space":
            return self.single_observation_space
        if name == "action_space":
            return self.single_action_space
        if name in _SHARED and hasattr(self, name):
            return getattr(self, name)
        known = [*_METHODS, "observation_space", "action_space"]
        known += [shared for shared in _SHARED if hasattr(self, shared)]
        raise AttributeError(
            f"the runs share one batch and have no {display(name)}: known are {', '.join(known)}"
        )
