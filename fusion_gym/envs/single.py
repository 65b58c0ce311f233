"""Gymnasium's single environment over the batched core."""

import functools
import sys
import traceback
import warnings
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.arrays import map_arrays
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.entries import Arguments
from fusion_gym.envs import vector
from fusion_gym.envs.drawing import Film, Frame, Window
from fusion_gym.envs.views import SchedulerView


class FusionEnv(vector.Specified, gymnasium.Env[Any, Any]):
    """Run one episode of a task behind Gymnasium's interface.

    An episode ends at the task's horizon: by truncation, or with ``clock=True`` by termination.
    With ``reward="vector"`` a reward is an array (2,): the error term and the token term.

    Args:
        task: The task, as :func:`fusion_gym.make_task` returns it.
        render_mode: ``"rgb_array"``, ``"human"`` or ``None``.

    Attributes:
        observation_names: Name of each entry of the observation.

    Raises:
        ConfigurationError: The render mode is unknown, or its drawing package is absent.

    Example:
        >>> import fusion_gym
        >>> env = fusion_gym.FusionEnv(fusion_gym.make_task("fusion_gym/TobitOscillator-v1"))
        >>> observation, info = env.reset(seed=0)
        >>> observation.shape, env.action_space
        ((32,), MultiBinary(3))
        >>> observation, reward, terminated, truncated, info = env.step([1, 0, 1])
        >>> round(reward, 3), float(info["cost"])
        (-1.272, 6.0)
    """

    metadata = {  # noqa: RUF012
        "render_modes": list(vector.RENDER_MODES),
        "render_fps": vector.FRAMES_PER_SECOND,
    }

    def __init__(self, task: Task, render_mode: str | None = None) -> None:
        self.render_mode = vector.checked_mode(type(self).__name__, render_mode)
        self.task = task
        self._film = None if self.render_mode is None else Film(task, 1)
        visible = self.render_mode == "human"
        self._window = Window(type(self).__name__, vector.FRAMES_PER_SECOND) if visible else None
        self.batch = EpisodeBatch(task, 1)
        self._seeded: np.random.Generator | None = None  # generator whose seed the batch uses
        self.view = SchedulerView(task)
        self.observation_names = self.view.names
        self.observation_space = self.view.space
        self.action_space = self.view.action.space
        if task.options.reward == "vector":
            self.reward_space = vector.reward_space()

    def reset(
        self, *, seed: int | None = None, options: Arguments | None = None
    ) -> tuple[NDArray[np.float32], vector.Infos]:
        """Begin a new episode.

        Args:
            seed: Seed of the episodes; ``None`` begins the next episode of the present seed.
            options: ``None`` or an empty mapping, because a reset has no options.

        Returns:
            The observation (entries,) and the info of a step without transmissions.

        Raises:
            ConfigurationError: ``options`` has an entry.
        """
        validation.reset_options(options, [])
        if self._seeded is None and _steps_singly():
            _warn_of_single_steps()
        super().reset(seed=seed)
        if self.np_random is not self._seeded:
            self._seeded = self.np_random
            known = self.np_random_seed >= 0
            entropy = self.np_random_seed if known else self.np_random.integers(2**63)
            self.batch.seed(np.zeros(1, dtype=np.int64), [int(entropy)])
        self.batch.reset()
        if self._film is not None:
            self._film.begin(self.batch)
            self._show()
        outcome = vector.reset_outcome(self.task, 1).single(0)
        return self.batch.observe()[0], vector.step_infos(outcome)

    def step(self, action: Any) -> tuple[NDArray[np.float32], Any, bool, bool, vector.Infos]:
        """Make one step.

        Args:
            action: An element of ``action_space``.

        Returns:
            Observation (entries,), reward, ``terminated``, ``truncated`` and info.

        Raises:
            ValueError: The action is not in the action space.
            ResetNeeded: The episode has not begun or is over.
        """
        if self.batch.finished[0]:
            raise gymnasium.error.ResetNeeded("the episode is over or never began: call reset")
        outcome = self.batch.step(self.view.action.requests(action, None, self.batch.signals), 0)
        if self._film is not None:
            whole = map_arrays(lambda part: part[..., None].copy(), outcome)
            self._film.record(self.batch, whole)
            self._show()
        observation = self.batch.observe()[0]
        infos = vector.step_infos(outcome)
        terminated, truncated = vector.ends_of(self.task, outcome)
        reward: Any = vector.rewards_of(self.task, outcome)
        if self.task.options.reward != "vector":
            reward = float(reward)
        return observation, reward, bool(terminated), bool(truncated), infos

    def render(self) -> Frame | None:
        """Return the picture (height, width, 3) of the present step with ``"rgb_array"``."""
        if self._film is None or self._window is not None:
            return None
        return self._film.frame()

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._window.close()

    def _show(self) -> None:
        if self._window is not None and self._film is not None:
            self._window.show(self._film.frame())

    def action_masks(self) -> NDArray[np.bool_]:
        """Return the allowed choices (choices,), bool, as sb3-contrib's MaskablePPO reads them."""
        return self.view.action.masks(self.batch.grantable())[0]


def _steps_singly() -> bool:
    """Return whether a ``DummyVecEnv`` of Stable-Baselines3 calls the reset."""
    module = "stable_baselines3.common.vec_env.dummy_vec_env"
    _, *callers = traceback.walk_stack(sys._getframe(2))
    return any(frame.f_globals.get("__name__") == module for frame, _ in callers)


@functools.cache
def _warn_of_single_steps() -> None:
    warnings.warn(
        "Stable-Baselines3 steps this environment one episode at a time; "
        "fusion_gym.make_sb3_vec_env(id, 64) steps 64 in one batch, many times faster",
        stacklevel=3,
    )
