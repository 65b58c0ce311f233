"""A lower bound of the least cost by backward induction on lattices; docs/bounds.md proves it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from fusion_gym.arrays import Array
from fusion_gym.solvers.silence import lattice
from fusion_gym.solvers.silence.problem import SilenceProblem
from fusion_gym.solvers.silence.survival import Survival
from fusion_gym.validation import ConfigurationError

_TAIL = 1e-15  # upper bound of the probability of the noise's tails, with rounding
_MOST_POINTS = 20_000_000  # of one lattice
_DEVIATIONS = np.array([0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0])
_BALANCES = np.geomspace(1.0 / 16.0, 16.0, 9)[:, None]
_SHARES = np.linspace(0.05, 0.95, 19)[:, None, None, None]


@dataclass(frozen=True)
class Stage:
    """The solution at one time, on a lattice of the step ``step``.

    Args:
        coordinates: coordinates of the lattice.
        step: distance of its points.
        silent: semi-axes (n,) of an ellipsoid, in the coordinates, with every e at which silence
            may be best.
        gain: least cost from here on minus ``ceiling`` (points along each axis); 0 off the lattice.
        ceiling: least cost after a packet, plus its price.
        floor: lower bound of the least cost after a packet, without its price.
    """

    coordinates: lattice.Coordinates
    step: float
    silent: Array
    gain: Array
    ceiling: float
    floor: float

    @property
    def half(self) -> NDArray[np.int64]:
        """Points on each side of the middle, by axis (n,)."""
        return (np.array(self.gain.shape) - 1) // 2


@dataclass(frozen=True)
class SilenceSolution:
    """A lower bound ``lower`` of the average cost per step of every policy of the problem.

    ``stages`` belong to t = 1..H; ``points`` is the number of points of the largest lattice.
    """

    lower: float
    stages: tuple[Stage, ...]
    points: int


class _Expectation:
    """A lower bound of E of the next value at A e + w, with its value ``middle`` at e = 0.

    The cost after a packet is at most by ``rise`` higher at the previous time.
    """

    def __init__(self, stage: Stage, price: float) -> None:
        self.stage = stage
        self.deviations = np.sqrt(stage.coordinates.variance) / stage.step
        self.far = stage.ceiling - _TAIL * price
        self.half = stage.half + lattice.margins(self.deviations)
        self.middle = float(self.values(0 * self.half).item())
        self.rise = max(self.middle - stage.floor, 0.0) + _TAIL * price

    def values(self, reach: NDArray[np.int64]) -> Array:
        """Return the expectations at so many points on each side of the middle, by axis (n,)."""
        gain, added = lattice.spread_values(self.stage.gain, self.deviations, reach)
        return self.stage.ceiling + gain - self.stage.step**2 * added

    def within(self, deviations: float) -> Array:
        """Return semi-axes (B, n) of ellipsoids, each around all points near the silent set.

        Each ellipsoid contains the sum of the silent set and the ellipsoid of the noise.

        Args:
            deviations: size of the ellipsoid of the noise, in standard deviations.
        """
        silent = self.stage.silent**2
        noise = deviations**2 * self.stage.coordinates.variance
        return np.sqrt((1.0 + 1.0 / _BALANCES) * silent + (1.0 + _BALANCES) * noise)

    def at(self, points: Array) -> Array:
        """Return the expectation (M,) at ``points`` A e (n, M)."""
        places = (self.stage.coordinates.inverse / self.stage.step) @ points
        near = np.ones(points.shape[1], dtype=np.bool_)
        for place, half in zip(places, self.half, strict=True):
            near &= np.abs(place) <= half
        reach = np.ceil(np.abs(places[:, near]).max(1, initial=0.0)).astype(np.int64)
        results, parts = lattice.interpolated(self.values(reach), places[:, near])
        result = np.full(points.shape[1], self.far)
        result[near] = results - self.stage.step**2 * parts
        return result


def solve_silence(problem: SilenceProblem, step: float) -> SilenceSolution:
    """Bound the least cost from below, on lattices of this ``step``.

    In every direction of the lattice coordinates, half the second derivative of the value is at
    most 1. A step h therefore costs up to about n h²/3 per step of time.

    Args:
        problem: the problem.
        step: distance of the points, in units of the root of the cost.

    Raises:
        ConfigurationError: a lattice would have more than 20 million points.
    """
    survival = Survival(problem.transition, problem.weights, problem.horizon)
    stages: list[Stage] = []
    points = 0
    ahead: _Expectation | None = None
    for time in reversed(range(problem.horizon)):
        noise = problem.noise[time]
        coordinates = lattice.Coordinates.create(survival.curvature, noise)
        half = _half(problem, coordinates, step, ahead)
        points = max(points, int(np.prod(2.0 * half + 1.0)))
        if points > _MOST_POINTS:
            raise ConfigurationError(
                f"step = {step:g} is not allowed with price = {problem.price:g}: the lattice would "
                f"have {points:.2g} points, and may have {_MOST_POINTS:.2g}; use a larger step"
            )
        stage = _stage(problem, coordinates, half, step, ahead)
        stages.append(stage)
        ahead = _Expectation(stage, problem.price)
        survival.add(coordinates.inverse / stage.silent[:, None], noise)
    assert ahead is not None
    return SilenceSolution(ahead.middle / problem.horizon, tuple(reversed(stages)), points)


def _half(
    problem: SilenceProblem,
    coordinates: lattice.Coordinates,
    step: float,
    ahead: _Expectation | None,
) -> NDArray[np.int64]:
    """Return the points on each side of the middle that contain every e of optimal silence."""
    price, weight = problem.price, coordinates.basis.T * problem.weights @ coordinates.basis
    if ahead is None:
        width = lattice.extents(weight / price)
    else:
        rise = ahead.rise
        to_next = ahead.stage.coordinates.inverse @ problem.transition @ coordinates.basis
        width = np.full(problem.size, np.inf)
        for deviations in _DEVIATIONS.tolist():
            # If the noise returns A e to the silent set with less than this probability, silence
            # is best only if it costs less than the rise.
            returns = price * float(ndtr(-deviations)) + rise
            axes = ahead.within(deviations)  # (B, n), several ellipsoids around the others
            again = (to_next.T / axes[:, None] ** 2) @ to_next
            both = _SHARES * weight / (price + rise) + (1.0 - _SHARES) * again
            near = lattice.extents(both).min((0, 1))
            width = np.minimum(width, np.maximum(lattice.extents(weight / returns), near))
    return np.ceil(width / step).astype(np.int64) + 1


def _stage(
    problem: SilenceProblem,
    coordinates: lattice.Coordinates,
    half: NDArray[np.int64],
    step: float,
    ahead: _Expectation | None,
) -> Stage:
    """Return the solution one step backwards."""
    place = lattice.nodes(half, step)
    error = np.tensordot(coordinates.basis, place, 1)
    silent = np.tensordot(problem.weights, error**2, 1)
    if ahead is not None:
        known = silent <= problem.price + ahead.rise  # elsewhere silence is not best
        silent[known] += ahead.at(problem.transition @ error[:, known])
        silent[~known] = np.inf
    between = 0.25 * problem.size * step**2  # largest reduction of the cost between points
    # At the last step the cost of silence is known, and least at 0.
    floor = 0.0 if ahead is None else float(silent.min()) - between
    ceiling = problem.price + floor
    reach = np.abs(place[:, silent <= ceiling + between])
    gain = np.minimum(silent - ceiling, 0.0)
    gain = np.concatenate([np.flip(gain[1:]), gain])  # the value of e and -e is the same
    used = np.rint(reach.max(1) / step).astype(np.int64)
    inner = tuple(slice(h - u, h + u + 1) for h, u in zip(half, used, strict=True))
    return Stage(coordinates, step, _ellipsoid(reach + step), gain[inner], ceiling, floor)


def _ellipsoid(corners: Array) -> Array:
    """Return semi-axes (n,) of an ellipsoid around the boxes of half widths ``corners`` (n, M)."""
    width = corners.max(1)
    return np.asarray(width * np.sqrt(((corners / width[:, None]) ** 2).sum(0).max()))
