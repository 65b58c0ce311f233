"""The planning model of a reference policy: the task's model without hidden quantities."""

from itertools import product
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.core.estimator import Estimator, Reception
from fusion_gym.core.knowledge import Signals
from fusion_gym.core.network import NetworkState
from fusion_gym.core.task import Task
from fusion_gym.core.token_bucket import Grants
from fusion_gym.policies.belief_rule import beliefs_of


def transmission_sets(task: Task) -> NDArray[np.bool_]:
    """Return every set of sensors that may transmit together (sets, sensors), silence first."""
    if task.network.access == "single":
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
        self._task, self._estimate = task, signals["estimate"]
        queue, admitted = signals["queue"], signals["admitted"]
        self._network = NetworkState(signals["tokens"], queue, admitted)
        if task.network.channel is not None and task.network.channel.states > 1:
            self._network.channel = signals["channel_state"]
        self._beliefs = beliefs_of(signals, own=False) if task.memory else None
        self.arrival = task.network.arrival_probability(self._network)

    @property
    def runs(self) -> int:
        """Number N of runs."""
        return len(self._network.tokens)

    def grant(self, requests: NDArray[np.bool_]) -> Grants:
        """Return the network's answer to requests (sensors, N) now."""
        network = self._network
        return self._task.network.bucket.grant(
            network.tokens, requests & network.admitted, network.queue
        )

    def fused_means(self, arriving: NDArray[np.bool_], steps: int) -> Array:
        """Return the predicted fused means (steps, n, N) after a delivery of these packets.

        After the delivery nothing is transmitted and no noise acts, which gives the expectation of
        a linear system. With ``packet="estimate"`` a packet contains the best estimate.

        Args:
            arriving: delivered packets (sensors, N).
            steps: number of steps.
        """
        estimator = self._task.estimator
        updated = estimator.update(self._estimate, Reception(arriving))
        if self._task.packet == "estimate" and self._beliefs is not None:
            mean, covariance = self._beliefs.best
            updated = estimator.adopt(updated, mean[0], covariance[0], np.asarray(arriving.any(0)))
        return self._silent_path(estimator, updated, steps)

    def best_means(self, steps: int) -> Array:
        """Return the predicted means (steps, n, N) of the best estimate, from all measurements."""
        estimator, beliefs = self._task.memory_estimator, cast(Any, self._beliefs)
        if estimator is None or beliefs is None:
            return self.fused_means(np.ones((self._task.sensors, self.runs), np.bool_), steps)
        return self._silent_path(estimator, beliefs.memory_posterior, steps)

    def _silent_path(self, estimator: Estimator[Any], updated: Any, steps: int) -> Array:
        """Return fused means (steps, n, N) without measurements and transmissions."""
        silence = Reception(np.zeros((self._task.sensors, self.runs), dtype=np.bool_))
        means = [estimator.mean(updated)]
        for _ in range(steps - 1):
            updated = estimator.update(estimator.predict(updated), silence)
            means.append(estimator.mean(updated))
        return np.stack(means)
