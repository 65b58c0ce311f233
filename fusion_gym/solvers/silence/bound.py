"""A lower bound of every policy's error at a rate, for linear plants measured at every step."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from fusion_gym import validation
from fusion_gym.core.task import Task
from fusion_gym.solvers.silence.induction import SilenceSolution, simulate, solve_silence
from fusion_gym.solvers.silence.problem import SilenceModel, silence_model

_ROUGH_STEP = 0.15  # in units of the root of the price, for the search of the price
_ROUGH_EPISODES = 4000
_SPAN = 1e7  # ratio of the largest to the smallest price
_CLOSE = 0.02  # tolerance of the logarithm of the price; the bound is flat at its maximum


@dataclass(frozen=True)
class PricedCost:
    """Bounds of the least cost per step, error and packets, at a ``price`` of a packet.

    Args:
        price: price of a packet.
        lower: proven lower bound.
        upper: cost of the lattice policy plus three standard errors.
        rate: transmissions of this policy per sensor and step.
        step: step of the lattices.
        points: points of the largest lattice.
    """

    price: float
    lower: float
    upper: float
    rate: float
    step: float
    points: int

    @property
    def gap(self) -> float:
        """``upper`` minus ``lower``, as a share of ``lower``."""
        return (self.upper - self.lower) / self.lower


@dataclass(frozen=True)
class SilenceBound:
    """A lower bound of the error of every policy.

    Args:
        floor: error of a centre that knows everything at once, averaged over an episode's steps.
        sensors: number of sensors.
        costs: bounds in the order of their prices.
    """

    floor: float
    sensors: int
    costs: tuple[PricedCost, ...]

    def at(self, rate: float) -> tuple[float, PricedCost]:
        """Return the bound at a rate (transmissions per sensor and step), and its price."""
        packets = rate * self.sensors
        result = [(cost.lower - cost.price * packets, cost) for cost in self.costs]
        best, table = max(result, key=lambda row: row[0])
        return max(best, self.floor), table


def silence_bound(
    task: Task,
    rates: Sequence[float],
    weights: ArrayLike | None = None,
    accuracy: float = 0.01,
    most_points: int = 3_000_000,
) -> SilenceBound:
    """Bound the error of every policy of the task from below, most tightly at these rates.

    The error is Σᵢ Wᵢ (xᵢ - x̂ᵢ)², averaged over an episode's steps, the MSE of an evaluation. The
    bound holds for every policy up to the rate, with any tokens, any knowledge of the past and any
    filter of the deliveries.

    Args:
        task: the task.
        rates: transmissions per sensor and step, in (0, 1].
        weights: W (n,); 1 by default.
        accuracy: approximate relative loss of the bound, unless ``most_points`` limits the
            lattices; the ``gap`` of each cost is the result.
        most_points: largest number of points of a lattice.

    Raises:
        ConfigurationError: a task without this bound, or a value that is not allowed.

    Example:
        >>> from fusion_gym import make_task
        >>> from fusion_gym.solvers.silence import silence_bound
        >>> task = make_task("fusion_gym/TobitOscillator-v1", filter="tobit", horizon=10)
        >>> f"{silence_bound(task, rates=[0.1], accuracy=0.2, most_points=20_000).floor:.3f}"
        '0.053'
    """
    model = silence_model(task, weights)
    required = [validation.number("rates", rate, above=0.0, at_most=1.0) for rate in rates]
    share = validation.number("accuracy", accuracy, above=0.0, at_most=0.5)
    limit = validation.integer("most_points", most_points, at_least=1000)
    costs: list[PricedCost] = []
    for rate in required:
        price, rough = _price(model, rate * task.sensors)
        costs.append(_cost(model, price, rough, rate, share, limit))
    costs.sort(key=lambda cost: cost.price)
    return SilenceBound(model.floor, task.sensors, tuple(costs))


def cost_bound(
    task: Task, price: float, accuracy: float = 0.03, most_points: int = 1_000_000
) -> PricedCost:
    """Bound the cost of every policy of the task from below, at a price of a token.

    The cost is error + price · tokens per step, in the reward's units. Every packet costs as much
    as the cheapest packet.

    Args:
        task: the task.
        price: price of a token, > 0.
        accuracy: approximate relative loss of the bound.
        most_points: largest number of points of a lattice.

    Raises:
        ConfigurationError: a task without this bound, or a value that is not allowed.
    """
    task.reward.separate_weights("for the bound")
    model = silence_model(task, task.error_scale * task.relative_weights[:, 0])
    packet = validation.number("price", price, above=0.0) * float(task.network.bucket.cost.min())
    problem = replace(model.problem, price=packet)
    rough = solve_silence(problem, _ROUGH_STEP * np.sqrt(packet))
    rate = simulate(problem, rough, _ROUGH_EPISODES).packets / task.sensors
    return _cost(model, packet, rough, rate, accuracy, most_points)


def _price(model: SilenceModel, packets: float) -> tuple[float, SilenceSolution]:
    """Return a price with about so many optimal packets per step, and its rough solution."""
    typical = float(np.einsum("tii,i->", model.problem.noise, model.problem.weights))
    typical /= model.problem.horizon
    solved: dict[float, tuple[float, SilenceSolution]] = {}

    def excess(logarithm: float) -> float:
        problem = replace(model.problem, price=float(np.exp(logarithm)))
        solution = solve_silence(problem, _ROUGH_STEP * np.sqrt(problem.price))
        sent = simulate(problem, solution, _ROUGH_EPISODES).packets
        solved[logarithm] = (sent - packets, solution)
        return sent - packets

    low = high = float(np.log(typical))
    reach = 0.5 * np.log(_SPAN)
    while excess(low) < 0.0 and low > np.log(typical) - reach:
        high, low = low, low - 1.5
    while excess(high) > 0.0 and high < np.log(typical) + reach:
        low, high = high, high + 1.5
    if solved[low][0] > 0.0 > solved[high][0]:
        brentq(lambda logarithm: excess(float(logarithm)), low, high, xtol=_CLOSE)
    best = min(solved, key=lambda logarithm: abs(solved[logarithm][0]))
    return float(np.exp(best)), solved[best][1]


def _cost(
    model: SilenceModel,
    price: float,
    rough: SilenceSolution,
    rate: float,
    accuracy: float,
    most_points: int,
) -> PricedCost:
    """Return bounds of the least cost at a price, on lattices for this accuracy at this rate."""
    problem = replace(model.problem, price=price)
    size, coarse = problem.size, rough.stages[0].step
    bound = max(model.floor + rough.lower - price * rate * model.sensors, model.floor)
    step = float(np.sqrt(3.0 * accuracy * bound / size))
    step = max(step, coarse * (rough.points / most_points) ** (1.0 / size))
    solution = solve_silence(problem, step)
    above = simulate(problem, solution)
    return PricedCost(
        price=price,
        lower=model.floor + solution.lower,
        upper=model.floor + above.high,
        rate=above.packets / model.sensors,
        step=step,
        points=solution.points,
    )
