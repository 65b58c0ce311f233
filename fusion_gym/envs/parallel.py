"""The multi-agent view: every sensor is an agent of PettingZoo's parallel interface."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.envs.vector import ends_of, refuse_vector_reward
from fusion_gym.envs.views import SensorView
from fusion_gym.errors import display

Dict = dict[str, Any]


class FusionParallelEnv(ParallelEnv[str, NDArray[np.float32], int]):
    """Run one episode of a task with every sensor as an agent, which requests (1) or not (0).

    An agent observes the entries of its :class:`~fusion_gym.envs.views.SensorView`. All agents
    receive the reward of the run, and their episodes end together.

    Args:
        task: The task, as :func:`fusion_gym.make_task` returns it.

    Attributes:
        observation_names: Name of each entry of an agent's observation.
        state_names: Name of each entry of :meth:`state`.
        state_space: The Box of :meth:`state`, float32.

    Raises:
        ConfigurationError: The task has a vector reward or no view for local sensors.

    Example:
        >>> import fusion_gym
        >>> task = fusion_gym.make_task("fusion_gym/TobitOscillator-v1")
        >>> env = fusion_gym.FusionParallelEnv(task)
        >>> observations, infos = env.reset(seed=0)
        >>> env.agents, observations["sensor_0"].shape, env.state().shape
        (['sensor_0', 'sensor_1', 'sensor_2'], (17,), (32,))
    """

    metadata = {"render_modes": [], "name": "fusion_gym_v0", "is_parallelizable": True}  # noqa: RUF012

    def __init__(self, task: Task) -> None:
        refuse_vector_reward(task, "with PettingZoo")
        self.task = task
        self.view = SensorView(task)
        self.batch = EpisodeBatch(task, 1, self.view.owner)
        self.observation_names = self.view.names
        layout = self.batch.layout
        self.state_names = layout.names
        self.state_space = Box(layout.low, layout.high, dtype=np.float32)
        self.render_mode = None
        self.possible_agents = [f"sensor_{sensor}" for sensor in range(task.sensors)]
        self.agents: list[str] = []
        self.observation_spaces = dict.fromkeys(self.possible_agents, self.view.space)
        self.action_spaces = dict.fromkeys(self.possible_agents, self.view.action.space)

    def observation_space(self, agent: str) -> Box:
        """Return the Box (entries,), float32, which is the same for every agent."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Discrete[Any]:
        """Return ``Discrete(2)``, in which 1 is a request."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: Dict | None = None) -> tuple[Dict, Dict]:
        """Begin a new episode.

        Args:
            seed: Seed of the episodes; ``None`` begins the next episode of the present seed.
            options: Ignored; PettingZoo's interface test requires a reset to accept options.

        Returns:
            The observations and infos of all agents, as dictionaries.
        """
        self.batch.seed(np.zeros(1, dtype=np.int64), [seed])
        self.batch.reset()
        self.agents = list(self.possible_agents)
        infos = {agent: {"granted": False, "cost": 0.0} for agent in self.agents}
        return self._observations(), infos

    def step(self, actions: Dict) -> tuple[Dict, Dict, Dict, Dict, Dict]:
        """Make one step.

        Args:
            actions: The action 0 or 1 of every agent.

        Returns:
            Dictionaries by agent: observations, rewards, ``terminated``, ``truncated`` and infos.
            An info has ``granted`` and ``cost`` (tokens).

        Raises:
            ResetNeeded: The episode has not begun or is over.
            ValueError: An agent has no action, or an action is not 0 or 1.
        """
        if not self.agents:
            raise gymnasium.error.ResetNeeded("the episode is over or never began: call reset")
        if not isinstance(actions, Mapping) or set(actions) != set(self.agents):
            raise ValueError(
                f"actions {display(actions)} are not allowed: they must be a dictionary with one "
                f"action of each of {self.agents}"
            )
        selection = [actions[agent] for agent in self.agents]
        outcome = self.batch.step(self.view.action.requests(selection, None, self.batch.signals))
        reward, (terminated, truncated) = float(outcome.reward[0]), ends_of(self.task, outcome)
        agents = self.agents
        costs = outcome.granted[:, 0] * self.task.network.bucket.cost[:, 0]
        infos = {
            agent: {"granted": bool(outcome.granted[sensor, 0]), "cost": float(costs[sensor])}
            for sensor, agent in enumerate(agents)
        }
        result = (
            self._observations(),
            dict.fromkeys(agents, reward),
            dict.fromkeys(agents, bool(terminated[0])),
            dict.fromkeys(agents, bool(truncated[0])),
            infos,
        )
        if outcome.ended[0]:
            self.agents = []
        return result

    def state(self) -> NDArray[np.float32]:
        """Return the scheduler's observation (entries,) with all memories, for a central critic."""
        if self.batch.state is None:
            raise gymnasium.error.ResetNeeded("call reset before the first state")
        return self.batch.observe()[0]

    def _observations(self) -> Dict:
        rows = self.view.rows(self.batch.observe(local=True))
        return dict(zip(self.agents, rows, strict=True))

    def render(self) -> None:
        """Do nothing; :func:`fusion_gym.evaluation.record_episode` records data for figures."""


def parallel_env(env_id: str, **options: Any) -> FusionParallelEnv:
    """Return the multi-agent environment of a registered id.

    Args:
        env_id: Id of the environment.
        **options: Options of ``gym.make`` for this id.

    Raises:
        ConfigurationError: The id or an option is unknown, or a value is not allowed.

    Example:
        >>> import fusion_gym
        >>> fusion_gym.parallel_env("fusion_gym/TobitOscillator-v1").possible_agents
        ['sensor_0', 'sensor_1', 'sensor_2']
    """
    return FusionParallelEnv(make_task(env_id, **options))
