"""Gymnasium's vector environment over the batched core."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.runs import Outcome
from fusion_gym.core.task import Task
from fusion_gym.entries import Arguments
from fusion_gym.envs.drawing import Film, Frame
from fusion_gym.envs.registration import FusionSpec
from fusion_gym.envs.views import SchedulerView

Infos = Arguments
RENDER_MODES = ("rgb_array", "human")
FRAMES_PER_SECOND = 10
# Attributes of a single environment that all runs share.
_SHARED = ("task", "view", "observation_names", "reward_space", "spec", "metadata", "render_mode")
_METHODS = ("action_masks", "render")


class Specified:
    """An environment whose specification has the task's horizon as ``max_episode_steps``."""

    task: Task
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's specification of the environment, or ``None`` without ``gym.make``."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = None if spec is None else FusionSpec.from_spec(spec)
        if self._spec is not None:
            self._spec.max_episode_steps = self.task.horizon


class FusionVectorEnv(Specified, VectorEnv[Any, Any, Any]):
    """Run N episodes of a task behind Gymnasium's vector interface.

    Episodes end at the task's horizon: by truncation, or with ``clock=True`` by termination.
    Rewards have the shape (N,), or (N, 2) with ``reward="vector"``.

    Args:
        task: The task, as :func:`fusion_gym.make_task` returns it.
        num_envs: Number N of runs.
        autoreset_mode: ``NEXT_STEP``, ``SAME_STEP`` (with ``final_obs`` and ``final_info``) or
            ``DISABLED`` (reset with ``options={"reset_mask": mask}``).
        render_mode: ``"rgb_array"`` or ``None``.

    Attributes:
        observation_names: Name of each entry of an observation.

    Raises:
        ConfigurationError: ``num_envs`` is not a whole number >= 1, or a mode is unknown.

    Example:
        >>> import fusion_gym
        >>> task = fusion_gym.make_task("fusion_gym/TobitOscillator-v1")
        >>> envs = fusion_gym.FusionVectorEnv(task, num_envs=4)
        >>> observations, infos = envs.reset(seed=0)
        >>> observations.shape
        (4, 32)
        >>> rewards = envs.step(envs.action_space.sample())[1]
        >>> rewards.shape
        (4,)
    """

    def __init__(
        self,
        task: Task,
        num_envs: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
    ) -> None:
        self.render_mode = checked_mode(type(self).__name__, render_mode, ("rgb_array",))
        self.num_envs = validation.runs(num_envs)
        modes = [mode.value for mode in AutoresetMode]
        value = getattr(autoreset_mode, "value", autoreset_mode)
        self.autoreset_mode = AutoresetMode(validation.choice("autoreset_mode", value, modes))
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": FRAMES_PER_SECOND,
            "autoreset_mode": self.autoreset_mode,
        }
        self.task = task
        self.batch = EpisodeBatch(task, self.num_envs)
        self.view = SchedulerView(task)
        self.observation_names = self.view.names
        self.single_observation_space = self.view.space
        self.single_action_space = self.view.action.space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        if task.options.reward == "vector":
            self.reward_space = reward_space()
        self._film = None if self.render_mode is None else Film(task, self.num_envs)
        self._everyone = np.ones(self.num_envs, dtype=np.bool_)
        self._started = np.zeros(self.num_envs, dtype=np.bool_)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Arguments | None = None
    ) -> tuple[NDArray[np.float32], Infos]:
        """Begin new episodes in all runs, or in the runs of ``options["reset_mask"]``.

        Args:
            seed: A number gives run i the seed ``seed + i``; a sequence has one seed per run.
                ``None`` begins the next episode of the present seed.
            options: ``None``, or ``{"reset_mask": mask}`` with ``mask`` (N,) bool.

        Returns:
            Observations (N, entries) and the infos of a step without transmissions.

        Raises:
            ValueError: Seeds or mask have a wrong length or type, or an option is unknown.
        """
        seeds: Sequence[int | None]
        if seed is None:
            seeds = [None] * self.num_envs
        elif isinstance(seed, (int, np.integer)):
            super().reset(seed=int(seed))
            seeds = [int(seed) + run for run in range(self.num_envs)]
        else:
            if not isinstance(seed, (Sequence, np.ndarray)) or isinstance(seed, str):
                raise validation.refusal("seed", seed, "a whole number or a sequence")
            kinds = (int, np.integer, type(None))
            if any(isinstance(entry, bool) or not isinstance(entry, kinds) for entry in seed):
                raise validation.refusal("seed", seed, "a whole number, or whole numbers and None")
            seeds = [None if entry is None else int(entry) for entry in seed]
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed has {len(seeds)} entries: it must have {self.num_envs}")
        mask = self._reset_mask(options)
        runs = np.flatnonzero(mask)
        self.batch.seed(runs, [seeds[run] for run in runs])
        self._begin(runs)
        self._started |= mask
        infos = step_infos(reset_outcome(self.task, self.num_envs))
        return self.batch.observe(), _with_mask(infos, mask)

    def render(self) -> tuple[Frame, ...] | None:
        """Return a picture (height, width, 3) of every run, or ``None`` without a render mode."""
        if self._film is None:
            return None
        return tuple(self._film.frame(run) for run in range(self.num_envs))

    def _begin(self, runs: NDArray[np.int64]) -> None:
        """Begin new episodes in ``runs``."""
        self.batch.reset(runs)
        if self._film is not None:
            self._film.begin(self.batch, runs)

    def _reset_mask(self, options: Arguments | None) -> NDArray[np.bool_]:
        validation.reset_options(options, ["reset_mask"])
        if not options or "reset_mask" not in options:
            return self._everyone
        mask = options["reset_mask"]
        fits = isinstance(mask, np.ndarray) and mask.shape == (self.num_envs,)
        if not (fits and mask.dtype == np.bool_ and mask.any()):
            raise ValueError(
                f"reset_mask = {mask!r} is not allowed: it must be a NumPy array of bool, of shape "
                f"({self.num_envs},), with at least one True"
            )
        if not (self._started | mask).all():
            raise ValueError("reset_mask must cover every run that was never reset before")
        return mask

    def step(
        self, actions: Any
    ) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[np.bool_], NDArray[np.bool_], Infos]:
        """Make one step in every run.

        Args:
            actions: An element of ``action_space``.

        Returns:
            Observations (N, entries), rewards, ``terminated`` (N,), ``truncated`` (N,) and infos.

        Raises:
            ValueError: An action is not in the action space.
            ResetNeeded: A run was never reset, or with ``DISABLED`` a run is finished.
        """
        if not self._started.all():
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        batch = self.batch
        requests = self.view.action.requests(actions, self.num_envs, self.batch.signals)
        finished = batch.finished
        if self.autoreset_mode == AutoresetMode.DISABLED and finished.any():
            raise gymnasium.error.ResetNeeded(
                f"runs {np.flatnonzero(finished).tolist()} are finished: reset them with "
                "options={'reset_mask': mask} before the next step"
            )
        outcome = batch.step(requests)
        if self._film is not None:
            self._film.record(batch, outcome)
        reward, ended = rewards_of(self.task, outcome), outcome.ended
        infos = step_infos(outcome)
        if self.autoreset_mode == AutoresetMode.NEXT_STEP and finished.any():
            self._begin(np.flatnonzero(finished))
            reward = np.where(finished.reshape(-1, *[1] * (reward.ndim - 1)), 0.0, reward)
            ended = ended & ~finished
            infos = _cleared(infos, finished)
        final: Infos = {}
        if self.autoreset_mode == AutoresetMode.SAME_STEP and ended.any():
            final = _final_infos(infos, ended, batch.observe())
            self._begin(np.flatnonzero(ended))
            infos = _cleared(infos, ended)
        terminated, truncated = ends_of(self.task, outcome._replace(ended=ended))
        infos = _with_mask(infos, self._everyone) | final
        return batch.observe(), reward, terminated, truncated, infos

    def action_masks(self) -> NDArray[np.bool_]:
        """Return the choices (N, choices), bool, that the network can grant as a single request."""
        return self.view.action.masks(self.batch.grantable())

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
        spaces = self.single_observation_space, self.single_action_space
        known = dict(zip(("observation_space", "action_space"), spaces, strict=True))
        known |= {shared: getattr(self, shared) for shared in _SHARED if hasattr(self, shared)}
        if name in known:
            return known[name]
        raise AttributeError(
            f"the runs share one batch and have no {validation.display(name)}: known are "
            + ", ".join([*_METHODS, *known])
        )


def checked_mode(owner: str, render_mode: Any, modes: Sequence[str] = RENDER_MODES) -> str | None:
    """Return the render mode if it is ``None`` or one of ``modes``."""
    if render_mode is not None and render_mode not in modes:
        listed = ", ".join(map(repr, modes))
        raise validation.UnexpectedArgumentError.for_argument(
            owner,
            "render_mode",
            f"render_mode = {render_mode!r} is not allowed: it must be None or one of {listed}",
        )
    return None if render_mode is None else str(render_mode)


def ends_of(task: Task, outcome: Outcome) -> tuple[Any, Any]:
    """Return ``terminated`` and ``truncated`` of an outcome.

    The plant may terminate an episode, and its last step does if the observation has the clock.
    """
    ended, over = outcome.ended, outcome.terminated
    terminated = ended & (task.options.clock if over is None else over | task.options.clock)
    return terminated, ended & ~terminated


def rewards_of(task: Task, outcome: Outcome) -> NDArray[np.float64]:
    """Return the rewards (N,) of a step, or (N, 2) with error term and token term."""
    if task.options.reward != "vector":
        return outcome.reward
    return np.stack([outcome.reward_error, outcome.reward_communication], axis=-1)


def refuse_vector_reward(task: Task, where: str) -> None:
    """Raise a ``ConfigurationError`` if the task's reward is a vector."""
    if task.options.reward == "vector":
        raise validation.refusal("reward", "vector", "'scalar'", where)


def reward_space() -> Box:
    """Return the space of vector rewards, as MO-Gymnasium requires it."""
    return Box(-np.inf, 0.0, (2,), np.float64)


def step_infos(outcome: Outcome) -> Infos:
    """Return the info of a step as arrays with the batch axis first, without masks.

    TorchRL reads the ``dtype`` of every value. The flag of one run is an array of shape (), because
    Gymnasium's vector environments turn NumPy's scalar flags into objects.
    """
    loop = {"control_cost": outcome.control_cost, "control": outcome.control}
    return {
        "cost": outcome.cost,
        "cost_tokens": outcome.cost,
        "reward_error": outcome.reward_error,
        "reward_cost": outcome.reward_communication,
        "granted": outcome.granted.T,
        "arrived": outcome.arrived.T,
        "denied": (outcome.requested > outcome.granted).T,
        "squared_error": outcome.squared_error.T,
        "diverged": outcome.diverged[...],
        "age": outcome.age.T,
        "incorrect_age": outcome.incorrect_age,
    } | {key: value.T for key, value in loop.items() if value is not None}


def reset_outcome(task: Task, num_envs: int) -> Outcome:
    """Return the outcome of a reset: zeros, as in a step without requests and errors."""
    none, never = np.zeros(num_envs), np.zeros(num_envs, dtype=np.bool_)
    silence = np.zeros((task.sensors, num_envs), dtype=np.bool_)
    error = np.zeros((len(task.plant.state_names), num_envs))
    age = np.zeros((task.sensors, num_envs))
    terms = none, none, none, none, silence, silence, silence, error, error, never, never, age, none
    if task.controller is None:
        return Outcome(*terms)
    return Outcome(*terms, none, 0.0 * task.controller.act(error))


def _cleared(infos: Infos, runs: NDArray[np.bool_]) -> Infos:
    """Return the infos with zeros in ``runs``, a mask (N,)."""
    return {
        key: np.where(runs.reshape(-1, *[1] * (value.ndim - 1)), np.zeros((), value.dtype), value)
        for key, value in infos.items()
    }


def _with_mask(infos: Infos, mask: NDArray[np.bool_]) -> Infos:
    """Return the infos in Gymnasium's vector form, each key with its mask of valid runs."""
    result = {key: value.copy() for key, value in infos.items()}
    return result | {f"_{key}": mask.copy() for key in infos}


def _final_infos(infos: Infos, ended: NDArray[np.bool_], observation: NDArray[np.float32]) -> Infos:
    final_obs = np.full(len(ended), None, dtype=object)
    for run in np.flatnonzero(ended):
        final_obs[run] = observation[run]
    return {
        "final_obs": final_obs,
        "_final_obs": ended.copy(),
        "final_info": _with_mask(_cleared(infos, ~ended), ended),
        "_final_info": ended.copy(),
    }
