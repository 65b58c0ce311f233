"""The planning model of a reference policy: the task's model without hidden quantities."""

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
    """Return every set of sensors that may transmit together (sets, sensors), silence first."""
    if task.access == "single":
        silence = np.zeros((1, task.sensors), dtype=np.bool_)
        return np.concatenate((silence, np.eye(task.sensors, dtype=np.bool_)[::-1]))
    return np.array(list(product((False, True), repeat=task.sensors)))


class PlanningModel:
    """The task's model from the signals of one step on, for N runs.

    It has the knowledge of a scheduler: all new measurements, the states of nodes and centre, the
    tokens, and with memory all unsent measurements. It has neither the true state nor the coming
    losses.

    ``arrival`` (sensors, N) is the probability that a packet arrives; None for a lossless network.
    """

    def __init__(self, task: Task, signals: Signals) -> None:
        self._task, self._state = task, signals["model"]
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
        """Return the network's answer to requests (sensors, N) now."""
        return self._task.bucket.grant(self._tokens, requests & self._admitted, self._queue)

    def fused_means(self, arriving: NDArray[np.bool_], steps: int) -> Array:
        """Return the predicted fused means (steps, n, N) after a delivery of these packets.

        After the delivery nothing is transmitted and no noise acts, which gives the expectation of
        a linear system. With ``packet="estimate"`` a packet contains the best estimate.

        Args:
            arriving: delivered packets (sensors, N).
            steps: number of steps.
        """
        system = self._task.system
        delivered = system.deliver(self._state, arriving)
        if self._task.packet == "estimate" and self._beliefs is not None:
            mean, covariance = self._beliefs.best
            delivered = system.adopt(delivered, mean[0], covariance[0], np.asarray(arriving.any(0)))
        return silent_path(system, delivered, steps)

    def best_means(self, steps: int) -> Array:
        """Return the predicted means (steps, n, N) of the best estimate, from all measurements."""
        memory_system = self._task.memory_system
        if memory_system is None or self._beliefs is None:
            return self.fused_means(np.ones((self._task.sensors, self.runs), np.bool_), steps)
        return silent_path(
            memory_system, memory_system.visible(self._beliefs.memory_posterior), steps
        )
