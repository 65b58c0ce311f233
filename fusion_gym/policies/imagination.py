"""Simulated runs that start from the beliefs of a scheduler, for policies that simulate."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array, take_runs
from fusion_gym.core.beliefs import MemoryStates
from fusion_gym.core.memory import Memory
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.runs import Branch, Position
from fusion_gym.core.system import Signals, System
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
        ConfigurationError: a system that cannot draw its hidden parts.
    """

    def __init__(self, task: Task, memory: Memory, layout: ObservationLayout) -> None:
        self._task, self._memory, self._layout = task, memory, layout
        for system in (task.system, task.memory_system or task.system):
            if not system.offers("imagine"):
                raise ConfigurationError(
                    f"{type(system).__name__} is not allowed here: it must offer 'imagine', which "
                    "draws the truth and future noise from their distributions"
                )
        self._first = task.system.imagination_channels
        self._each = task.system.noise_channels + (task.access == "random")

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

        def imagined(system: System[Any], state: Any) -> Any:
            visible = system.visible(take_runs(state, runs))
            return system.imagine(visible, mean, covariance, first)

        states, every = None, beliefs.memory_states.every
        if every is not None:
            states = MemoryStates(every=imagined(task.memory_system or task.system, every))
        steps = signals["step"][runs]
        position = Position(
            imagined(task.system, signals["model"]),
            signals["tokens"][runs],
            signals["price"][runs],
            steps,
            np.full_like(steps, task.horizon),
            signals["queue"][:, runs],
            signals["admitted"][:, runs],
        )
        branch = Branch(task, self._memory.with_states(states), self._layout, position)
        return branch, rest.reshape(-1, self._each, len(runs))
