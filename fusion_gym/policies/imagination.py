"""Simulated runs that start from the beliefs of a scheduler, for policies that simulate."""

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array, take_runs
from fusion_gym.core.knowledge import Signals
from fusion_gym.core.memory import Memory
from fusion_gym.core.network import NetworkState
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.runs import Branch, Position, State
from fusion_gym.core.task import Task
from fusion_gym.policies.belief_rule import beliefs_of
from fusion_gym.validation import ConfigurationError


class Imagination:
    """A maker of simulated runs, whose hidden parts are drawn from the beliefs.

    Args:
        task: the task.
        memory: the scheduler's memory.
        layout: layout of the observation.

    Raises:
        ConfigurationError: a plant that cannot be drawn.
    """

    def __init__(self, task: Task, memory: Memory, layout: ObservationLayout) -> None:
        self._task, self._memory, self._layout = task, memory, layout
        self._of_plant = task.plant.draw_channels
        if self._of_plant is None:
            raise ConfigurationError(
                f"{type(task.plant).__name__} is not allowed here: it must offer 'draw', which "
                "draws the truth and future noise from their distributions"
            )
        self._first = self._of_plant + task.network.draw_channels
        self._each = task.plant.noise_channels + task.network.noise_channels

    def channels(self, steps: int) -> int:
        """Return the number of standard normals that :meth:`begin` takes for ``steps`` steps."""
        return self._first + steps * self._each

    def begin(
        self, signals: Signals, runs: NDArray[np.int64], normals: Array
    ) -> tuple[Branch, Array]:
        """Return simulated runs and the noise of their steps (steps, channels of a step, R).

        Args:
            signals: signals of N runs.
            runs: numbers of R of these runs, with repetitions (R,).
            normals: standard normals (channels, R).
        """
        task, beliefs = self._task, beliefs_of(signals, own=False)
        first, rest = normals[: self._first], normals[self._first :]
        mean, covariance = (take_runs(part[0], runs) for part in beliefs.best)

        states = {name: take_runs(own, runs) for name, own in beliefs.memory_states.items()}
        steps, estimate = signals["step"][runs], take_runs(signals["estimate"], runs)
        own, rest_of_first = first[: self._of_plant], first[self._of_plant :]
        plant = task.plant.draw(estimate.measurement, mean, covariance, own, steps + 1.0)
        known = NetworkState(
            signals["tokens"][runs], signals["queue"][:, runs], signals["admitted"][:, runs]
        )
        if task.network.channel is not None and task.network.channel.states > 1:
            known.channel = signals["channel_state"][:, runs]
        network = task.network.draw(known, rest_of_first)
        state = State(plant, estimate, network)
        limit = np.full_like(steps, task.horizon)
        position = Position(state, signals["price"][runs], steps, limit)
        branch = Branch(task, self._memory.with_states(states), self._layout, position)
        return branch, rest.reshape(-1, self._each, len(runs))
