"""References that schedule vector sources by the ages of their deliveries."""

from __future__ import annotations

import pickle
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.core.task import Task
from fusion_gym.policies.base import (
    PRICE,
    Requests,
    Stateless,
    check_at_most,
    check_price,
    strongest,
)
from fusion_gym.solvers.ages import AgeSolution, AgeSource, age_index, age_sources, solve_ages

_index_of: dict[bytes, Array] = {}  # by source
_optimum_of: dict[bytes, AgeSolution] = {}  # by sources and limit


def _limit(task: Task, at_most: int | None) -> int | None:
    """Return the most requests in a step, by default those that the access rule grants."""
    check_at_most("at_most", at_most)
    return task.network.slots if at_most is None and task.network.rule.limited else at_most


def _places(source: AgeSource, age: Array) -> NDArray[np.int64]:
    return np.clip(age, 1, len(source.costs) - 1).astype(np.int64) - 1


class AgeIndex(Stateless):
    r"""Request the vector sources whose Whittle index by age and channel reaches the price.

    Args:
        task: the task; a text cannot set it.
        price: p >= 0 of a token; None for the task's own.
        at_most: most requests in a step, by the highest index; None for the grants of the access
            rule.
        longest: largest age of the tables; larger ages have its index.
        myopic: whether the index is the expected reduction of the trace in this step.

    Raises:
        ConfigurationError: another plant than vector sources, or a source without an index.

    Equation:
        $$
        \lambda_i(a,s)=\inf\{\lambda:\text{silence is optimal at age } a\},\qquad
        \delta_i(t)=1\Rightarrow\lambda_i(a_i,s_i)/c_i\ge p
        $$

        a are the steps since the last delivery, s the channel's last state, c the tokens of a
        transmission, which the sensor must have, p is ``price``; at most ``at_most`` sources, by
        the highest index. With ``access="assignment"`` every pair of sensor and channel has an
        index, and the highest ones are assigned first.

    Assumes: a model that is true. The index uses no measurement.

    Source: P. Whittle, "Restless bandits: activity allocation in a changing world", Journal of
    Applied Probability 25A, 1988.

    Example: ``age_index:price=5`` in ``fusion_gym/RemoteEstimation-v1 sources=6/0 access=slots
    slots=2``.
    """

    knowledge: ClassVar[Knowledge] = "centre"

    search = PRICE

    def __init__(
        self,
        task: Task,
        price: float | None = None,
        at_most: int | None = None,
        longest: int = 40,
        myopic: bool = False,
    ) -> None:
        validation.integer("longest", longest, at_least=2, at_most=200)
        check_price("price", price)
        fixed = task.reward.price.fixed if price is None else price
        self.price = validation.number("price", fixed, at_least=0.0)
        self._at_most, self._cost = _limit(task, at_most), task.network.bucket.cost
        self._by_channel = task.network.rule.by_channel
        self._sources = age_sources(task, longest)
        self.tables: list[Array] = []
        for source in self._sources:
            parts = source.costs, source.drop, source.transition
            key = pickle.dumps((parts, myopic))
            if key not in _index_of:
                saved = (source.costs[1:] - source.costs[0])[:, None]
                arrival = source.transition @ (1.0 - source.drop)
                _index_of[key] = saved * arrival if myopic else age_index(*parts)
            self.tables.append(_index_of[key])

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N), numbers of channels with an assignment."""
        age, channel = signals["age"], signals["channel_state"]
        links = len(self.tables) // len(age)
        states = channel.reshape(len(self.tables), -1)
        parts = zip(self._sources, self.tables, age.repeat(links, axis=0), states, strict=True)
        index = np.stack([table[_places(source, a), s] for source, table, a, s in parts])
        grantable = signals["grantable"].repeat(links, axis=0)
        worth = grantable & (index >= self.price * self._cost.repeat(links, axis=0))
        if not self._by_channel:
            return strongest(index, worth, self._at_most, age)
        shape = (len(age), links, age.shape[-1])
        return _assign(np.where(worth, index, -np.inf).reshape(shape), self._at_most)


def _assign(index: Array, at_most: int | None) -> Any:
    """Return requests (sensors, N), by the highest index (sensors, channels, N) left each time."""
    sensors, channels, runs = index.shape
    requests, every = np.zeros((sensors, runs), dtype=np.int64), np.arange(runs)
    for _ in range(min(channels, sensors, at_most or channels)):
        sensor, channel = np.divmod(index.reshape(-1, runs).argmax(0), channels)
        worth = np.isfinite(index[sensor, channel, every])
        requests[sensor[worth], every[worth]] = channel[worth] + 1
        index[sensor, :, every], index[:, channel, every] = -np.inf, -np.inf
    return requests


class AgeOptimum(Stateless):
    r"""Request by the optimum of few vector sources among the policies of ages and channels.

    Args:
        task: the task; a text cannot set it.
        at_most: most requests in a step; None for the grants of the access rule.
        longest: largest age; larger ages are treated as equal to it.

    Raises:
        ConfigurationError: another plant than vector sources, limited tokens, or more than 300,000
            states.

    Equation:
        $$
        g+h(a,s)=\min_{|D|\le q}\mathrm{E}\left[\sum_i c_i(a_i^+)+p\,|D|+h(a',s')\right]
        $$

        D is the set of requests, at most q (``at_most``); c_i are the weighted traces at the ages
        a⁺ after the decision, p is the price, h the relative values of ages a and channel states s.

    Assumes: a model that is true, an infinite horizon, and that no measurement is used.

    Source: A. S. Leong, A. Ramaswamy, D. E. Quevedo, H. Karl and L. Shi, "Deep reinforcement
    learning for wireless sensor scheduling in cyber-physical systems", Automatica 113, 2020.

    Example: ``age_optimum:longest=20`` in ``fusion_gym/RemoteEstimation-v1 sources=2/0
    access=slots``.
    """

    knowledge: ClassVar[Knowledge] = "centre"

    def __init__(self, task: Task, at_most: int | None = None, longest: int = 40) -> None:
        validation.integer("longest", longest, at_least=2, at_most=200)
        if not task.network.bucket.unlimited:
            where = "for the optimum by ages"
            raise validation.refusal("tokens", "limited", "'unlimited'", where)
        if task.network.rule.by_channel:
            raise validation.refusal("access", "assignment", "'slots'", "for the optimum by ages")
        limit, self._sources = _limit(task, at_most), age_sources(task, longest)
        key = pickle.dumps((self._sources, limit))
        if key not in _optimum_of:
            _optimum_of[key] = solve_ages(self._sources, limit)
        self.solution = _optimum_of[key]

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        place: list[NDArray[np.int64]] = []
        rows = zip(self._sources, signals["age"], signals["channel_state"], strict=True)
        for source, age, state in rows:
            place += [_places(source, age), state]
        chosen = self.solution.choice[tuple(place)]
        requests: Requests = (chosen >> np.arange(len(self._sources))[:, None] & 1) == 1
        return requests
