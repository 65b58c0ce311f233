"""N runs of a task at one time, and the two halves of a step.

Both halves make new arrays and change none, so runs can branch on other noise.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array, merge_runs, take_runs, value_of
from fusion_gym.core.access import discrepancy, place_of
from fusion_gym.core.control import control_of, inputs_of, over_of
from fusion_gym.core.estimator import Reception
from fusion_gym.core.knowledge import Signals
from fusion_gym.core.memory import Beliefs, Estimate, Memory
from fusion_gym.core.network import Delivery, NetworkState
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.task import Task
from fusion_gym.core.token_bucket import Grants
from fusion_gym.errors import ConfigurationError
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
        arrived: (sensors, N) bool, whether a packet arrives before the next decision. A packet
            without a delay counts in this step's error, a late one in the next step's.
        error: Truth minus fused estimate (n, N).
        squared_error: (n, N).
        diverged: (N,) bool, whether a squared error is not finite or exceeds the task's
            ``divergence_level``.
        ended: (N,) bool, whether the episode is over.
        age: Age of information (sensors, N): steps since the measurement of the newest packet that
            counts in this step's error.
        incorrect_age: Age of incorrect information (N,): steps since the weighted squared error
            was last at most 1.
        control_cost: Cost of state and input (N,), with a controller.
        control: Input (k, N) that acts until the next sensing, with a controller.
        terminated: (N,) bool, whether the controller ends the episode, for one that may.
    """

    reward: Array
    reward_error: Array
    reward_communication: Array
    cost: Array
    requested: NDArray[np.bool_]
    granted: NDArray[np.bool_]
    arrived: NDArray[np.bool_]
    error: Array
    squared_error: Array
    diverged: NDArray[np.bool_]
    ended: NDArray[np.bool_]
    age: Array
    incorrect_age: Array
    control_cost: Array | None = None
    control: Array | None = None
    terminated: NDArray[np.bool_] | None = None

    def single(self, run: int) -> Outcome:
        """Return the outcome of one run, without the batch axis."""
        return Outcome._make(None if part is None else part.T[run].copy() for part in self)


class State(NamedTuple):
    """The states of plant, estimator and network of N runs after sensing.

    Attributes:
        plant: The plant's state.
        estimate: The estimator's state after observing.
        network: The network's state before the requests.
        age: Age of information (sensors, N) after the last delivery.
        incorrect_age: Age of incorrect information (N,) after it.
        supposed: The estimator's state by the packets that the sensors suppose to have arrived;
            ``None`` if they know.
        history: For late packets, the estimator's state before the update, the measurements, the
            arrivals (sensors, N) and the input of the last steps, oldest first.
        known: States (n, N) whose truth is known, for the error; ``None`` is all.
        control: The last input (k, N), with a controller.
    """

    plant: Any
    estimate: Any
    network: NetworkState
    age: Array
    incorrect_age: Array
    supposed: Any = None
    history: tuple[tuple[Any, Array, NDArray[np.bool_], Array | None], ...] = ()
    known: NDArray[np.bool_] | None = None
    control: Array | None = None


class Position(NamedTuple):
    """N runs at one time, after sensing.

    Attributes:
        state: The states of plant, estimator and network.
        price: Price of a token (N,).
        steps: Steps taken (N,).
        limit: Step at which the episode ends (N,).
    """

    state: State
    price: Array
    steps: NDArray[np.int64]
    limit: NDArray[np.int64]


class Runs:
    """N runs of a :class:`~fusion_gym.core.task.Task` at one time, after sensing.

    Args:
        task: The task.
        memory: Memory, which moves with the runs.
        layout: Layout of the observation.

    Attributes:
        price: Price of a token (N,).
        steps: Steps taken (N,).
        limit: Step at which the episode ends (N,).
    """

    price: Array
    steps: NDArray[np.int64]
    limit: NDArray[np.int64]

    def __init__(self, task: Task, memory: Memory, layout: ObservationLayout) -> None:
        self.task, self.memory, self.layout = task, memory, layout
        self._delivered: Any = None

    @property
    def state(self) -> State:
        """The states of plant, estimator and network after sensing."""
        state: State = value_of(self._state)
        return state

    @state.setter
    def state(self, state: State | None) -> None:
        self._state: Any = state

    @property
    def delivered(self) -> State:
        """The states after the last delivery, for metrics and figures."""
        delivered: State = value_of(self._delivered)
        return delivered

    @property
    def tokens(self) -> Array:
        """Tokens (N,) of all buckets."""
        return self.state.network.total

    @property
    def channels(self) -> int:
        """Number of standard normals of a step: the plant's, then the network's."""
        return self.task.plant.noise_channels + self.task.network.noise_channels

    def deliver(self, requests: NDArray[Any]) -> Outcome:
        """Make the first half of a step with requests (sensors, N): grant, update, fuse, reward."""
        task, state, requested = self.task, self.state, requests > 0
        silence = task.estimator.reads_silence
        network, delivery = task.network.deliver(state.network, requests, silence)
        after = receive(task, state, network, delivery, self.beliefs)
        self.memory.update(self.beliefs, delivery.known)
        estimator, estimate, spent = task.estimator, after.estimate, delivery.spent
        truth = task.plant.truth(state.plant)
        error, over = truth - estimator.mean(estimate), over_of(task, state.plant)
        if state.known is not None:
            error = np.where(state.known, error, 0.0)
        if over is not None:  # a run that ended before has no errors
            error = np.where(over & (self.steps >= self.limit), 0.0, error)
        covariance, square = estimator.covariance(estimate), error * error
        error_term, token_term = task.reward.terms(error, covariance, spent, self.price)
        arrived, late = delivery.reception.arrived, task.network.late(network)
        arrived = arrived if late is None else arrived | late.any(0)
        age = namespace(error).where(delivery.reception.arrived, 0.0, state.age + 1.0)
        correct = linalg.weighted_square(error, task.reward.state_weights) <= 1.0
        incorrect_age = namespace(error).where(correct, 0.0, state.incorrect_age + 1.0)
        self._delivered = after._replace(age=_with_late(age, late), incorrect_age=incorrect_age)
        diverged = namespace(square).logical_not(square <= task.divergence_level).any(0)
        self.steps = self.steps + 1
        error_term, cost = self._close_loop(error_term, state.plant, after.control, over)
        flags, total = (requested, delivery.granted, arrived), error_term + token_term
        terms = total, error_term, token_term, spent
        ends: Any = diverged, self.steps >= self.limit, age, incorrect_age
        last: Any = cost, after.control, over
        return Outcome(*terms, *flags, error, square, *ends, *last)

    def _close_loop(
        self, error_term: Array, plant: Any, control: Array | None, over: Any
    ) -> tuple[Array, Array | None]:
        """Return the error term (N,) and the cost of state and input; an end charges what is left.

        Args:
            error_term: Error term (N,) of the estimation.
            plant: State of the plant.
            control: Input (k, N), with a controller.
            over: Runs (N,) that the controller ends.
        """
        controller, task, last = self.task.controller, self.task, self.steps >= self.limit
        if controller is None or control is None:
            return error_term, None
        cost, end = controller.cost(plant, control), controller.terminal_cost(plant)
        if end is not None:
            cost = cost + namespace(cost).where(last, end, 0.0)
        if over is not None:
            left = np.where(over, np.maximum(1 + self.limit - self.steps, 0), 1)
            self.limit = np.where(over, np.minimum(self.limit, self.steps), self.limit)
            later: Any = cost if (each := controller.forfeit(plant)) is None else each
            error_term = np.where(left, left * error_term, 0.0)
            cost = np.where(left, cost + (left - 1) * later, 0.0)
        if task.objective == "control":
            error_term = task.reward.control_term(cost)
        return error_term, cost

    def answer(
        self, requests: NDArray[Any], runs: NDArray[np.int64] | slice = slice(None)
    ) -> Grants:
        """Return the grants for requests (sensors, R) of the R ``runs``."""
        return self.task.network.grant(self.state.network, requests, runs)

    def sense(self, noise: Array) -> None:
        """Make the second half of a step: move plant and network, measure, predict and observe.

        Args:
            noise: Standard normals (channels, N).
        """
        state = advance(self.task, settle(self.task, self.delivered), noise, self.steps)
        self.memory.observe(self.task.plant.measurement(state.plant), state.control)
        self.state = state

    def branch(self, runs: NDArray[np.int64] | None = None) -> Branch:
        """Return independent copies of ``runs``, possibly repeated, by default of all."""
        if not self.task.plant.branches:
            name = type(self.task.plant).__name__
            raise ConfigurationError(f"{name} is not allowed here: its states cannot branch")
        memory = self.memory.branch(runs, len(self.steps))
        return Branch(self.task, memory, self.layout, self.position(runs))

    def branch_memory(self, runs: NDArray[np.int64]) -> Branch:
        """Return independent runs of a scheduler whose x* is known.

        The scheduler's memory does not depend on transmissions without a controller, so x* after a
        step is the original runs' x*, an argument of :meth:`Branch.step`.

        Args:
            runs: Numbers of the runs.
        """
        branch = Branch(self.task, self.memory.with_states({}), self.layout, self.position(runs))
        branch.set_best(take_runs(self.beliefs().best, runs))
        return branch

    def position(self, runs: NDArray[np.int64] | None = None) -> Position:
        """Return the states of ``runs``, possibly repeated, by default of all."""
        whole = Position(self.state, self.price, self.steps, self.limit)
        if runs is None:
            return whole._replace(steps=self.steps.copy(), limit=self.limit.copy())
        result: Position = take_runs(whole, runs)
        return result

    def observe(self, local: bool = False) -> NDArray[np.float32]:
        """Return new observations (N, entries), with ``local`` by what the sensors suppose."""
        return self.layout.encode(self, self.known_to(local))

    def known_to(self, local: bool) -> Any:
        """Return the estimator's state that the scheduler or, with ``local``, the sensors know."""
        supposed = self.state.supposed if local else None
        return self.state.estimate if supposed is None else supposed

    def beliefs(self) -> Beliefs:
        """Return the beliefs of the memory's owner before any transmission."""
        return self.memory.beliefs(self.state.estimate, self.arrival_probability())

    def arrival_probability(self, late: bool = False) -> Array | None:
        """Return the probability (sensors, N) that a packet sent now arrives, now or also late.

        ``None`` is 1.
        """
        links = self.task.network.link_probability(self.state.network, late)
        return None if links is None else links.max(1)

    def admitted(self) -> NDArray[np.bool_]:
        """Return the sensors (sensors, N) with a reading that the access rule now admits."""
        return self.state.network.admitted

    def channel_state(self) -> NDArray[np.int64]:
        """Return the signal ``channel_state``, 0 without states."""
        known, network = self.state.network.channel, self.task.network
        channels = (network.slots,) if network.rule.by_channel else ()
        shape = (network.sensors, *channels, len(self.steps))
        return np.zeros(shape, dtype=np.int64) if known is None else known.reshape(shape)

    def _known_links(self) -> Array:
        """Return the probability (sensors, channels, N) that a packet sent now arrives."""
        links, state = self.task.network.link_probability(self.state.network), self.channel_state()
        known = np.ones(state.shape) if links is None else links
        return known.reshape(len(state), -1, state.shape[-1])

    def grantable(self) -> NDArray[np.bool_]:
        """Return the sensors (sensors, N) whose single request the network would grant now."""
        return self.admitted() & self.task.network.bucket.affordable(self.state.network.tokens)

    def read(self, local: bool = False, late: bool = False) -> dict[str, Any]:
        """Return the estimator's signals, with the probability of an arrival, now or also late."""
        arrival = self.arrival_probability(late)
        failure = None if arrival is None else 1.0 - arrival
        values = dict(self.task.estimator.read(self.known_to(local), failure))
        reduction: Any = values.get("variance_reduction")
        if arrival is not None and reduction is not None:
            values |= {
                "variance_reduction": lambda: (
                    arrival * (reduction() if callable(reduction) else reduction)
                )
            }
        return values

    def _variance_order(self, local: bool) -> Any:
        order = self.read(local, late=True)["variance_reduction"]
        return order() if callable(order) else order

    def signals(self) -> Signals:
        """Return the signals of all runs, except those that the information mode withholds.

        The estimator's signals are extended by ``tokens`` (N,) of all buckets, ``energy``
        (sensors, N), which pays for each sensor's packets, ``token_cost`` (sensors, 1),
        ``price`` (N,), ``step`` (N,) (steps taken), ``queue`` (sensors, N) (0 for the sensor
        granted least recently), ``start`` (N,) bool, ``admitted`` and ``grantable`` (sensors, N)
        bool, ``observation`` (N, entries), ``estimate`` (the estimator's state), with a controller
        its last input ``control`` (k, N), with a range of rates ``token_rate`` (N,), and the
        channels and beliefs of :mod:`fusion_gym.core.knowledge`. Policies of single sensors read
        what these suppose.
        """
        nodes = None if self.state.supposed is None else self._signals(local=True)
        return self._signals(nodes=nodes)

    def _signals(self, local: bool = False, nodes: Signals | None = None) -> Signals:
        network, values = self.state.network, self.read(local)
        values |= {
            "tokens": network.total,
            "energy": lambda: network.energy,
            "token_cost": self.task.network.bucket.cost,
            "price": self.price,
            "step": self.steps,
            "queue": network.queue,
            "start": self.steps == 0,
            "admitted": self.admitted,
            "grantable": self.grantable,
            "channel_state": self.channel_state,
            "arrival_probability": lambda: self._known_links().max(1),
            "link_probability": self._known_links,
            "observation": functools.partial(self.observe, local),
            "estimate": self.state.estimate,
        }
        if "variance_reduction" in values:
            values |= {"variance_order": functools.partial(self._variance_order, local)}
        values |= {} if self.state.control is None else {"control": self.state.control}
        values |= {} if network.token_rate is None else {"token_rate": network.token_rate}
        values |= self.memory.signals(self.beliefs)
        return Signals(values, self.task.hidden_signals, self.memory.missing_signals, nodes)


class Branch(Runs):
    """Independent runs that start at a :class:`Position` and take any noise; arrays are shared."""

    def __init__(
        self, task: Task, memory: Memory, layout: ObservationLayout, position: Position
    ) -> None:
        super().__init__(task, memory, layout)
        self.state, self.price, self.steps, self.limit = position

    def step(self, requests: NDArray[Any], noise: Array, best: Estimate | None = None) -> Outcome:
        """Make both halves of a step.

        Args:
            requests: (sensors, N) bool, or with an assignment channels from 1, 0 for none.
            noise: Standard normals (channels, N).
            best: x* after the step, for runs of :meth:`Runs.branch_memory`.
        """
        outcome = self.deliver(requests)
        self.sense(noise)
        if best is not None:
            self.set_best(best)
        return outcome

    def set_best(self, best: Estimate) -> None:
        """Set a known x* of the present time."""
        arrival = self.arrival_probability()
        self.memory = self.memory.with_best(self.state.estimate, arrival, best)


def start_of(task: Task, noise: Array) -> tuple[State, Any]:
    """Return the states at time 0, and what the plant announces.

    Args:
        task: The task.
        noise: Standard normals of the starts of plant and network.
    """
    own = task.plant.start_channels
    plant, announcement = task.plant.start(noise[:own])
    estimate = task.estimator.start(task.plant.measurement(plant), announcement)
    supposed = None if task.network.acknowledgement == 1.0 else estimate
    network, runs = task.network.start(noise[own:]), noise.shape[1]
    state = State(
        plant, estimate, network, np.zeros((task.sensors, runs)), np.zeros(runs), supposed
    )
    return state._replace(control=control_of(task, plant, estimate)), announcement


def advance(task: Task, state: State, noise: Array, steps: NDArray[np.int64]) -> State:
    """Return the states after the next sensing.

    Args:
        task: The task.
        state: States after a delivery, or at time 0.
        noise: Standard normals (channels, N).
        steps: Steps taken (N,).
    """
    own, moving, filters = task.plant.noise_channels, inputs_of(state.control), task.estimator
    plant = task.plant.sense(state.plant, noise[:own], *moving)
    estimate, supposed = (
        known
        if known is None
        else filters.observe(filters.predict(known, *moving), task.plant.measurement(plant))
        for known in (state.estimate, state.supposed)
    )
    readings, known = task.plant.available(plant) or (None, None)
    network = task.network.advance(state.network, noise[own:], steps, readings)
    network = rank_requests(task, network, estimate if supposed is None else supposed)
    moved = state._replace(plant=plant, estimate=estimate, network=network, supposed=supposed)
    return moved._replace(known=known)


def rank_requests(task: Task, state: NetworkState, known: Any) -> NetworkState:
    """Return the network's state with the order of discrepancies, if the access rule needs it."""
    if not task.network.rule.by_discrepancy:
        return state
    size = discrepancy(task.estimator.read(known), task.options.discrepancy)
    return replace(state, place=place_of(task.network.weights * size, state.queue))


def receive(
    task: Task,
    state: State,
    network: NetworkState,
    delivery: Delivery,
    beliefs: Callable[[], Beliefs],
) -> State:
    """Return the states after the packets that arrive at once, and what the sensors suppose.

    Args:
        task: The task.
        state: States before the requests.
        network: The network's state after them.
        delivery: The network's response.
        beliefs: Function that returns the beliefs before the transmission.
    """
    estimator, arrived, history = task.estimator, delivery.reception.arrived, state.history
    estimate, supposed = estimator.update(state.estimate, delivery.reception), state.supposed
    if delivery.supposed is not None:
        supposed = estimator.update(supposed, Reception(delivery.supposed))
    if task.options.packet == "estimate":
        best, spread = beliefs().best
        estimate = estimator.adopt(estimate, best[0], spread[0], np.asarray(arrived.any(0)))
    control = control_of(task, state.plant, estimate)
    if task.delayed:
        last = state.estimate, task.plant.measurement(state.plant), arrived, control
        history = (*history, last)[-task.network.longest_delay :]
    after = state._replace(estimate=estimate, network=network, supposed=supposed)
    return after._replace(history=history, control=control)


def _with_late(age: Array, late: NDArray[np.bool_] | None) -> Array:
    """Return the ages (sensors, N) with packets of 1, …, D steps back that arrive next (D, …)."""
    if late is None:
        return age
    steps, xp = np.arange(float(len(late)))[:, None, None], namespace(age, late)
    result: Array = xp.minimum(age, xp.where(late, steps, np.inf).min(0))
    return result


def settle(task: Task, state: State) -> State:
    """Return the states after late packets, by new updates from the step of the oldest one on.

    Args:
        task: The task.
        state: States after a delivery.
    """
    late = task.network.late(state.network)
    if late is None or not late.any():
        return state
    oldest = late.any(1).cumsum(0).argmax(0) + 1  # the last step back at which the count rises
    every, estimator = late.any((0, 1)), task.estimator
    for back in range(1, len(late) + 1):
        runs = np.flatnonzero(every & (oldest == back))
        if not runs.size:
            continue
        parts, estimate, acted = take_runs(state.history[-back:], runs), None, None
        history = []
        for steps, part in zip(range(back, 0, -1), parts, strict=True):
            before, measurement, arrived, control = part
            if estimate is not None:
                moved = estimator.predict(estimate, *inputs_of(acted))
                before = estimator.observe(moved, measurement)
            arrived = arrived | late[steps - 1][:, runs]
            estimate, acted = estimator.update(before, Reception(arrived)), control
            history.append((before, measurement, arrived, control))
        settled = merge_runs(state.history[-back:], tuple(history), runs)
        state = state._replace(
            estimate=merge_runs(state.estimate, estimate, runs),
            history=state.history[:-back] + settled,
        )
    return state
