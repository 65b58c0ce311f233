"""Optimal schedules of several sources by their ages, without use of the errors."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.channel import Channel, ChannelOptions
from fusion_gym.core.task import Task
from fusion_gym.solvers.single import iterate_values
from fusion_gym.systems.solvable import AgedSources
from fusion_gym.validation import ConfigurationError

_LAZINESS = 0.3  # weight of the old value, because optimal schedules are periodic
_MOST_STATES = 300_000
_TOLERANCE, _ITERATIONS = 1e-8, 100_000
_PRICES, _SECANTS = 64, 8  # of the index: prices in equal ratios, then refinements
_LONGEST, _BEYOND = 40, 200  # ages of the tables, and of their growth


@dataclass(frozen=True)
class AgeSource:
    """A source whose error has a known cost at each age of its last delivery.

    ``costs`` (K + 1,), of the ages 0 to K after the decision, rising; age K stands for all larger
    ages · ``price`` of a transmission · ``drop`` (S,) and ``transition`` (S, S) of the channel ·
    ``growth``, the largest ratio of two successive increments of the costs from age K on.
    """

    costs: Array
    price: float
    drop: Array
    transition: Array
    growth: float


def age_sources(task: Task, longest: int = _LONGEST) -> tuple[AgeSource, ...]:
    """Return the vector sources of a task, with the weighted traces as costs.

    With an assignment of k channels each source is there k times, once for each of its channels.

    Args:
        task: the task.
        longest: largest age K.

    Raises:
        ConfigurationError: another plant, or an infinite cost of a source that always transmits.

    Example:
        >>> from fusion_gym import make_task
        >>> from fusion_gym.solvers import age_sources
        >>> options = {"sources": (2, 0), "access": "slots"}
        >>> len(age_sources(make_task("fusion_gym/RemoteEstimation-v1", **options)))
        2
    """
    model, network = task.plant, task.network
    if not isinstance(model, AgedSources):
        raise validation.refusal("sources", None, "vector sources", "for costs by age")
    task.refuse_control("for costs by age")
    channel = network.channel or Channel(ChannelOptions(), task.sensors)
    weights = task.reward.error_weight * task.reward.separate_weights("here")[:, None]
    costs = model.age_costs(weights, longest + _BEYOND)
    links = network.slots if network.rule.by_channel else 1
    every = [own for own in costs.T for _ in range(links)]
    price = (task.reward.price.fixed or 0.0) * network.bucket.cost[:, 0]
    for place, growth in enumerate(np.square(model.radii)):
        own = channel.drop[:, links * place : links * (place + 1)].min(1)  # of the best channel
        loss = np.abs(np.linalg.eigvals(channel.transition[links * place] * own)).max()
        if growth * loss >= 1.0:
            raise ConfigurationError(
                f"sources[{place}] with this channel is not allowed: the cost of permanent "
                f"transmissions is infinite (growth {growth:.4g} times loss {loss:.4g} is >= 1)"
            )
    ends, more = longest + 1, longest - 1
    parts = zip(every, price.repeat(links), channel.drop.T, channel.transition, strict=True)
    return tuple(
        AgeSource(own[:ends], float(cost), drop, transition, _growth(own[more:]))
        for own, cost, drop, transition in parts
    )


def _growth(costs: Array) -> float:
    steps = np.diff(costs)
    return float(np.max(steps[1:] / np.maximum(steps[:-1], 1e-300)))


@dataclass(frozen=True)
class AgeSolution:
    """The least average cost per step of policies of all ages, between ``lower`` and ``upper``.

    ``upper`` is infinite for more than two sources, and for two that may transmit together.
    ``cost`` is that with ages up to K. ``choice`` is the set of sources to transmit, as bits, by
    each source's age 1 to K and last channel state, (K, S, K, S, …).
    """

    cost: float
    lower: float
    upper: float
    choice: NDArray[np.int64]


def solve_ages(sources: tuple[AgeSource, ...], at_most: int | None = None) -> AgeSolution:
    """Return the least average cost of policies that use only ages and channel states.

    The method is relative value iteration.

    Args:
        sources: the sources, whose channels are independent.
        at_most: largest number of transmissions in a step; None for no limit.

    Raises:
        ConfigurationError: more than 300,000 states or sets of sources, or no convergence.

    Example:
        >>> from fusion_gym import make_task
        >>> from fusion_gym.solvers import age_sources, solve_ages
        >>> options = {"sources": (2, 0), "access": "slots"}
        >>> task = make_task("fusion_gym/RemoteEstimation-v1", **options)
        >>> f"{solve_ages(age_sources(task, longest=20), at_most=1).cost:.2f}"
        '14.85'
    """
    count = len(sources)
    limit = count if at_most is None else validation.integer("at_most", at_most, at_least=1)
    shape = tuple(size for source in sources for size in (len(source.costs) - 1, len(source.drop)))
    if max(float(np.prod(shape, dtype=float)), 2.0**count) > _MOST_STATES:
        raise ConfigurationError(
            f"ages up to {shape[0]} are not allowed with {count} sources: the number of states, "
            f"and the number 2^{count} of sets of sources, must be at most {_MOST_STATES}"
        )
    sets = [s for s in range(2**count) if s.bit_count() <= limit]

    def decide(value: Array, more: Array | float = 0.0) -> tuple[Array, NDArray[np.int64]]:
        options = []
        for chosen in sets:
            ahead = value
            for place, source in enumerate(sources):
                ahead = _moved(source, ahead, 2 * place, bool(chosen >> place & 1))
            options.append(ahead)
        every = np.stack(options) + more
        return every.min(0), every.argmin(0)

    lower, upper, best = iterate_values(decide, shape, _TOLERANCE, _ITERATIONS, _LAZINESS)
    more = _excess(sources, sets) if limit == 1 else None
    cost, upper = 0.5 * (lower + upper), math.inf
    if more is not None:
        _, upper, _ = iterate_values(
            lambda value: decide(value, more), shape, _TOLERANCE, _ITERATIONS, _LAZINESS
        )
    return AgeSolution(cost, lower, upper, np.array(sets)[best])


def _excess(sources: tuple[AgeSource, ...], sets: list[int]) -> Array | None:
    """Return costs (sets, …) at age K that make the least average cost an upper bound.

    Sources of age K and more transmit, the first one first. With the excess x = c(k) - c(K) of a
    cost, b x then bounds what ages above K add to the cost of the future, where the first source
    is below age K, and B x where it is not. Of more than two sources there is no bound.
    """
    if len(sources) > 2:
        return None
    loss = [float((source.transition @ source.drop).max()) for source in sources]
    growth = [source.growth for source in sources]
    step = [s.growth * float(s.costs[-1] - s.costs[-2]) for s in sources]  # of the next age
    rest = 1.0 - loss[0] * growth[0]
    result = np.zeros((len(sets), *(n for s in sources for n in (len(s.costs) - 1, len(s.drop)))))
    for chosen, more in zip(sets, result, strict=True):
        more[-1] = loss[0] ** 2 / rest * step[0] if chosen == 1 and rest > 0.0 else math.inf
    if len(sources) == 2:
        arrival = (1.0 - loss[0]) * loss[1] * growth[1]
        rest = 1.0 - growth[1] * (loss[0] + arrival)
        above = (1.0 + arrival) / rest if rest > 0.0 else math.inf
        for chosen, more in zip(sets, result, strict=True):
            more[:-1, :, -1] += loss[1] * above * step[1] if chosen == 2 else math.inf
            more[-1, :, -1] += above * step[1]
    return result


def _moved(source: AgeSource, value: Array, axis: int, sent: bool) -> Array:
    """Return cost and expected value as one source moves, whose age and channel have two axes."""
    last = np.moveaxis(value, (axis, axis + 1), (-2, -1))
    older = np.minimum(np.arange(1, last.shape[-2] + 1), last.shape[-2] - 1)
    result = source.costs[1:, None] + last[..., older, :]
    if sent:
        fresh = source.costs[0] + last[..., :1, :]
        result = source.price + (1.0 - source.drop) * fresh + source.drop * result
    return np.moveaxis(result @ source.transition.T, (-2, -1), (axis, axis + 1))


def age_index(costs: Array, drop: Array, transition: Array) -> Array:
    """Return the Whittle index (K, S) of a transmission, by age and last channel state.

    It is the price at which transmission and silence cost a single source the same in the long run.
    Age K stands for all larger ages.

    Args:
        costs: Error costs (K + 1,) of the ages 0 to K after the decision, rising.
        drop: Loss probabilities (S,) < 1 of the channel's states.
        transition: (S, S), from the last channel state (row) to the next.

    Raises:
        ConfigurationError: The advantage of a transmission does not fall with the price, or no
            convergence.

    Source: P. Whittle, "Restless bandits: activity allocation in a changing world", Journal of
    Applied Probability 25A, 1988.
    """
    # A transmission saves at least a part of one step, at most the cost of the whole silence.
    least, most = costs[1] - costs[0], (costs - costs[0]).sum()
    arrival = 1.0 - float(drop.max())
    prices = np.geomspace(0.5 * least * arrival, 2.0 * most / arrival, _PRICES)
    advantage = _advantage(prices, costs, drop, transition)
    if (np.diff((advantage > 0.0).astype(int), axis=0) > 0).any():
        raise ConfigurationError("this source has no index: its advantage must fall with the price")
    ages, states = np.indices(advantage.shape[1:])
    last = np.clip((advantage > 0.0).sum(0), 1, len(prices) - 1)
    low, high = prices[last - 1], prices[last]
    below, above = advantage[last - 1, ages, states], advantage[last, ages, states]
    for _ in range(_SECANTS):
        share = np.clip(below / np.maximum(below - above, 1e-300), 0.02, 0.98)
        middle = low + share * (high - low)
        own = _advantage(middle.ravel(), costs, drop, transition)
        value = own[np.arange(middle.size), ages.ravel(), states.ravel()].reshape(middle.shape)
        low, below = np.where(value > 0.0, middle, low), np.where(value > 0.0, value, below)
        high, above = np.where(value > 0.0, high, middle), np.where(value > 0.0, above, value)
    return low + below / np.maximum(below - above, 1e-300) * (high - low)


def _advantage(prices: Array, costs: Array, drop: Array, transition: Array) -> Array:
    """Return the advantage (P, K, S) of a transmission at prices (P,), by policy iteration."""
    size, states = len(costs) - 1, len(drop)
    older = np.eye(size)[np.minimum(np.arange(1, size + 1), size - 1)]
    first = np.eye(size)[np.zeros(size, dtype=np.int64)]
    silent = np.kron(older, transition)
    sent = np.kron(older, transition * drop) + np.kron(first, transition * (1.0 - drop))
    stay = np.repeat(costs[1:], states)
    lost = np.tile(transition @ drop, size)
    cost = (1.0 - lost) * costs[0] + lost * stay  # of a transmission, without its price
    send = np.ones((len(prices), size * states), dtype=np.bool_)
    for _ in range(_ITERATIONS):
        chain = np.eye(size * states) - np.where(send[..., None], sent, silent)
        chain[..., 0] = 1.0  # in place of the first relative value, 0, the average cost
        value = np.linalg.solve(chain, np.where(send, cost + prices[:, None], stay)[..., None])
        value[:, 0] = 0.0
        gain = (stay - cost) + ((silent - sent) @ value)[..., 0] - prices[:, None]
        better = gain > _TOLERANCE * prices[:, None] * np.where(send, -1.0, 1.0)
        if (better == send).all():
            return gain.reshape(-1, size, states)
        send = better
    raise ConfigurationError(f"the index did not converge in {_ITERATIONS} iterations")
