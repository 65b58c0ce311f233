"""References of remote estimation: optima, and Whittle's indices of the sources.

The first solve scalar sources by their errors, the others schedule vector sources by the ages of
their deliveries.
"""

from __future__ import annotations

import pickle
from dataclasses import replace
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
from fusion_gym.solvers.single import solve_average
from fusion_gym.solvers.source import SourceProblem
from fusion_gym.solvers.task import solve_task, source_problems


class OptimalPolicy(Stateless):
    r"""Request by the optimum of the task.

    The exact optimum of an episode depends on the remaining steps, the stationary optimum does not
    (:func:`solve_task`). ``optimum`` is the solution with its cost.

    Args:
        task: the task; a text cannot set it.
        criterion: ``finite``, the optimum of an episode, or ``average``, the stationary one.
        price: p >= 0 of a token; None for the task's own.

    Raises:
        ConfigurationError: a task that is not solved here, or a negative price.

    Equation:
        $$
        V_t(e)=\min\left\{w\,e^2+\mathrm{E}\,V_{t+1}(a
        e+\nu),\ \ p+\mathrm{E}\,V_{t+1}(\nu)\right\}
        $$

        This is one source with a perfect channel, in the literature's order of events: e is the
        error without a transmission, a the source's coefficient, ν its noise, w the weight of the
        error, p the price of a transmission. The second choice is the request; it is best exactly
        where |e| is at least a threshold. The solver also has the channel's state, its losses, the
        tokens and a second source.

    Assumes: remote estimation of one or two sources, whose model is true.

    Source: J. Chakravorty and A. Mahajan, "Remote estimation over a packet-drop channel with
    Markovian state", IEEE Trans. Automatic Control 65, 2020, for one source
    (:mod:`fusion_gym.solvers`).

    Example: ``optimal`` in ``fusion_gym/RemoteEstimation-v1``.
    """

    def __init__(self, task: Task, criterion: str = "finite", price: float | None = None) -> None:
        if price is not None:
            task = task.with_options(cost_weight=price, price_range=None)
        self.optimum = solve_task(task, criterion)

    @property
    def knowledge(self) -> Knowledge:
        """A sensor's knowledge class with thresholds, a scheduler's with a table of two sources."""
        return "own" if self.optimum.threshold is not None else "scheduler"

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        optimum = self.optimum
        error = np.abs(signals["innovation"][:, 0])
        level = optimum.tokens.index(signals["tokens"])
        if optimum.threshold is not None:
            threshold = optimum.threshold
            step = np.minimum(signals["step"], len(threshold) - 1)
            sensor = np.arange(len(error))[:, None]
            return error >= threshold[step, sensor, signals["channel_state"], level]
        assert optimum.choice is not None
        assert optimum.grids is not None
        step = np.minimum(signals["step"], len(optimum.choice) - 1)
        first, two = (
            np.minimum(np.rint(e / grid.points[1]), len(grid.points) - 1).astype(np.int64)
            for e, grid in zip(error, optimum.grids, strict=True)
        )
        choice = optimum.choice[step, first, two, level]
        return (choice >> np.arange(2)[:, None] & 1).astype(np.bool_)


_PRICES = np.geomspace(0.02, 5000.0, 32)  # prices of the solved optima, in units of w σ²

# Cache of the tables by everything but the price, for sweeps.
_cache: dict[bytes, tuple[Array, Array]] = {}


def index_table(number: int, problem: SourceProblem) -> tuple[Array, Array]:
    """Return prices (P,) and the thresholds (P, S) at these prices."""
    key = pickle.dumps(replace(problem, price=0.0))
    if key in _cache:
        return _cache[key]
    if abs(problem.coefficient) > 1.0:
        raise validation.ConfigurationError(
            f"coefficient = {problem.coefficient:g} of source {number} is not allowed for the "
            "index: it must be from -1 to 1"
        )
    prices = _PRICES * problem.error_weight * problem.deviation**2
    solved = [solve_average(replace(problem, price=float(price))) for price in prices]
    thresholds = np.array([solution.threshold[:, 0] for solution in solved])
    worth = np.isfinite(thresholds).all(1)  # a stable source may never be worth a high price
    prices, thresholds = prices[worth], thresholds[worth]
    grows = bool((thresholds[1:] >= thresholds[:-1]).all())
    if not grows or not all(solution.ordered for solution in solved):
        raise validation.ConfigurationError(
            f"source {number} is not allowed for the index: its thresholds must grow with the price"
        )
    _cache[key] = prices, thresholds
    return prices, thresholds


class WhittleIndex(Stateless):
    r"""Request the sources whose Whittle index reaches the price of a transmission.

    The index of a source with error e and channel state s is the price λ at which transmission and
    silence cost its single optimum the same. If the thresholds grow with the price, the index is
    the inverse of λ ↦ k(s; λ); the thresholds are solved at 32 prices and interpolated. For one
    source and a fixed price the rule is the stationary optimum. For several sources that share a
    network it is Whittle's heuristic, which is asymptotically optimal in similar problems but not
    in general.

    At a price of zero it requests the sources of the highest index.

    Args:
        task: the task; a text cannot set it.
        price: p >= 0 of a token; None for the task's own.
        at_most: most sources requested in a step; None: one with ``access="single"``, else all.

    Raises:
        ConfigurationError: another system than remote estimation, an unstable source, or
            thresholds that do not grow with the price.

    Equation:
        $$
        \lambda_i(e)=\inf\{\lambda:\ k_i(\lambda)\ge|e|\},\qquad \delta_i(t)=1\Rightarrow
        \lambda_i(e_i)/c_i\ge p
        $$

        kᵢ(λ) is the optimal threshold of the single source i at the price λ of a transmission, for
        the channel's last state; p is ``price``, c the tokens of a transmission. With ``at_most``,
        the sources of the highest index per token.

    Assumes: independent sources with |a| <= 1, whose model is true.

    Source: P. Whittle, "Restless bandits: activity allocation in a changing world", Journal of
    Applied Probability 25A, 1988.

    Example: ``whittle:price=5`` in ``fusion_gym/RemoteEstimation-v1 sensors=2 cost_weight=5.0``.
    """

    search = PRICE

    def __init__(self, task: Task, price: float | None = None, at_most: int | None = None) -> None:
        check_at_most("at_most", at_most)
        problems = source_problems(task)
        self._at_most = 1 if at_most is None and task.options.access == "single" else at_most
        fixed = task.reward.price.fixed if price is None else price
        self.price = validation.number("price", fixed, at_least=0.0)
        self._cost = task.network.bucket.cost
        self._tables = [index_table(number, problem) for number, problem in enumerate(problems)]

    @property
    def knowledge(self) -> Knowledge:
        """The class of a sensor, or with ``at_most``, which compares sources, of a scheduler."""
        return "own" if self._at_most is None else "scheduler"

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        index = self.index(signals["innovation"][:, 0], signals["channel_state"]) / self._cost
        return strongest(index, index >= self.price, self._at_most, signals["age"])

    def index(self, error: Array, channel: NDArray[np.int64]) -> Array:
        """Return the price of a transmission (sensors, N) at which each source is indifferent.

        Args:
            error: errors of the sources (sensors, N).
            channel: channel states (sensors, N).
        """
        result = np.empty(error.shape)
        for source, (prices, thresholds) in enumerate(self._tables):
            size = np.abs(error[source])
            for state, reached in enumerate(thresholds.T):
                here = channel[source] == state
                inside = np.interp(size[here], reached, prices)
                # Outside the table the index grows as the square of the error, which is exact
                # for small errors.
                scale = np.clip(size[here], None, reached[0]) / reached[0]
                beyond = np.maximum(size[here] / reached[-1], 1.0)
                result[source, here] = inside * scale**2 * beyond**2
        return result


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
