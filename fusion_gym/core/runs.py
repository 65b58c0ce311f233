"""N runs of a task at one time, and the two halves of a step.

Both halves make new arrays and change none, so runs can branch on other noise.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
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
from fusion_gym.namespace import namespace


class Outcome(NamedTuple):
    """The results of one step, batch axis last.

    Attributes:
        reward: (N,), the sum of both terms.
        reward_error: Error term (N,).
        reward_communication: Token term (N,).
        cost: Tokens spent (N,).
        requested: (sensors, N) bool.
        granted: (sensors, N) bool.
        error: Truth minus fused estimate (n, N).
        squared_error: (n, N).
        diverged: (N,) bool, whether a squared error is not finite or exceeds the task's
            ``divergence_level``.
        ended: (N,) bool, whether the episode is over.
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
    """The state of N runs after sensing.

    Attributes:
        state: The system's state.
        tokens: (N,).
        price: Price of a token (N,).
        steps: Steps taken (N,).
        limit: Step at which the episode ends (N,).
        queue: Place of each sensor in the queue (sensors, N).
        admitted: Sensors that the access rule admits in the coming step (sensors, N) bool.
    """

    state: Any
    tokens: Array
    price: Array
    steps: NDArray[np.int64]
    limit: NDArray[np.int64]
    queue: Queue
    admitted: NDArray[np.bool_]


class Lazy:
    """A value that is computed on first access."""

    def __init__(self, compute: Callable[[], Any]) -> None:
        self._compute = compute

    @cached_property
    def value(self) -> Any:
        """The value."""
        return self._compute()

    def __getstate__(self) -> dict[str, Any]:
        return {"value": self.value}


def value_of(value: Any) -> Any:
    """Return the value of a :class:`Lazy`, and any other value as it is."""
    return value.value if isinstance(value, Lazy) else value


class Runs:
    """N runs of a :class:`~fusion_gym.core.task.Task` at one time, after sensing.

    Args:
        task: The task.
        memory: Memory, which moves with the runs.
        layout: Layout of the observation.

    Attributes:
        tokens: (N,).
        price: Price of a token (N,).
        steps: Steps taken (N,).
        queue: Place of each sensor in the queue (sensors, N).
    """

    tokens: Array
    price: Array
    steps: NDArray[np.int64]
    queue: Queue
    _limit: NDArray[np.int64]

    def __init__(self, task: Task, memory: Memory, layout: ObservationLayout) -> None:
        self.task, self.memory, self.layout = task, memory, layout
        self._silence = task.system.offers("with_possible")
        self._gaps = task.system.offers("available")
        self._delivered: Any = None

    @property
    def state(self) -> Any:
        """The system's state after sensing."""
        return value_of(self._state)

    @state.setter
    def state(self, state: Any) -> None:
        self._state = state

    @property
    def delivered(self) -> Any:
        """The system's state after the last delivery, for metrics and figures."""
        return value_of(self._delivered)

    @property
    def channels(self) -> int:
        """Number of standard normals of a step: the system's, and one for ``access="random"``."""
        return self.task.system.noise_channels + (self.task.access == "random")

    def deliver(self, requests: NDArray[np.bool_]) -> Outcome:
        """Make the first half of a step with requests (sensors, N): grant, update, fuse, reward."""
        task, system = self.task, self.task.system
        granted, spent, tokens, self.queue = self.answer(requests)
        state = self.state
        if self._silence:
            state = system.with_possible(state, self._possible(granted, spent))
        state = self.memory.deliver(self.state, system.deliver(state, granted), granted)
        mean, covariance = system.fused(state)
        error = system.truth(state) - mean
        if self._gaps:
            error = np.where(system.available(state)[1], error, 0.0)
        squared_error = error * error
        reward_error, reward_communication = task.reward.terms(error, covariance, spent, self.price)
        self._delivered, self.tokens, self.steps = state, tokens, self.steps + 1
        return Outcome(
            reward=reward_error + reward_communication,
            reward_error=reward_error,
            reward_communication=reward_communication,
            cost=spent,
            requested=requests,
            granted=granted,
            error=error,
            squared_error=squared_error,
            diverged=namespace(squared_error)
            .logical_not(squared_error <= task.divergence_level)
            .any(0),
            ended=self.steps >= self._limit,
        )

    def answer(
        self, requests: NDArray[np.bool_], runs: NDArray[np.int64] | slice = slice(None)
    ) -> Grants:
        """Return the grants for requests (sensors, R) of the R ``runs``."""
        queue = self.queue[:, runs]
        if self._gaps or self.task.access in ("round_robin", "random"):
            requests = requests & self.admitted()[:, runs]
        if self.task.access == "single":
            requests = first_request(requests, queue)
        return self.task.bucket.grant(self.tokens[runs], requests, queue)

    def sense(self, noise: Array) -> None:
        """Make the second half of a step: move the plant and measure, with noise (channels, N)."""
        noise = noise[: self.task.system.noise_channels]
        self.memory.sense(noise)
        self.state = self.task.system.sense(self._delivered, noise)

    def branch(self, runs: NDArray[np.int64] | None = None) -> Branch:
        """Return independent copies of ``runs``, possibly repeated, by default of all."""
        memory = self.memory.branch(runs, len(self.steps))
        return Branch(self.task, memory, self.layout, self.position(runs))

    def branch_memory(self, runs: NDArray[np.int64]) -> Branch:
        """Return independent runs of a scheduler whose x* is known.

        The scheduler's memory does not depend on transmissions, so x* after a step is the original
        runs' x*, an argument of :meth:`Branch.step`.

        Args:
            runs: Numbers of the runs.
        """
        position = self.position(runs)
        memory = self.memory.with_best(position.state, take_runs(self.beliefs().best, runs))
        return Branch(self.task, memory, self.layout, position)

    def position(self, runs: NDArray[np.int64] | None = None) -> Position:
        """Return the state of ``runs``, possibly repeated, by default of all."""
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
        """Return new observations (N, entries) of all runs."""
        left = (self._limit - self.steps).astype(np.float64)
        network = NetworkState(self.tokens, self.admitted, self.price, left, self.queue)
        return self.layout.encode(self.state, network, self.beliefs)

    def beliefs(self) -> Beliefs:
        """Return the beliefs of the memory's owner before any transmission."""
        return self.memory.beliefs(self.state)

    def admitted(self) -> NDArray[np.bool_]:
        """Return the sensors (sensors, N) with a reading that the access rule now admits."""
        return self._mask(self._lottery())

    def grantable(self) -> NDArray[np.bool_]:
        """Return the sensors (sensors, N) whose single request the network would grant now."""
        return self.admitted() & self.task.bucket.affordable(self.tokens)

    def signals(self) -> Signals:
        """Return the signals of all runs, except those that the information mode withholds.

        The system's signals are extended by ``tokens`` (N,), ``token_cost`` (sensors, 1), ``price``
        (N,), ``step`` (N,) (steps taken), ``queue`` (sensors, N) (0 for the sensor granted least
        recently), ``start`` (N,) bool, ``admitted`` and ``grantable`` (sensors, N) bool,
        ``observation`` (N, entries), ``model`` (the system's state from :meth:`System.visible
        <fusion_gym.core.system.System.visible>`) and the beliefs (:mod:`fusion_gym.core.signals`).
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

    def _possible(self, granted: NDArray[np.bool_], spent: Array) -> NDArray[np.bool_]:
        """Return the sensors (sensors, N) whose request the network would also have granted."""
        bucket = self.task.bucket
        tokens = self.tokens if bucket.sharing == "equal" else self.tokens - spent
        possible = self.admitted() & bucket.affordable(tokens)
        return possible & ~granted.any(0) if self.task.access == "single" else possible

    def _mask(self, lottery: Array | None) -> NDArray[np.bool_]:
        admitted = access_mask(self.task.access, self.task.sensors, self.steps, lottery)
        return admitted & self.task.system.available(self.state)[0] if self._gaps else admitted

    def _lottery(self) -> Array | None:
        """Return the standard normals (N,) for random access, or ``None`` with another rule."""
        return None


class Branch(Runs):
    """Independent runs that start at a :class:`Position` and take any noise; arrays are shared."""

    def __init__(
        self, task: Task, memory: Memory, layout: ObservationLayout, position: Position
    ) -> None:
        super().__init__(task, memory, layout)
        self.state, self.tokens, self.price = position[:3]
        self.steps, self._limit, self.queue, self._admitted = position[3:]

    def step(
        self, requests: NDArray[np.bool_], noise: Array, best: Estimate | None = None
    ) -> Outcome:
        """Make both halves of a step.

        Args:
            requests: (sensors, N) bool.
            noise: Standard normals (channels, N).
            best: x* after the step, for runs of :meth:`Runs.branch_memory`.
        """
        outcome = self.deliver(requests)
        self.sense(noise)
        if best is not None:
            self.memory = self.memory.with_best(self.state, best)
        return outcome

    def sense(self, noise: Array) -> None:
        """Make the second half of a step with noise (channels, N)."""
        super().sense(noise)
        self._admitted = self._mask(noise[-1] if self.task.access == "random" else None)

    def admitted(self) -> NDArray[np.bool_]:
        """Return the sensors (sensors, N) with a reading that the access rule now admits."""
        return self._admitted
