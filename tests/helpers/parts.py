"""Plant and estimator of a task, moved by hand without a network."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.core.estimator import Estimator, Reception
from fusion_gym.core.plant import Plant
from fusion_gym.core.runs import State
from fusion_gym.core.task import Task

Array = NDArray[Any]


@dataclass(frozen=True)
class Parts:
    """A plant and an estimator, whose states are those of ``Runs`` without a network."""

    plant: Plant[Any]
    estimator: Estimator[Any]

    @classmethod
    def of(cls, task: Task) -> "Parts":
        """The task's plant and estimator."""
        return cls(task.plant, task.estimator)

    def start(self, noise: Array) -> State:
        """The states at time 0 from normals (start_channels, N)."""
        plant, announcement = self.plant.start(noise)
        estimate = self.estimator.start(self.plant.measurement(plant), announcement)
        nothing: Any = None
        return State(plant, estimate, network=nothing, age=nothing, incorrect_age=nothing)

    def sense(self, state: State, noise: Array) -> State:
        """The states after the plant moved with normals (noise_channels, N)."""
        plant = self.plant.sense(state.plant, noise)
        predicted = self.estimator.predict(state.estimate)
        estimate = self.estimator.observe(predicted, self.plant.measurement(plant))
        return state._replace(plant=plant, estimate=estimate)

    def deliver(self, state: State, arrived: Array, **more: Any) -> State:
        """The states after the arrival of packets (sensors, N) bool."""
        reception = Reception(arrived, **more)
        return state._replace(estimate=self.estimator.update(state.estimate, reception))

    def truth(self, state: State) -> Array:
        """The plant's state (n, N)."""
        return self.plant.truth(state.plant)

    def fused(self, state: State) -> tuple[Array, Array]:
        """The centre's mean (n, N) and covariance (n, n, N)."""
        return self.estimator.mean(state.estimate), self.estimator.covariance(state.estimate)

    def normals(self, seed: int, runs: int, steps: int) -> tuple[Array, Array]:
        """Normals of a start (start_channels, N) and of steps (steps, noise_channels, N)."""
        rng = np.random.default_rng(seed)
        start = rng.standard_normal((self.plant.start_channels, runs))
        return start, rng.standard_normal((steps, self.plant.noise_channels, runs))
