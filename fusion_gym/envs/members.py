"""What Gymnasium's own vector environments tell of the single environments that they hold."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.envs.views import SchedulerView
from fusion_gym.validation import display

# Attributes that all runs share, as single environments have them.
_SHARED = ("task", "view", "observation_names", "reward_space", "spec", "metadata", "render_mode")
_METHODS = ("action_masks", "render")


class Members:
    """The runs of a vector environment, asked as if each were an environment of its own.

    ``call``, ``get_attr`` and ``set_attr`` are those of ``gymnasium.vector.SyncVectorEnv``.
    """

    num_envs: int
    batch: EpisodeBatch
    view: SchedulerView
    single_observation_space: Any
    single_action_space: Any

    def action_masks(self) -> NDArray[np.bool_]:
        """Open choices (N, choices), as in sb3-contrib's MaskablePPO.

        Closed are requests that the network would not grant even alone.
        """
        return self.view.masks(self.batch.grantable())

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """What a method of each run returns, or its attribute: ``action_masks``, ``render``, …

        Raises:
            AttributeError: runs have no such method or attribute, for they share one batch.
        """
        if name in _METHODS:
            result = getattr(self, name)(*args, **kwargs)
            return (None,) * self.num_envs if result is None else tuple(result)
        return (self._attribute(name),) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """An attribute of every run: spaces are those of one run, all else is what they share.

        Raises:
            AttributeError: runs have no such attribute.
        """
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Refused: the runs share one task, make another environment instead.

        Raises:
            AttributeError: always.
        """
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
