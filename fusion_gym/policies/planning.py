"""What a reference may plan with: the task's model from the present on, without what is hidden."""

from itertools import product

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.core.beliefs import silent_path
from fusion_gym.core.system import Signals
from fusion_gym.core.task import Task
from fusion_gym.core.token_bucket import Grants
from fusion_gym.policies.belief_rule import beliefs_of


def transmission_sets(task: Task) -> NDArray[np.bool_]:
    """Every set of sensors that may transmit in one step, (sets, sensors) bool, silence first."""
    if task.access == "single":
        nobody = np.zeros((1, task.sensors), dtype=np.bool_)
        return np.concatenate((nobody, np.eye(task.sensors, dtype=np.bool_)[::-1]))
    return np.array(list(product((False, True), repeat=task.sensors)))


class PlanningModel:
    """The task's own moves from the signals of one step on, for N runs.

    It knows what a scheduler knows: all new measurements, what the nodes and the centre hold,
    the tokens, and with memory all that was measured and not sent. It has neither the true state
    nor what the channel is about to lose.

    ``arrival`` (sensors, N) is the probability that a packet sent now arrives; None: surely.
    """

    def __init__(self, task: Task, signals: Signals) -> None:
        self._task, self._state, self._step = task, signals["model"], signals["step"]
        self._tokens, self._admitted = signals["tokens"], signals["admitted"]
        self._queue = signals["queue"]
        self._beliefs = beliefs_of(signals, own=False) if task.memory else None
        system = task.system
        self.arrival: Array | None = None
        if system.offers("arrival_probability"):
            self.arrival = system.arrival_probability(self._state)

    @property
    def runs(self) -> int:
        """Number N of runs."""
        return len(self._tokens)

    def grant(self, requests: NDArray[np.bool_]) -> Grants:
        """What the network would answer to requests (sensors, N) now.

        With ``access="single"`` there must be at most one a run.
        """
        admitted = requests & self._admitted
        return self._task.bucket.grant(self._tokens, admitted, self._step, self._queue)

    def fused_means(self, arriving: NDArray[np.bool_], steps: int) -> Array:
        """Fused means (steps, n, N) if these packets (sensors, N) arrive now.

        After that nothing is transmitted and no noise acts: the expectation of a linear system.
        With ``packet="estimate"`` they bring the best estimate there is.
        """
        system = self._task.system
        delivered = system.deliver(self._state, arriving)
        if self._task.packet == "estimate" and self._beliefs is not None:
            mean, covariance = self._beliefs.best
            delivered = system.adopt(delivered, mean[0], covariance[0], np.asarray(arriving.any(0)))
        return silent_path(system, delivered, steps)

    def best_means(self, steps: int) -> Array:
        """The same of the estimate that holds all that was measured, with memory ever."""
        memory_system = self._task.memory_system
        if memory_system is None or self._beliefs is None:
            return self.fused_means(np.ones((self._task.sensors, self.runs), np.bool_), steps)
        return silent_path(
            memory_system, memory_system.visible(self._beliefs.memory_posterior), steps
        )
