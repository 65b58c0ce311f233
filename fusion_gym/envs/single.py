"""Gymnasium's single environment: the batched core with one run."""

import functools
import sys
import warnings
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.envs.drawing import Film, Frame, Window
from fusion_gym.envs.vector import (
    FRAMES_PER_SECOND,
    RENDER_MODES,
    Infos,
    Specified,
    checked_mode,
    reset_infos,
    reward_space,
    rewards_of,
    step_infos,
)
from fusion_gym.envs.views import SchedulerView


class FusionEnv(Specified, gymnasium.Env[Any, Any]):
    """One run of a task behind Gymnasium's interface.

    An episode ends at the task's horizon, by truncation or with ``clock=True`` by termination. With
    ``reward="vector"`` a reward is an array (2,), what the error and what the tokens cost.

    Attributes:
        observation_names: a name for each entry of the observation.
    """

    metadata = {  # noqa: RUF012
        "render_modes": list(RENDER_MODES),
        "render_fps": FRAMES_PER_SECOND,
    }

    def __init__(self, task: Task, render_mode: str | None = None) -> None:
        self.render_mode = checked_mode(type(self).__name__, render_mode)
        self.task = task
        self._film = None if self.render_mode is None else Film(task, 1)
        visible = self.render_mode == "human"
        self._window = Window(type(self).__name__, FRAMES_PER_SECOND) if visible else None
        self.batch = EpisodeBatch(task, 1)
        self._seeded: np.random.Generator | None = None  # whose seed the batch has
        self.view = SchedulerView(task)
        self.observation_names = self.view.names
        self.observation_space = self.view.space
        self.action_space = self.view.actions
        if task.vector_reward:
            self.reward_space = reward_space()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], Infos]:
        """A new episode. There are no options.

        Raises:
            ConfigurationError: an unknown option.
        """
        validation.reset_options(options, [])
        if self._seeded is None and _stepped_one_by_one():
            _warn_of_single_steps()
        super().reset(seed=seed)
        if self.np_random is not self._seeded:
            self._seeded = self.np_random
            known = self.np_random_seed >= 0
            entropy = self.np_random_seed if known else self.np_random.integers(2**63)
            self.batch.seed(np.zeros(1, dtype=np.int64), [int(entropy)])
        self.batch.reset()
        if self._film is not None:
            self._film.begin()
            self._show()
        return self.batch.observe()[0], _first(reset_infos(self.task, 1))

    def step(self, action: Any) -> tuple[NDArray[np.float32], Any, bool, bool, Infos]:
        """One step; see the environment's documentation for the info.

        Raises:
            ValueError: an action that is not in the action space.
            ResetNeeded: before the first reset, or after the end of the episode.
        """
        if self.batch.finished[0]:
            raise gymnasium.error.ResetNeeded("the episode is over or never began: call reset")
        outcome = self.batch.step(self.view.requests(action, None))
        if self._film is not None:
            self._film.record(self.batch, outcome)
            self._show()
        observation = self.batch.observe()[0]
        infos = _first(step_infos(outcome))
        ended, clock = bool(outcome.ended[0]), self.task.clock
        reward = rewards_of(self.task, outcome)[0]
        if not self.task.vector_reward:
            reward = float(reward)
        return observation, reward, ended and clock, ended and not clock, infos

    def render(self) -> Frame | None:
        """The picture (height, width, 3) of the present step; a window shows ``"human"``."""
        if self._film is None or self._window is not None:
            return None
        return self._film.frame()

    def close(self) -> None:
        """The window, if there is one, is gone."""
        if self._window is not None:
            self._window.close()

    def _show(self) -> None:
        if self._window is not None and self._film is not None:
            self._window.show(self._film.frame())

    def action_masks(self) -> NDArray[np.bool_]:
        """Open choices (choices,), for sb3-contrib's MaskablePPO."""
        return self.view.masks(self.batch.grantable())[0]


def _stepped_one_by_one() -> bool:
    """Whether Stable-Baselines3 has wrapped the environment and resets it."""
    frame = sys._getframe(2)
    while frame.f_back is not None:
        frame = frame.f_back
        if frame.f_globals.get("__name__") == "stable_baselines3.common.vec_env.dummy_vec_env":
            return True
    return False


@functools.cache
def _warn_of_single_steps() -> None:
    warnings.warn(
        "Stable-Baselines3 steps this environment one episode at a time; "
        "fusion_gym.make_sb3_vec_env(id, 64) steps 64 in one batch, many times as fast",
        stacklevel=3,
    )


def _first(infos: Infos) -> Infos:
    """The info of the only run: NumPy's numbers, and arrays without the batch axis.

    Every value has a ``dtype``, which TorchRL asks for. A flag is an array without axes: of NumPy's
    scalar flags Gymnasium's vector environments make arrays of objects.
    """
    return {
        key: np.array(value[0]) if value.ndim > 1 or value.dtype == np.bool_ else value[0]
        for key, value in infos.items()
    }
