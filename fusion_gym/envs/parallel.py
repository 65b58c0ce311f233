"""The multi-agent view: every sensor an agent of PettingZoo's parallel interface."""

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
from fusion_gym.envs.vector import refuse_vector_reward
from fusion_gym.envs.views import SensorView
from fusion_gym.errors import display

Dict = dict[str, Any]


class FusionParallelEnv(ParallelEnv[str, NDArray[np.float32], int]):
    """One run, in which each sensor decides by itself whether to request (1) or not (0).

    An agent observes what its sensor sees by itself (:class:`~fusion_gym.envs.views.SensorView`),
    all get the run's reward. Episodes end by truncation for all agents at once.

    Attributes:
        observation_names: a name for each entry of an agent's observation.
        state_names: a name for each entry of :meth:`state`.
        state_space: the Box of :meth:`state`, float32.
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
        self.action_spaces = dict.fromkeys(self.possible_agents, self.view.actions)

    def observation_space(self, agent: str) -> Box:
        """Box of shape (entries,), float32, the same for every agent."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Discrete[Any]:
        """``Discrete(2)``: 1 requests a transmission."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: Dict | None = None) -> tuple[Dict, Dict]:
        """A new episode; without a seed the noise goes on where it stood.

        The infos are those of a step in which nothing was sent.
        There are no options, and PettingZoo's interface test demands that any be taken.
        """
        self.batch.seed(np.zeros(1, dtype=np.int64), [seed])
        self.batch.reset()
        self.agents = list(self.possible_agents)
        infos = {agent: {"granted": False, "cost": 0.0} for agent in self.agents}
        return self._observations(), infos

    def step(self, actions: Dict) -> tuple[Dict, Dict, Dict, Dict, Dict]:
        """One step with an action of every agent; an info has ``granted`` and ``cost``.

        Raises:
            ResetNeeded: before the first reset, or after the end of the episode.
            ValueError: an agent without an action, or an action other than 0 and 1.
        """
        if not self.agents:
            raise gymnasium.error.ResetNeeded("the episode is over or never began: call reset")
        if not isinstance(actions, Mapping) or set(actions) != set(self.agents):
            raise ValueError(
                f"actions {display(actions)} are not allowed: they must be a dictionary with one "
                f"of each of {self.agents}"
            )
        selection = [actions[agent] for agent in self.agents]
        outcome = self.batch.step(self.view.requests(selection, None))
        reward, ended = float(outcome.reward[0]), bool(outcome.ended[0])
        agents = self.agents
        costs = outcome.granted[:, 0] * self.task.bucket.cost[:, 0]
        infos = {
            agent: {"granted": bool(outcome.granted[sensor, 0]), "cost": float(costs[sensor])}
            for sensor, agent in enumerate(agents)
        }
        result = (
            self._observations(),
            dict.fromkeys(agents, reward),
            dict.fromkeys(agents, ended and self.task.clock),
            dict.fromkeys(agents, ended and not self.task.clock),
            infos,
        )
        if ended:
            self.agents = []
        return result

    def state(self) -> NDArray[np.float32]:
        """What all sensors and the centre know together (entries,), for a central critic.

        It is a scheduler's observation, with what each sensor remembers by itself in a task with
        memory: everything that an agent observes but its own number, and nothing of the truth.

        Raises:
            ResetNeeded: before the first reset.
        """
        if self.batch.state is None:
            raise gymnasium.error.ResetNeeded("call reset before the first state")
        return self.batch.observe()[0]

    def _observations(self) -> Dict:
        rows = self.view.rows(self.batch.observe())
        return dict(zip(self.agents, rows, strict=True))

    def render(self) -> None:
        """Nothing to see; figures are made by ``fusion_gym.evaluation.episodes.record_episode``."""


def parallel_env(env_id: str, **options: Any) -> FusionParallelEnv:
    """The multi-agent view of a registered environment; ``options`` are those of ``gym.make``.

    Raises:
        ConfigurationError: an unknown id or option, or a value that is not allowed.
    """
    return FusionParallelEnv(make_task(env_id, **options))
