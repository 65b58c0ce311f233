"""Stable-Baselines3's vector environment over the batched core."""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.runs import Outcome
from fusion_gym.core.task import Task
from fusion_gym.entries import State
from fusion_gym.envs.drawing import Film, Frame
from fusion_gym.envs.vector import (
    FRAMES_PER_SECOND,
    Infos,
    checked_mode,
    ends_of,
    refuse_vector_reward,
)
from fusion_gym.envs.views import make_view


class FusionSB3VecEnv(VecEnv):
    """Run N episodes of a task behind Stable-Baselines3's ``VecEnv`` interface.

    A run that ends is reset in the same step. Its info then has ``terminal_observation``,
    ``TimeLimit.truncated`` and ``episode``: return ``r``, length ``l``, seconds ``t`` and tokens
    ``cost``. All other infos are empty.

    Args:
        task: The task, as :func:`fusion_gym.make_task` returns it.
        num_envs: Number N of runs.
        stagger: Whether the lengths of the first episodes spread from 1 to the horizon. PPO
            evaluates its value function once per truncated run, so simultaneous ends are slow.
        local: Whether every sensor of every run is a row with the observation of
            :class:`~fusion_gym.envs.views.SensorView`, the action space ``Discrete(2)`` and the
            reward of its run.
        price_exponent: Exponent from 0 to 1 of :meth:`~fusion_gym.core.reward.Price.scale`, which
            multiplies the rewards, but not the returns in the infos.
        render_mode: ``"rgb_array"`` for a picture of each run, or ``None``.

    Attributes:
        view: The view that makes the rows, of the scheduler or of every sensor.
        observation_names: Name of each entry of an observation.
        seconds: Wall time in :meth:`step_wait` and :meth:`reset` so far.
        totals: Tokens and steps so far, summed over all runs.
        requests: Numbers of requests and of grants so far, summed over all runs and sensors.

    Raises:
        ConfigurationError: An argument is not allowed, or the task's reward is a vector.

    Example:
        >>> import fusion_gym
        >>> task = fusion_gym.make_task("fusion_gym/TobitOscillator-v1")
        >>> envs = fusion_gym.FusionSB3VecEnv(task, 4, local=True)
        >>> envs.reset().shape
        (12, 17)
    """

    _groups: int | None = None  # of runs whose first episodes have different lengths

    def __init__(
        self,
        task: Task,
        num_envs: int,
        *,
        stagger: bool = False,
        local: bool = False,
        price_exponent: float = 0.0,
        render_mode: str | None = None,
    ) -> None:
        refuse_vector_reward(task, "with Stable-Baselines3")
        self.runs = validation.runs(num_envs)
        self.task = task
        self.view = make_view(task, validation.boolean("local", local))
        self.batch = EpisodeBatch(task, num_envs, self.view.owner)
        self._rows = self.view.rows_per_run
        self.observation_names = self.view.names
        self.stagger = validation.boolean("stagger", stagger)
        self.price_exponent = validation.number(
            "price_exponent", price_exponent, at_least=0.0, at_most=1.0
        )
        self.seconds = 0.0
        self.totals = (0.0, 0)
        self.requests = (0, 0)
        self.render_mode = checked_mode(type(self).__name__, render_mode, ("rgb_array",))
        self._film = None if self.render_mode is None else Film(task, num_envs)
        super().__init__(num_envs * self._rows, self.view.space, self.view.action.space)
        metadata: Any = self.metadata
        metadata["render_fps"] = FRAMES_PER_SECOND
        self._actions: Any = None
        self._returns = np.zeros(num_envs)
        self._spent = np.zeros(num_envs)
        self._began = time.perf_counter()

    def reset(self) -> NDArray[np.float32]:
        """Begin new episodes in all runs with the seeds set before, and return the rows."""
        began = time.perf_counter()
        for option in self._options:
            validation.reset_options(option, [])
        self.batch.seed(np.arange(self.runs), self._seeds[:: self._rows])
        self._begin()
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._returns[:] = 0.0
        self._spent[:] = 0.0
        observation = self._observe()
        self.seconds += time.perf_counter() - began
        return observation

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seeds of the next reset and return the seed of every row.

        Args:
            seed: Run i gets ``seed + i``, with ``local`` in all its rows; ``None`` draws a seed.
        """
        if seed is None:
            seed = int(np.random.randint(0, 2**32 - 1))  # noqa: NPY002
        first = validation.integer("seed", seed, at_least=0)
        self._seeds = [first + row // self._rows for row in range(self.num_envs)]
        return self._seeds

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions for :meth:`step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Make one step in every run with the stored actions."""
        began = time.perf_counter()
        requests = self.view.action.requests(self._actions, self.runs, self.batch.signals)
        lengths, scale = self.batch.steps, self._scale()
        outcome = self._advance(requests)
        if self._film is not None:
            self._film.record(self.batch, outcome)
        self._returns += outcome.reward
        self._spent += outcome.cost
        self.totals = (self.totals[0] + float(outcome.cost.sum()), self.totals[1] + self.runs)
        request_count, granted = np.count_nonzero(requests), np.count_nonzero(outcome.granted)
        self.requests = (self.requests[0] + int(request_count), self.requests[1] + int(granted))
        done, terminated = outcome.ended, ends_of(self.task, outcome)[0]
        infos: list[Infos] = [{} for _ in range(self.num_envs)]
        if done.any():
            self._finish(np.flatnonzero(done), lengths, terminated, infos)
        reward = (self._reward(outcome) * scale).astype(np.float32)
        result = (self._observe(), reward.repeat(self._rows), done.repeat(self._rows), infos)
        self.seconds += time.perf_counter() - began
        return result

    def snapshot(self) -> State:
        """Return the state of all runs for :meth:`restore`, valid until the next step."""
        return {
            "batch": self.batch.snapshot(),
            "returns": self._returns,
            "spent": self._spent,
            "totals": self.totals,
        }

    def restore(self, snapshot: State) -> None:
        """Set all runs to a :meth:`snapshot` of an environment of the same task."""
        self.batch.restore(snapshot["batch"])
        self._returns = snapshot["returns"]
        self._spent = snapshot["spent"]
        self.totals = snapshot["totals"]

    def _finish(
        self,
        runs: NDArray[np.int64],
        lengths: NDArray[np.int64],
        terminated: NDArray[np.bool_],
        infos: list[Infos],
    ) -> None:
        """Write the infos of finished runs and begin their next episodes."""
        final = self._observe()
        elapsed = round(time.perf_counter() - self._began, 6)
        for run in runs.tolist():
            for row in range(run * self._rows, (run + 1) * self._rows):
                infos[row] = {
                    "terminal_observation": final[row],
                    "TimeLimit.truncated": not terminated[run],
                    "episode": {
                        "r": float(self._returns[run]),
                        "l": int(lengths[run]) + 1,
                        "t": elapsed,
                        "cost": float(self._spent[run]),
                    },
                }
                self.reset_infos[row] = {}
        self._returns[runs] = 0.0
        self._spent[runs] = 0.0
        self._begin(runs)

    def _begin(self, runs: NDArray[np.int64] | None = None) -> None:
        """Begin new episodes in ``runs``, or the first ones in all, whose lengths may spread."""
        self.batch.reset(runs, stagger=self.stagger and runs is None, groups=self._groups)
        if self._film is not None:
            self._film.begin(self.batch, runs)

    def _advance(self, requests: NDArray[Any]) -> Outcome:
        """Step the batch, before finished runs are reset."""
        return self.batch.step(requests)

    def _reward(self, outcome: Outcome) -> Array:
        """Return the rewards (N,) for training, before scaling."""
        return outcome.reward

    def _scale(self) -> Array | float:
        """Return the factor (N,) of the coming step's rewards."""
        if self.price_exponent == 0.0:
            return 1.0
        return self.task.reward.price.scale(self.batch.price, self.price_exponent)

    def _observe(self) -> NDArray[np.float32]:
        return self.view.rows(self.batch.observe(self.view.local))

    def action_masks(self) -> NDArray[np.bool_]:
        """Return the choices (N, choices), bool, that the network can grant as a single request."""
        return self.view.action.masks(self.batch.grantable())

    def get_images(self) -> Sequence[Frame]:
        """Return a picture (height, width, 3) of every run, which :meth:`render` tiles."""
        assert self._film is not None
        return [self._film.frame(run) for run in range(self.runs)]

    def close(self) -> None:
        """Do nothing, because there are no resources to release."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of this environment once per index."""
        value = getattr(self, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Raise an ``AttributeError``, because all runs share one task."""
        raise AttributeError(
            f"cannot set {attr_name!r} of some runs: they share one task; make a new environment"
        )

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Return the rows of ``action_masks``; other methods raise an ``AttributeError``."""
        if method_name == "action_masks":
            masks = self.action_masks()
            return [masks[run] for run in self._get_indices(indices)]
        raise AttributeError(f"the runs share one batch and have no method {method_name!r}")

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """Return ``True`` for ``Monitor``, whose infos are built in, else ``False``."""
        from stable_baselines3.common.monitor import Monitor

        return [wrapper_class is Monitor for _ in self._get_indices(indices)]
