"""N runs of a task at one time: what is known of them, and the two halves of a step.

Both halves are pure: they make new arrays and change none, so runs can be taken apart from those
that they began as and moved on other noise.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array, take_runs
from fusion_gym.core.access import access_mask, first_request
from fusion_gym.core.beliefs import Beliefs, Estimate
from fusion_gym.core.memory import Memory
from fusion_gym.core.observation import NetworkState, ObservationLayout
from fusion_gym.core.system import Signals
from fusion_gym.core.task import Task
from fusion_gym.core.token_bucket import Grants, Queue


class Outcome(NamedTuple):
    """What one step brought, batch axis last.

    ``reward`` (N,) is ``reward_error`` + ``reward_communication``; ``cost`` (N,) the tokens spent;
    ``requested``, ``granted`` (sensors, N) bool; ``error`` (n, N) of the fused estimate, the truth
    minus it, and ``squared_error``;
    ``diverged`` (N,) bool, whether some state's squared error is not finite or above the task's
    ``divergence_level``; ``ended`` (N,) bool, whether
    the episode is over.
    """

    reward: Array
    reward_error: Array
    reward_communication: Array
    cost: Array
    requested: NDArray[np.bool_]
    granted: NDArray[np.bool_]
    error: Array
    squared_error: Array
    diverged: NDArray[np.bool_]
    ended: NDArray[np.bool_]


class Position(NamedTuple):
    """Where N runs are, after sensing: all that moves with them.

    The system's ``state``, ``tokens`` and ``price`` (N,), ``steps`` taken and the ``limit`` at
    which the episode ends (N,), the bucket's ``queue`` (sensors, N), and who is ``admitted`` in the
    coming step (sensors, N) bool.
    """

    state: Any
    tokens: Array
    price: Array
    steps: NDArray[np.int64]
    limit: NDArray[np.int64]
    queue: Queue
    admitted: NDArray[np.bool_]


class Runs:
    """N runs of a :class:`~fusion_gym.core.task.Task` at one time, after sensing.

    ``state`` is the system's after sensing, ``delivered`` its state after the last delivery,
    for metrics and figures; ``memory`` moves along beside them; ``tokens``, ``price`` of a token
    and ``steps`` taken are (N,); ``queue`` (sensors, N) is the token bucket's.
    """

    state: Any
    tokens: Array
    price: Array
    steps: NDArray[np.int64]
    queue: Queue
    _limit: NDArray[np.int64]

    def __init__(self, task: Task, memory: Memory, layout: ObservationLayout) -> None:
        self.task, self.memory, self.layout = task, memory, layout
        self.delivered: Any = None

    @property
    def channels(self) -> int:
        """Standard normals of one step: the system's, and one for ``access="random"``."""
        return self.task.system.noise_channels + (self.task.access == "random")

    def deliver(self, requests: NDArray[np.bool_]) -> Outcome:
        """The first half of a step: answer the requests (sensors, N), update, fuse, reward."""
        task, system = self.task, self.task.system
        granted, spent, tokens, self.queue = self.answer(requests)
        state = self.memory.deliver(self.state, system.deliver(self.state, granted), granted)
        mean, covariance = system.fused(state)
        error = system.truth(state) - mean
        squared_error = error * error
        reward_error, reward_communication = task.reward.terms(error, covariance, spent, self.price)
        self.delivered, self.tokens, self.steps = state, tokens, self.steps + 1
        return Outcome(
            reward=reward_error + reward_communication,
            reward_error=reward_error,
            reward_communication=reward_communication,
            cost=spent,
            requested=requests,
            granted=granted,
            error=error,
            squared_error=squared_error,
            diverged=np.asarray(~(squared_error <= task.divergence_level).all(0)),
            ended=self.steps >= self._limit,
        )

    def answer(
        self, requests: NDArray[np.bool_], runs: NDArray[np.int64] | slice = slice(None)
    ) -> Grants:
        """The network's answer to requests (sensors, R), each of one of the R ``runs``."""
        steps, queue = self.steps[runs], self.queue[:, runs]
        if self.task.access == "single":
            requests = first_request(requests, queue)
        elif self.task.access in ("round_robin", "random"):
            requests = requests & self.admitted()[:, runs]
        return self.task.bucket.grant(self.tokens[runs], requests, steps, queue)

    def sense(self, noise: Array) -> None:
        """The second half: the plant moves, the sensors measure, with noise (channels, N)."""
        noise = noise[: self.task.system.noise_channels]
        self.memory.sense(noise)
        self.state = self.task.system.sense(self.delivered, noise)

    def branch(self, runs: NDArray[np.int64] | None = None) -> Branch:
        """The given runs (all by default), in this order and possibly again and again, apart.

        Runs that are finished go on from their continued state.
        """
        memory = self.memory.branch(runs, len(self.steps))
        return Branch(self.task, memory, self.layout, self._position(runs))

    def branch_memory(self, runs: NDArray[np.int64]) -> Branch:
        """As :meth:`branch`, of a scheduler's runs whose x* is known and no longer computed.

        What a scheduler remembers does not depend on what is sent: x* after a step is that of
        the runs that these were taken from, and has to be given to :meth:`Branch.step`.
        """
        position = self._position(runs)
        memory = self.memory.with_best(position.state, take_runs(self.beliefs().best, runs))
        return Branch(self.task, memory, self.layout, position)

    def _position(self, runs: NDArray[np.int64] | None) -> Position:
        if runs is None:
            return Position(
                self.state,
                self.tokens.copy(),
                self.price.copy(),
                self.steps.copy(),
                self._limit.copy(),
                self.queue,
                self.admitted(),
            )
        return Position(
            take_runs(self.state, runs),
            self.tokens[runs],
            self.price[runs],
            self.steps[runs],
            self._limit[runs],
            self.queue[:, runs],
            self.admitted()[:, runs],
        )

    def observe(self) -> NDArray[np.float32]:
        """Observations (N, entries) of all runs, a fresh array."""
        left = (self._limit - self.steps).astype(np.float64)
        network = NetworkState(self.tokens, self.admitted, self.price, left, self.queue)
        return self.layout.encode(self.state, network, self.beliefs)

    def beliefs(self) -> Beliefs:
        """What the owner of the memory believes before anything is sent."""
        return self.memory.beliefs(self.state)

    def admitted(self) -> NDArray[np.bool_]:
        """The sensors (sensors, N) that the network's access rule admits in the coming step."""
        return access_mask(self.task.access, self.task.sensors, self.steps, self._lottery())

    def grantable(self) -> NDArray[np.bool_]:
        """The sensors (sensors, N) whose request alone the network would grant now."""
        return np.asarray(self.admitted() & self.task.bucket.affordable(self.tokens))

    def signals(self) -> Signals:
        """The signals of all runs, without what the information mode withholds.

        To the system's own it adds ``tokens`` (N,), ``token_cost`` (sensors, 1), ``price`` (N,) of
        a token, ``step`` (N,), the steps taken in the episode, ``queue`` (sensors, N), each
        sensor's place in the queue, 0 for who was granted least recently, ``start`` (N,) bool,
        ``admitted`` and ``grantable`` (sensors, N) bool, ``observation`` (N, entries), and
        ``model``, the system's state without what no policy may know, for policies that plan with
        the system's own moves; and the beliefs (:mod:`fusion_gym.core.signals`).
        """
        system, state = self.task.system, self.state
        values = dict(system.read(state))
        values |= {
            "tokens": self.tokens,
            "token_cost": self.task.bucket.cost,
            "price": self.price,
            "step": self.steps,
            "queue": self.queue,
            "start": self.steps == 0,
            "admitted": self.admitted,
            "grantable": self.grantable,
            "observation": self.observe,
            "model": lambda: system.visible(state),
        }
        values |= self.memory.signals(self.beliefs)
        return Signals(values, self.task.hidden_signals, self.memory.missing_signals)

    def _lottery(self) -> Array | None:
        """The standard normals (N,) that decide random access; None with another rule."""
        return None


class Branch(Runs):
    """Runs of their own from a :class:`Position` on, with whatever noise they are given.

    It shares arrays with what it was taken from and never changes one.
    """

    def __init__(
        self,
        task: Task,
        memory: Memory,
        layout: ObservationLayout,
        position: Position,
    ) -> None:
        super().__init__(task, memory, layout)
        self.state, self.tokens, self.price = position[:3]
        self.steps, self._limit, self.queue, self._admitted = position[3:]

    def step(
        self, requests: NDArray[np.bool_], noise: Array, best: Estimate | None = None
    ) -> Outcome:
        """Both halves of a step, with standard normals (channels, N).

        ``best`` is x* after the step, for runs that were taken by :meth:`Runs.branch_memory`.
        """
        outcome = self.deliver(requests)
        self.sense(noise)
        if best is not None:
            self.memory = self.memory.with_best(self.state, best)
        return outcome

    def sense(self, noise: Array) -> None:
        """See :class:`Runs`."""
        super().sense(noise)
        lottery = noise[-1] if self.task.access == "random" else None
        self._admitted = access_mask(self.task.access, self.task.sensors, self.steps, lottery)

    def admitted(self) -> NDArray[np.bool_]:
        """See :class:`Runs`."""
        return self._admitted
