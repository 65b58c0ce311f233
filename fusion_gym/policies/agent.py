"""Policies with the interface of Stable-Baselines3's agents, for loops over an environment."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.vector import VectorObservationWrapper
from numpy.typing import NDArray

from fusion_gym.core.access import assign
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.knowledge import Signals
from fusion_gym.core.task import Task
from fusion_gym.envs.views import Rows, View
from fusion_gym.errors import forbidden, refusal
from fusion_gym.policies.base import Policy, Requests, guard, owner_of


class _Member(NamedTuple):
    """Runs that share a batch, their view, and their policy with its decision."""

    batch: EpisodeBatch
    view: View
    policy: Policy
    decision: Callable[[Signals], Requests]

    def rows(self) -> Rows:
        """Return the present observation of each row."""
        return self.view.rows(self.batch.observe(self.view.local))

    def act(self) -> NDArray[Any]:
        """Return the action of each row."""
        batch, action = self.batch, self.view.action
        requests: NDArray[Any] = self.decision(batch.signals())
        if action.limited:  # the network chooses among several requests
            granted, network = batch.answer(requests).granted, batch.state.network
            if not batch.task.network.rule.by_channel:
                requests = granted
            elif requests.dtype == np.bool_:
                links = batch.signals()["link_probability"]
                requests = assign(granted, network.queue, links)
        return action.actions(requests)


class PolicyAgent:
    """A policy on an environment, which acts as an agent of Stable-Baselines3 does.

    :func:`~fusion_gym.make_policy` makes it. The policy uses the environment's present state and
    not the observation, because rules use signals that an observation does not have. So it acts
    only in the environment for which it was made.

    Args:
        env: the environment, through its wrappers.
        make: function from a task to the policy.

    Raises:
        ConfigurationError: an environment of another library or process, or a policy that uses
            beliefs which the environment does not have.

    Example:
        >>> import gymnasium as gym
        >>> import fusion_gym
        >>> env = gym.make("fusion_gym/LinearFusion-v2")
        >>> agent = fusion_gym.make_policy("always", env)
        >>> observation, info = env.reset(seed=0)
        >>> agent.predict(observation)[0]
        array([1, 1], dtype=int8)
    """

    def __init__(self, env: Any, make: Callable[[Task], Policy]) -> None:
        self._env, self._bare = env, _environments(env)
        self._members = []
        for bare in self._bare:
            policy = make(bare.task)
            owner, own = owner_of(policy), bare.batch.memory.owner
            if owner not in (None, own):
                reason = f"it uses beliefs of {owner!r}, and this environment has those of {own!r}"
                raise forbidden("policy", type(policy).__name__, reason, "here")
            decision = guard(policy, bare.task)
            self._members.append(_Member(bare.batch, bare.view, policy, decision))
        self.set_random_seed(0)

    def set_random_seed(self, seed: int) -> None:
        """Clear the policy's memory, and draw from the streams of ``seed``, ``seed + 1``, …."""
        for member in self._members:
            member.policy.reset(member.batch.num_envs, seed)
            seed += member.batch.num_envs

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """Return the actions on the present state of the environment.

        Args:
            observation: the environment's last observation, or PettingZoo's dictionary.
            state: returned unchanged, because the policy has its own memory.
            episode_start: not used, because the environment knows its starts.
            deterministic: take the likeliest action of a saved agent instead of a draw, unless
                its text has ``deterministic=false``.

        Returns:
            The actions, of one run without a batch axis if the observation has none, and ``state``.

        Raises:
            ConfigurationError: an observation that is not the environment's last one.
        """
        several = isinstance(observation, Mapping)
        rows = [*observation.values()] if several else observation
        self._check(np.asarray(rows))
        actions = np.concatenate([self._act(member, deterministic) for member in self._members])
        if several:
            return dict(zip(observation, actions.tolist(), strict=True)), state
        single = np.ndim(rows) == len(self._env.observation_space.shape)
        alone = single and isinstance(self._env, gymnasium.Env)
        return (actions[0] if alone else actions), state

    def _act(self, member: _Member, deterministic: bool) -> NDArray[Any]:
        policy: Any = member.policy
        if deterministic or not getattr(policy, "deterministic", False):
            return member.act()
        policy.deterministic = False
        try:
            return member.act()
        finally:
            policy.deterministic = True

    def _check(self, observation: NDArray[Any]) -> None:
        """Refuse an observation of another time or environment, if no wrapper changes it."""
        if any(not member.batch.episodes.min() >= 0 for member in self._members):
            raise gymnasium.error.ResetNeeded("call reset before the first prediction")
        if _changes_observations(self._env, self._bare):
            return
        present = np.concatenate([member.rows() for member in self._members])
        if not np.array_equal(observation.ravel(), present.ravel()):
            allowed = "the environment's last one, because the policy uses its present state"
            raise refusal("observation", observation, allowed)


def _environments(env: Any) -> Sequence[Any]:
    """Return the environments of this suite inside their wrappers and vectors."""
    bare = getattr(env, "unwrapped", env)
    if isinstance(getattr(bare, "batch", None), EpisodeBatch):
        return [bare]
    parts = getattr(bare, "envs", ())  # of DummyVecEnv and SyncVectorEnv
    if parts:
        return [own for part in parts for own in _environments(part)]
    allowed = "a task, or an environment of this suite in this process, through its wrappers"
    raise refusal("env", type(bare).__name__, allowed)


def _changes_observations(env: Any, bare: Sequence[Any]) -> bool:
    """Return whether a wrapper changes the observations."""
    for part in getattr(getattr(env, "unwrapped", env), "envs", ()):
        if _changes_observations(part, bare):
            return True
    wrapper = env
    while wrapper is not getattr(wrapper, "unwrapped", wrapper):
        kinds = gymnasium.ObservationWrapper, VectorObservationWrapper
        if isinstance(wrapper, kinds) or hasattr(wrapper, "normalize_obs"):
            return True
        inner = getattr(wrapper, "env", None) or wrapper.venv
        if wrapper.observation_space != inner.observation_space:
            return True
        wrapper = inner
    return False
