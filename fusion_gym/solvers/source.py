"""One source of remote estimation as a problem of dynamic programming, on a grid of errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.token_bucket import BucketOptions, TokenBucket

_MOST_POINTS = 1500


@dataclass(frozen=True)
class ErrorGrid:
    """Absolute errors 0, h, 2h, … and the matrix of E[V(a e + w)] for even functions V.

    The Gaussian density is sampled at the grid's points. By Poisson's summation formula a row then
    has the sum 1 and the mean and variance of the Gaussian, up to 2 exp(-2π² σ²/h²). The remaining
    error is due to the kinks of V, of order h². The last point has the probability beyond it, so
    ``kernel`` is a stochastic matrix.

    Shapes: ``points`` (M,), ``kernel`` (M, M) from the error after a delivery (row) to the next.
    """

    points: Array
    kernel: Array

    @classmethod
    def create(cls, coefficient: float, deviation: float, reach: float, step: float) -> ErrorGrid:
        """Return errors up to ``reach`` in steps of ``step``, from 3 to 1,500 points."""
        count = min(max(int(np.ceil(reach / step)) + 1, 3), _MOST_POINTS)
        points: Array = np.arange(count, dtype=np.float64) * float(step)
        return cls(points, gaussian_rows(coefficient * points, deviation, points))


def gaussian_rows(mean: Array, deviation: float, points: Array) -> Array:
    """Return the weights (R, M) of the points of |X|, X ~ N(mean, deviation²); rows sum to 1."""
    step = points[1]
    scale = step / (deviation * np.sqrt(2.0 * np.pi))
    rows = np.exp(-0.5 * ((points - mean[:, None]) / deviation) ** 2)
    rows[:, 1:] += np.exp(-0.5 * ((points[1:] + mean[:, None]) / deviation) ** 2)
    rows *= scale
    rows[:, -1] += np.maximum(1.0 - rows.sum(1), 0.0)
    return rows / rows.sum(1, keepdims=True)


_MOST_LEVELS = 500
_MOST_SENSORS = 12
_DIGITS = 9


@dataclass(frozen=True)
class TokenLevels:
    """The reachable levels of a token bucket, and the effect of each set of requests.

    A choice is a set of sensors, the bits of its number; choice 0 is silence.

    Args:
        level: levels (K,) in ascending order.
        initial: index of the level at the start.
        affordable: whether the network grants every request of the choice (K, choices), bool.
        following: index of the next level (K, choices).
        spent: tokens of each choice (choices,).
    """

    level: Array
    initial: int
    affordable: NDArray[np.bool_]
    following: NDArray[np.int64]
    spent: Array

    @classmethod
    def create(cls, bucket: TokenBucket) -> TokenLevels:
        """Return the reachable levels of the bucket; an unlimited bucket has one level."""
        sensors = len(bucket.cost)
        if sensors > _MOST_SENSORS:
            why = f"because all 2^{sensors} sets of sensors are choices"
            where = "for the exact optimum under a common bucket"
            raise validation.refusal("sensors", sensors, f"at most {_MOST_SENSORS}, {why}", where)
        choices = np.arange(2**sensors)
        sets = (choices >> np.arange(sensors)[:, None] & 1).astype(np.bool_)
        spent = (sets * bucket.cost).sum(0)
        if bucket.per_sensor and not bucket.unlimited:
            raise validation.refusal("budget", "sensor", "'shared'", "for the exact optimum")
        if bucket.rate_range is not None:
            rate = bucket.options.token_rate
            raise validation.refusal("token_rate", rate, "one number", "for the exact optimum")
        start = float(np.max(bucket.start(1)))
        if bucket.unlimited:
            everything = np.ones((1, len(choices)), dtype=np.bool_)
            return cls(np.array([start]), 0, everything, np.zeros((1, len(choices)), int), spent)
        result, new = {round(start, _DIGITS)}, [round(start, _DIGITS)]
        while new:
            following = {
                round(float(level), _DIGITS)
                for source in new
                for level in bucket.grant(np.full(len(choices), source), sets).tokens
            }
            new = sorted(following - result)
            result |= following
            if len(result) > _MOST_LEVELS:
                raise validation.ConfigurationError(
                    f"token_rate = {bucket.rate}, token_capacity = {bucket.capacity} are not "
                    f"allowed for the exact optimum: the bucket must have at most {_MOST_LEVELS} "
                    "levels, so rate, cost and capacity need a common divisor"
                )
        level = np.array(sorted(result))
        grants = bucket.grant(np.repeat(level, len(choices)), np.tile(sets, len(level)))
        shape = (len(level), len(choices))
        affordable = (grants.granted == np.tile(sets, len(level))).all(0).reshape(shape)
        after = np.searchsorted(level, np.round(grants.tokens, _DIGITS) - 10.0**-_DIGITS)
        initial = int(np.searchsorted(level, round(start, _DIGITS) - 10.0**-_DIGITS))
        return cls(level, initial, affordable, after.reshape(shape), spent)

    @property
    def wait(self) -> float:
        """Steps for which the tokens of all sensors are saved; 0 for unlimited tokens."""
        if len(self.level) == 1:
            return 0.0
        rate = float((self.level[self.following[:, 0]] - self.level).max())
        return float(self.spent[-1]) / max(rate, 1e-12)

    def index(self, tokens: Array) -> NDArray[np.int64]:
        """Return the index of each level in ``tokens`` (N,)."""
        if len(self.level) == 1:
            return np.zeros(len(tokens), dtype=np.int64)
        middle = 0.5 * (self.level[1:] + self.level[:-1])
        return np.searchsorted(middle, tokens)


class Resolution(NamedTuple):
    """The resolution of a default grid.

    It has from ``coarsest`` to ``finest`` points per standard deviation of the noise, within these
    limits about ``points`` points, and omits a ``negligible`` probability.
    """

    finest: float
    coarsest: float
    points: int
    negligible: float


_MOST_STEPS, _LARGEST, _PRECISION = 1_000_000, 1e12, 1e-13  # of the curvature
_RESOLUTION = Resolution(finest=40.0, coarsest=5.0, points=600, negligible=1e-10)
_RESOLUTION_TOKENS = _RESOLUTION._replace(points=300)  # where tokens are limited


@dataclass(frozen=True)
class SourceProblem:
    """The problem of one source: the least w e² + price · transmissions.

    A step starts from the error e and the channel state s of the previous step, both known. The
    source requests or not, and the channel moves to s'. A packet is lost with probability
    ``drop[s']``. The error becomes 0 after a delivery and stays e otherwise; the cost contains its
    square. Then e moves to a e + w.

    Args:
        coefficient: a.
        deviation: standard deviation σ of the noise.
        price: price of a transmission.
        error_weight: weight w of the squared error.
        transition: transition matrix of the channel (S, S).
        drop: probability of a loss in each channel state (S,).
        initial: distribution of the channel's state at time 0 (S,).
        tokens: levels of the bucket.

    Example:
        >>> from fusion_gym.solvers import SourceProblem
        >>> SourceProblem.create(coefficient=0.9, price=5.0).price
        5.0
    """

    coefficient: float
    deviation: float
    price: float
    error_weight: float
    transition: Array
    drop: Array
    initial: Array
    tokens: TokenLevels

    @classmethod
    def create(
        cls,
        coefficient: float = 1.0,
        deviation: float = 1.0,
        price: float = 1.0,
        error_weight: float = 1.0,
        drop: ArrayLike = 0.0,
        transition: ArrayLike = ((1.0,),),
        bucket: TokenBucket | None = None,
        initial: ArrayLike | None = None,
    ) -> SourceProblem:
        """Return the checked problem, by default with unlimited tokens and a stationary channel."""
        matrix = validation.array("transition", transition, (None, None))
        if matrix.shape[0] != matrix.shape[1] or not np.allclose(matrix.sum(1), 1.0):
            raise validation.refusal("transition", matrix, "a square matrix whose rows sum to 1")
        loss = validation.not_negative("drop", drop, matrix.shape[:1])
        if np.any(loss > 1.0):
            raise validation.refusal("drop", loss, "at most 1 everywhere")
        if bucket is None:
            bucket = TokenBucket(BucketOptions(tokens="unlimited"), sensors=1)
        return cls(
            coefficient=validation.number("coefficient", coefficient),
            deviation=validation.number("deviation", deviation, above=0.0),
            price=validation.number("price", price, at_least=0.0),
            error_weight=validation.number("error_weight", error_weight, above=0.0),
            transition=matrix,
            drop=loss,
            initial=_initial_law(matrix, initial),
            tokens=TokenLevels.create(bucket),
        )

    def grid(
        self,
        horizon: int | None = None,
        wait: float | None = None,
        resolution: Resolution | None = None,
    ) -> ErrorGrid:
        """Return a grid of errors.

        The default grid has about 600 points (300 with limited tokens), and 5 to 40 points per
        standard deviation of the noise. It covers all errors up to a probability of 1e-10.

        Args:
            horizon: number of steps; None for no end.
            wait: steps between two transmissions; by default those that the tokens can sustain.
            resolution: resolution of the default grid.
        """
        curved = resolution is None
        if resolution is None:
            resolution = _RESOLUTION if len(self.tokens.level) == 1 else _RESOLUTION_TOKENS
        wait = max(1.0, self.tokens.wait) if wait is None else wait
        reach = self._reach(wait, horizon, resolution.negligible, curved)
        finest, coarsest = (self.deviation / n for n in (resolution.finest, resolution.coarsest))
        step = min(max(reach / resolution.points, finest), coarsest)
        return ErrorGrid.create(self.coefficient, self.deviation, reach, step)

    def _reach(self, wait: float, horizon: int | None, negligible: float, curved: bool) -> float:
        """Return an error that is exceeded with a ``negligible`` probability."""
        tails = -float(ndtri(0.5 * negligible))
        persistence = float(np.abs(np.linalg.eigvals(self.transition * self.drop)).max())
        losses = np.inf if persistence >= 1.0 else 0.0
        if 0.0 < persistence < 1.0:
            losses = np.log(negligible) / np.log(persistence)
        if abs(self.coefficient) > 1.0 and curved:
            losses = 0.0  # errors beyond the threshold grow as the curvature says
        steps = min((1.0 + losses) * wait + 1.0, np.inf if horizon is None else horizon, 4000.0)
        # The optimal threshold in continuous time for a = 1.
        scale = float((6.0 * self.price / self.error_weight) ** 0.25 * self.deviation**0.5)
        threshold = max(scale, self.deviation * float(np.sqrt(wait)))
        reach = threshold + tails * self._silent_deviation(steps)
        if horizon is not None:
            reach = min(reach, tails * self._silent_deviation(float(horizon)))
        return float(min(reach, 1e6 * self.deviation))

    def _silent_deviation(self, steps: float) -> float:
        """Return the error's deviation after silent steps: σ √(1 + a² + … + a^(2(steps-1)))."""
        square = self.coefficient**2
        if abs(square - 1.0) < 1e-9:
            return float(self.deviation * np.sqrt(steps))
        with np.errstate(over="ignore"):
            growth = np.expm1(steps * np.log(max(square, 1e-300))) / (square - 1.0)
        return float(self.deviation * np.sqrt(growth))

    def curvature(self, later: Array, discount: float = 1.0) -> Array:
        """Return the growth (S, K) of a value with the error's square, for large errors.

        Args:
            later: growth (S, K) of the value one step later.
            discount: factor of that value.
        """
        remains = self.error_weight + discount * self.coefficient**2 * later
        silence, sending = self.tokens.following.T
        lost = (self.transition * self.drop) @ remains[:, sending]
        lost = np.where(self.tokens.affordable[:, 1], lost, np.inf)
        result: Array = np.minimum(self.transition @ remains[:, silence], lost)
        return result

    def stationary_curvature(self, discount: float = 1.0) -> Array:
        """Return the growth (S, K) without end.

        Args:
            discount: factor of the value one step later.

        Raises:
            ConfigurationError: it has no limit, so that the cost of every policy is infinite.
        """
        result = np.zeros((len(self.drop), len(self.tokens.level)))
        for _ in range(_MOST_STEPS):
            before, result = result, self.curvature(result, discount)
            if not result.max() < _LARGEST:
                break
            if (result - before).max() <= _PRECISION * result.max():
                return result
        raise validation.ConfigurationError(
            f"coefficient = {self.coefficient:g} is not allowed with a loss probability of "
            f"{validation.display(self.drop)}: losses, or waits for tokens, last so long that the "
            "mean squared error of every policy is infinite"
        )

    def first_law(self, grid: ErrorGrid, spread: float) -> Array:
        """Return the distribution (M,) of the first error on a grid, from the deviation of x(0)."""
        deviation = float(np.hypot(self.coefficient * spread, self.deviation))
        return gaussian_rows(np.zeros(1), deviation, grid.points)[0]


def _initial_law(transition: Array, values: ArrayLike | None) -> Array:
    """Return the given distribution of the channel's state at time 0, or the stationary one."""
    states = len(transition)
    if values is not None:
        given = validation.array("initial", values, (states,))
        law = validation.not_negative("initial", given, (states,))
        if not np.isclose(law.sum(), 1.0, rtol=0.0, atol=1e-9):
            raise validation.refusal("initial", law, "probabilities that sum to 1")
        return law
    balance = np.vstack((transition.T - np.eye(states), np.ones(states)))
    law, _, rank, _ = np.linalg.lstsq(balance, np.append(np.zeros(states), 1.0))
    if rank < states:
        where = (
            f"with transition = {transition.tolist()}, which has no unique stationary distribution"
        )
        allowed = "the probabilities of the states at time 0"
        raise validation.refusal("initial", None, allowed, where)
    return np.asarray(law)
