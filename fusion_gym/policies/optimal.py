"""The solved optimum of remote estimation as a policy, and Whittle's index of its sources."""

import pickle
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.core.task import Task
from fusion_gym.policies.base import PRICE, Requests, Stateless, check_at_most, strongest
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
        """The class of a sensor with thresholds, and of a scheduler with a table of two sources."""
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
    if key not in _cache:
        _cache[key] = _solved(number, problem)
    return _cache[key]


def _solved(number: int, problem: SourceProblem) -> tuple[Array, Array]:
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
