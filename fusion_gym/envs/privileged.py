"""Vector environments for training with the simulator's knowledge.

Only rewards and credit assignment use this knowledge; observations are the task's own.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from fusion_gym import validation
from fusion_gym.arrays import Array, take_runs
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.estimator import Estimator
from fusion_gym.core.memory import Beliefs
from fusion_gym.core.reward import TRAINING_ERRORS
from fusion_gym.core.runs import Branch, Outcome
from fusion_gym.core.task import Task
from fusion_gym.entries import Options
from fusion_gym.envs.registration import make_task
from fusion_gym.envs.sb3 import FusionSB3VecEnv
from fusion_gym.errors import forbidden
from fusion_gym.validation import refusal

# Arguments of Stable-Baselines3's make_vec_env, which makes one environment after the other.
_OF_SB3 = {"wrapper_class", "wrapper_kwargs", "env_kwargs", "vec_env_cls", "vec_env_kwargs"}
_MOST_BITS = 62  # of an integer that encodes grants and run


class Alternatives(NamedTuple):
    """The outcomes of A alternative decisions in each of N runs.

    Attributes:
        error: Truth minus fused estimate (n, A, N).
        reward_error: Error term of the reward (A, N).
        communication: Token term of the reward (A, N).
        observation: (A, N, entries) float32 of the next state, which for an ended episode is the
            state without a reset.
    """

    error: Array
    reward_error: Array
    communication: Array
    observation: NDArray[np.float32]


def alternatives(
    before: Branch,
    requests: NDArray[Any],
    noise: Array,
    taken: Outcome,
    observation: NDArray[np.float32],
    beliefs: Beliefs,
    local: bool = False,
) -> Alternatives:
    """Return the outcomes of alternative requests; equal grants share one simulated step.

    Args:
        before: Runs before the step; they remain unchanged.
        requests: (A, sensors, N), the alternatives, bool or channels of an assignment.
        noise: Standard normals (channels, N) of the step.
        taken: Outcome of the step with the actual requests.
        observation: Observations (N, entries) after that step.
        beliefs: Beliefs after that step.
        local: Whether observations have what the sensors suppose.
    """
    many, sensors, runs = requests.shape
    values = np.tile(np.arange(runs), many)  # columns of results, the taken step first
    each = requests.transpose(1, 0, 2).reshape(sensors, -1)
    granted, base = before.answer(each, values).granted, 2
    other = np.flatnonzero((granted != np.tile(taken.granted, many)).any(0))
    if each.dtype != np.bool_:  # channels, which the outcome does not have
        granted, base, other = granted * each, before.task.network.slots + 1, np.arange(values.size)
    error, communication = taken.error, taken.reward_communication
    reward = taken.reward_error
    if other.size:
        first = place = np.arange(other.size)
        if sensors * (base - 1).bit_length() + runs.bit_length() <= _MOST_BITS:
            codes = base ** np.arange(sensors) @ granted[:, other] * runs + other % runs
            _, first, place = np.unique(codes, return_index=True, return_inverse=True)
        values[other] = runs + place
        places = other[first]
        run, sent = places % runs, granted[:, places]
        if before.memory.keeps_every and before.task.controller is None:
            branch = before.branch_memory(run)
            outcome = branch.step(sent, noise[:, run], take_runs(beliefs.best, run))
        else:
            branch = before.branch(run)
            outcome = branch.step(sent, noise[:, run])
        error = np.concatenate((error, outcome.error), axis=-1)
        reward = np.concatenate((reward, outcome.reward_error))
        communication = np.concatenate((communication, outcome.reward_communication))
        observation = np.concatenate((observation, branch.observe(local)))
    return Alternatives(
        error[:, values].reshape(-1, many, runs),
        reward[values].reshape(many, runs),
        communication[values].reshape(many, runs),
        observation[values].reshape(many, runs, -1),
    )


class Branched(NamedTuple):
    """Rewards and observations after A alternative decisions on the same noise.

    Attributes:
        reward: (A, N), scaled as the rewards of the step.
        observation: (A, N, entries) float32 of runs, before a view makes rows. For an ended episode
            it belongs to the state without a reset.
    """

    reward: Array
    observation: NDArray[np.float32]


class PrivilegedVecEnv(FusionSB3VecEnv):
    """Stable-Baselines3's ``VecEnv`` with the simulator's knowledge for rewards and credit.

    Args:
        task: The task.
        num_envs: Number N of runs.
        error: Error term of the rewards: ``"squared"`` is the task's own, ``"excess"`` and
            ``"mismatch"`` are defined in :meth:`~fusion_gym.core.reward.Reward.training_error`. The
            returns in infos are the task's. With ``objective="control"`` all are of the
            weighted error where it ranks policies as the cost does.
        reference: Estimator of every measurement
            (:func:`reference_estimator`), needed unless ``error`` is ``"squared"``.
        **options: Keyword arguments of :class:`~fusion_gym.envs.sb3.FusionSB3VecEnv`.

    Raises:
        ConfigurationError: ``error`` is unknown, or lacks a reference or the task's squared error.
    """

    _groups = 8

    def __init__(
        self,
        task: Task,
        num_envs: int,
        *,
        error: str = "squared",
        reference: Estimator[Any] | None = None,
        **options: Any,
    ) -> None:
        self.error = validation.choice("error", error, TRAINING_ERRORS)
        if error != "squared" and reference is None:
            raise refusal("error", error, "'squared' without a reference")
        if error != "squared" and task.reward.error != "squared":
            allowed = f"'squared' with the task's error={task.reward.error_kind!r}"
            raise refusal("error", error, allowed)
        if error != "squared" and not task.equivalent_error:
            allowed = "'squared', because no error ranks policies as the cost of the loop does"
            raise refusal("error", error, allowed)
        super().__init__(task, num_envs, **options)
        if error != "squared":
            self.batch = EpisodeBatch(task, num_envs, self.view.owner, reference)
        self._requests: NDArray[Any] | None = None
        self._observed: NDArray[np.float32] | None = None  # rows of the present step
        self._branched: Branched | None = None

    def step_alternatives(
        self, actions: NDArray[Any], requests: NDArray[Any]
    ) -> tuple[VecEnvStepReturn, Branched]:
        """Make one step in every run, and evaluate other requests on the same noise.

        Args:
            actions: Actions of the step, one per row.
            requests: (A, sensors, N), the alternatives.
        """
        self._requests = requests
        try:
            result = self.step(actions)
        finally:
            self._requests = None
        branched = self._branched
        assert branched is not None
        return result, branched

    def _begin(self, runs: NDArray[np.int64] | None = None) -> None:
        self._observed = None
        super()._begin(runs)

    def _observe(self) -> NDArray[np.float32]:
        return super()._observe() if self._observed is None else self._observed

    def _advance(self, requests: NDArray[Any]) -> Outcome:
        self._observed = None
        if self._requests is None:
            return super()._advance(requests)
        before, scale = self.batch.branch(), self._scale()
        outcome = self.batch.step(requests)
        observation, noise = self.batch.observe(self.view.local), self.batch.normals()
        self._observed = self.view.rows(observation)
        beliefs, local = self.batch.beliefs(), self.view.local
        result = alternatives(before, self._requests, noise, outcome, observation, beliefs, local)
        term = self._error_term(result.error)
        if not self.task.equivalent_error:
            term = result.reward_error
        reward = term + result.communication
        self._branched = Branched(reward * scale, result.observation)
        return outcome

    def _reward(self, outcome: Outcome) -> Array:
        exchanged = self.task.objective == "control" and self.task.equivalent_error
        if self.error == "squared" and not exchanged:
            return outcome.reward
        return self._error_term(outcome.error[:, None])[0] + outcome.reward_communication

    def _error_term(self, error: Array) -> Array:
        """Return the error term (A, N) of errors (n, A, N)."""
        reference = error if self.error == "squared" else self.batch.reference_error[:, None]
        return self.task.reward.training_error(self.error, error, reference)


def reference_estimator(
    env_id: str, options: Options, memory_filter: str | None = None
) -> Estimator[Any]:
    """Return the estimator of an environment that processes every measurement.

    Args:
        env_id: Id of the environment.
        options: Options of ``gym.make``.
        memory_filter: Its filter; ``None`` takes the default filter of the memory.

    Raises:
        ConfigurationError: The id, an option or the filter is unknown.
    """
    settings = {**options, "information": "sensors", "memory": True, "backend": "numpy"}
    if memory_filter is not None:
        settings["memory_filter"] = memory_filter
    task = make_task(env_id, **settings)
    return task.memory_estimator or task.estimator


def make_sb3_vec_env(
    env_id: str,
    num_envs: int,
    *,
    seed: int | None = None,
    stagger: bool = False,
    local: bool = False,
    training_error: str = "squared",
    render_mode: str | None = None,
    **options: Any,
) -> FusionSB3VecEnv:
    """Return the Stable-Baselines3 ``VecEnv`` of a registered environment.

    Args:
        env_id: Id of the environment.
        num_envs: Number N of runs.
        seed: Seed of run 0 for the next reset; run i gets ``seed + i``.
        stagger: Whether the lengths of the first episodes spread from 1 to the horizon.
        local: Whether every sensor of every run is a row of its own.
        training_error: Error term of the rewards. ``"excess"`` and ``"mismatch"`` subtract the part
            that no policy changes (:meth:`~fusion_gym.core.reward.Reward.training_error`). The
            returns in infos are always the task's.
        render_mode: ``"rgb_array"`` for pictures, or ``None``.
        **options: Options of ``gym.make`` for this id.

    Raises:
        ConfigurationError: The id or an option is unknown, or a value is not allowed.

    Example:
        >>> import fusion_gym
        >>> envs = fusion_gym.make_sb3_vec_env("fusion_gym/TobitOscillator-v1", 4, seed=0)
        >>> envs.num_envs, envs.reset().shape
        (4, (4, 32))
    """
    for name in _OF_SB3 & options.keys():
        reason = "wrap the result in a VecEnvWrapper, or make single environments with make_vec_env"
        raise forbidden(name, options[name], f"the runs share one batch; {reason}")
    task = make_task(env_id, **options)
    shared: Any = {"stagger": stagger, "local": local, "render_mode": render_mode}
    if training_error == "squared":
        env = FusionSB3VecEnv(task, num_envs, **shared)
    else:
        validation.choice("training_error", training_error, TRAINING_ERRORS)
        reference = reference_estimator(env_id, options)
        env = PrivilegedVecEnv(task, num_envs, error=training_error, reference=reference, **shared)
    if seed is not None:
        env.seed(seed)
    return env
