"""The optimum of one source, and a lower bound for many sources that share tokens."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import numpy as np

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.errors import forbidden
from fusion_gym.solvers.source import ErrorGrid, SourceProblem

ChoiceT = TypeVar("ChoiceT")


def iterate_values(
    decide: Callable[[Array], tuple[Array, ChoiceT]],
    shape: tuple[int, ...],
    tolerance: float,
    iterations: int,
    laziness: float = 0.0,
) -> tuple[float, float, ChoiceT]:
    """Return bounds of the least average cost within a relative ``tolerance``, and the choice.

    Args:
        decide: function from the values of the next step to the present values and the choice.
        shape: shape of the values.
        tolerance: largest relative distance of the bounds.
        iterations: largest number of iterations.
        laziness: weight of the old values.
    """
    value, lower, upper = np.zeros(shape), 0.0, 0.0
    for _ in range(iterations):
        new, choice = decide(value)
        change = new - value
        lower, upper = float(change.min()), float(change.max())
        if upper - lower <= tolerance * max(abs(upper), 1e-300):
            return lower, upper, choice
        if laziness:
            value = value + (1.0 - laziness) * (change - change.flat[0])
        else:
            value = new - new.flat[0]
    raise validation.ConfigurationError(
        f"iterations = {iterations} are not enough: the average cost is only known to lie between "
        f"{lower:.6g} and {upper:.6g}"
    )


class Bellman:
    """One step of backward induction; functions have the shape (M, S, K).

    The axes are the absolute error before the decision, the last channel state from the feedback,
    and the token level. Beyond the grid a value grows with the error's square as its ``curvature``
    (S, K) says, and otherwise stays: there the tokens alone decide when a request is best.
    """

    def __init__(self, problem: SourceProblem, grid: ErrorGrid, discount: float = 1.0) -> None:
        self.problem, self.grid, self.discount = problem, grid, discount
        self.square = grid.points[:, None, None] ** 2
        self.error_cost = problem.error_weight * self.square
        self.shape = (len(grid.points), len(problem.drop), len(problem.tokens.level))
        self.curvature = np.zeros(self.shape[1:])

    def choices(
        self, value: Array, error_cost: Array | float, price: float, curvature: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """Return the costs (M, S, K) of silence and of a request.

        A request that the network would not grant has an infinite cost.

        Args:
            value: values of the next step (M, S, K).
            error_cost: cost of the remaining error, 0 at the error 0.
            price: cost of a request.
            curvature: growth of these values (S, K) with the error's square.
        """
        problem = self.problem
        silence, sending = problem.tokens.following.T
        flat = (value - curvature * self.square).reshape(self.shape[0], -1)
        next_square = problem.coefficient**2 * self.square + problem.deviation**2
        remains = (self.grid.kernel @ flat).reshape(self.shape) + curvature * next_square
        remains = error_cost + self.discount * remains
        silent = _mix(problem.transition, remains[..., silence])
        later = remains[..., sending]
        request = _mix(problem.transition * problem.drop, later)
        request = request + _mix(problem.transition * (1.0 - problem.drop), later[:1])
        return silent, np.where(problem.tokens.affordable[:, 1], price + request, np.inf)

    def decide(self, value: Array) -> tuple[Array, Array]:
        """Return the least cost (M, S, K), and the cost of silence minus the cost of a request."""
        silent, request = self.choices(value, self.error_cost, self.problem.price, self.curvature)
        return np.minimum(silent, request), silent - request

    def mean(self, law: Array, deviation: float, value: Array) -> Array:
        """Return the mean values (S,) of a ``law`` (M,) of errors, with the initial tokens.

        Args:
            law: probabilities of the grid's points.
            deviation: the error's standard deviation.
            value: values (M, S, K) with the present curvature.
        """
        flat = law @ (value - self.curvature * self.square)[..., self.problem.tokens.initial]
        mean: Array = flat + self.curvature[:, self.problem.tokens.initial] * deviation**2
        return mean

    def count(self, value: Array, threshold: Array) -> Array:
        """Return the expected transmissions (M, S, K) under thresholds.

        A point near the threshold counts as the share of its cell above the threshold.

        Args:
            value: expected transmissions from the next step on (M, S, K).
            threshold: thresholds (S, K).
        """
        silent, request = self.choices(value, 0.0, 1.0)
        points = self.grid.points[:, None, None]
        share = np.clip((points - threshold) / self.grid.points[1] + 0.5, 0.0, 1.0)
        gain = np.where(share > 0.0, request, silent) - silent
        return silent + share * gain


def _mix(weights: Array, value: Array) -> Array:
    """Return Σ over s' of weights[s, s'] value[:, s', :]."""
    rows = [sum(w * value[:, s] for s, w in enumerate(row)) for row in weights]
    return np.stack(rows, axis=1)


def source_thresholds(advantage: Array, points: Array) -> tuple[Array, bool]:
    """Return where the advantage of a request becomes positive, and whether it then stays so.

    The threshold is interpolated between two points, and infinite if the advantage is never
    positive.

    Args:
        advantage: cost of silence minus cost of a request (M, ...).
        points: errors (M,).
    """
    requests = advantage >= 0.0
    first = np.argmax(requests, axis=0)
    here = np.take_along_axis(advantage, first[None], 0)[0]
    before = np.take_along_axis(advantage, np.maximum(first - 1, 0)[None], 0)[0]
    with np.errstate(invalid="ignore"):
        part = np.where(first > 0, here / np.where(here > before, here - before, 1.0), 0.0)
    result = points[first] - part * points[1]
    ordered = bool(np.all(np.diff(requests.astype(np.int8), axis=0) >= 0))
    return np.where(requests.any(0), result, np.inf), ordered


@dataclass(frozen=True)
class AverageSolution:
    """The stationary optimum.

    Args:
        cost: cost per step, between ``lower`` and ``upper``.
        lower: lower bound of the cost.
        upper: upper bound of the cost.
        error: mean squared error.
        rate: transmissions per step.
        threshold: thresholds (S, K) by channel state and token level.
        ordered: whether a request is best at every error above its threshold.
    """

    cost: float
    lower: float
    upper: float
    error: float
    rate: float
    threshold: Array
    ordered: bool


def solve_average(
    problem: SourceProblem,
    grid: ErrorGrid | None = None,
    tolerance: float = 1e-7,
    iterations: int = 200_000,
) -> AverageSolution:
    """Return the least average cost by relative value iteration.

    Args:
        problem: the source.
        grid: grid of the error; the problem's default grid by default.
        tolerance: largest relative distance of the bounds.
        iterations: largest number of iterations.

    Raises:
        ConfigurationError: no convergence, for example for an unstable source with frequent losses.

    Example:
        >>> from fusion_gym.solvers import SourceProblem, solve_average
        >>> f"{solve_average(SourceProblem.create(price=5.0)).cost:.2f}"
        '1.54'
    """
    bellman = Bellman(problem, grid or problem.grid())
    bellman.curvature = problem.stationary_curvature()
    lower, upper, advantage = iterate_values(bellman.decide, bellman.shape, tolerance, iterations)
    threshold, ordered = source_thresholds(advantage, bellman.grid.points)
    cost = 0.5 * (lower + upper)
    rate = _rate(bellman, threshold, tolerance, iterations)
    error = (cost - problem.price * rate) / problem.error_weight
    return AverageSolution(cost, lower, upper, error, rate, threshold, ordered)


def _rate(bellman: Bellman, threshold: Array, tolerance: float, iterations: int) -> float:
    """Return the transmissions per step under stationary thresholds."""
    value, change = np.zeros(bellman.shape), np.zeros(bellman.shape)
    for _ in range(iterations):
        new = bellman.count(value, threshold)
        change = new - value
        value = new - new[0, 0, 0]
        if np.ptp(change) <= tolerance:
            break
    return float(0.5 * (change.min() + change.max()))


@dataclass(frozen=True)
class DiscountedSolution:
    """The discounted optimum, from a zero error, with the initial tokens.

    ``cost`` (S,) by the channel's state at time 0 is (1 - β) E Σ βᵗ cost(t), where the first step
    is not discounted. ``threshold`` (S, K) and ``ordered`` are as in :class:`AverageSolution`.
    """

    cost: Array
    threshold: Array
    ordered: bool


def solve_discounted(
    problem: SourceProblem, discount: float, grid: ErrorGrid | None = None, tolerance: float = 1e-10
) -> DiscountedSolution:
    """Return the least discounted cost by value iteration.

    Args:
        problem: the source.
        discount: β in (0, 1).
        grid: grid of the error; the problem's default grid by default.
        tolerance: largest distance of the bounds, relative to the cost.

    Raises:
        ConfigurationError: a discount outside (0, 1).
    """
    beta = validation.number("discount", discount, above=0.0, at_most=1.0 - 1e-6)
    bellman = Bellman(problem, grid or problem.grid(), beta)
    bellman.curvature = problem.stationary_curvature(beta)
    value = np.zeros(bellman.shape)
    while True:
        new, advantage = bellman.decide(value)
        change = new - value
        # The bounds of MacQueen: the limit lies between new + β/(1-β) min and max of the change.
        value = new + beta / (1.0 - beta) * 0.5 * (change.min() + change.max())
        if np.ptp(change) <= tolerance * max(float(np.abs(new[0]).max()), 1e-300):
            break
    first = bellman.mean(bellman.grid.kernel[0], problem.deviation, value)
    return DiscountedSolution(
        (1.0 - beta) * first, *source_thresholds(advantage, bellman.grid.points)
    )


@dataclass(frozen=True)
class FiniteSolution:
    """The exact optimum of an episode: ``cost`` is the expected sum over its ``horizon`` steps.

    ``error`` and ``rate`` are expected means over the steps; ``threshold`` (T, S, K) by step,
    channel state and token level; ``ordered`` as in :class:`AverageSolution`.
    """

    cost: float
    error: float
    rate: float
    threshold: Array
    ordered: bool


def solve_finite(
    problem: SourceProblem,
    horizon: int,
    initial_deviation: float = 0.0,
    grid: ErrorGrid | None = None,
) -> FiniteSolution:
    """Return the least expected cost of ``horizon`` steps by dynamic programming.

    The channel starts in the problem's ``initial`` distribution.

    Args:
        problem: the source.
        horizon: number of steps, >= 1.
        initial_deviation: standard deviation of x(0).
        grid: grid of the error; the problem's default grid by default.

    Raises:
        ConfigurationError: a value that is not allowed.
    """
    steps = validation.integer("horizon", horizon, at_least=1)
    spread = validation.number("initial_deviation", initial_deviation, at_least=0.0)
    bellman = Bellman(problem, grid or problem.grid(steps))
    value, sent = np.zeros(bellman.shape), np.zeros(bellman.shape)
    values = np.empty((steps, *bellman.shape[1:]))
    ordered = True
    for step in reversed(range(steps)):
        value, advantage = bellman.decide(value)
        bellman.curvature = problem.curvature(bellman.curvature)
        values[step], here = source_thresholds(advantage, bellman.grid.points)
        sent = bellman.count(sent, values[step])
        ordered = ordered and here
    first = problem.first_law(bellman.grid, spread)
    deviation = float(np.hypot(problem.coefficient * spread, problem.deviation))
    cost = float(bellman.mean(first, deviation, value) @ problem.initial)
    rate = float(first @ sent[..., problem.tokens.initial] @ problem.initial) / steps
    error = (cost / steps - problem.price * rate) / problem.error_weight
    return FiniteSolution(cost, error, rate, values, ordered)


_TOLERANCE = 1e-3  # relative, of the multiplier; the bound is flat at its maximum
_DOUBLINGS = 60


class DualBound(NamedTuple):
    """A lower bound ``cost`` of every policy, and its ``multiplier``, the price of a token."""

    cost: float
    multiplier: float


def lagrangian_bound(
    problems: Sequence[SourceProblem],
    spent: Sequence[float],
    rate: float,
    horizon: int | None = None,
    initial_tokens: float = 0.0,
    initial_deviation: Sequence[float] | None = None,
) -> DualBound:
    """Return a lower bound of the cost of policies that spend at most ``rate`` tokens per step.

    A multiplier μ >= 0 gives the lower bound Σᵢ Jᵢ(priceᵢ + μ · spentᵢ) - μ · supply by weak
    duality, where Jᵢ is the optimal cost of source i at a price. The function returns the largest
    of these bounds. One transmission per step (``access="single"``) is a rate of 1 with ``spent``
    of 1.

    Without ``horizon`` the cost is the average per step, and the supply is ``rate``. With
    ``horizon`` the cost is the sum over an episode, whose channels start in the problems'
    ``initial`` distributions. Its supply is ``initial_tokens`` + ``rate`` · (``horizon`` - 1).

    Args:
        problems: the sources; their own tokens must be unlimited.
        spent: tokens of a transmission of each source.
        rate: tokens per step.
        horizon: number of steps; None for the average cost.
        initial_tokens: tokens at the start of an episode.
        initial_deviation: standard deviation of x(0) of each source; 0 by default.

    Raises:
        ConfigurationError: a value that is not allowed.

    Example:
        >>> from fusion_gym.solvers import SourceProblem, lagrangian_bound
        >>> bound = lagrangian_bound([SourceProblem.create(price=0.0)], spent=[1.0], rate=0.1)
        >>> f"{bound.cost:.2f}"
        '1.37'
    """
    # Imported here, because scipy.optimize takes a tenth of a second to load.
    from scipy.optimize import minimize_scalar

    if any(len(problem.tokens.level) > 1 for problem in problems):
        reason = "only its price must limit each source"
        raise forbidden("tokens", "limited", reason, "in the parts of the bound")
    costs = validation.positive("spent", list(spent), (len(problems),)).tolist()
    gained = validation.number("rate", rate, at_least=0.0)
    start = list(initial_deviation or [0.0] * len(problems))
    supply = gained if horizon is None else initial_tokens + gained * (horizon - 1)

    def dual(multiplier: float) -> float:
        total = -multiplier * supply
        for problem, cost, spread in zip(problems, costs, start, strict=True):
            dearer = replace(problem, price=problem.price + multiplier * cost)
            total += (
                solve_average(dearer).lower
                if horizon is None
                else solve_finite(dearer, horizon, spread).cost
            )
        return total

    high = max(problem.price / cost for problem, cost in zip(problems, costs, strict=True))
    high = max(high, min(p.error_weight * p.deviation**2 for p in problems))
    best = zero = dual(0.0)
    for _ in range(_DOUBLINGS):
        value = dual(high)
        if value < best:
            break
        best, high = value, 2.0 * high
    optimum = minimize_scalar(
        lambda multiplier: -dual(float(multiplier)),
        bounds=(0.0, high),
        method="bounded",
        options={"xatol": _TOLERANCE * high},
    )
    if zero >= -float(optimum.fun):
        return DualBound(zero, 0.0)
    return DualBound(float(-optimum.fun), float(np.asarray(optimum.x)))
