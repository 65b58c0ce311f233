"""Bounds of the least cost by backward induction on lattices; docs/bounds.md proves the lower one.

The upper one is the simulated cost of the solution's policy.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from fusion_gym.arrays import Array
from fusion_gym.solvers.silence import lattice
from fusion_gym.solvers.silence.problem import SilenceProblem
from fusion_gym.systems.linear_plant import covariance_factor
from fusion_gym.validation import ConfigurationError

_LOOK = 48  # largest number of steps ahead for a probability of one time


class Survival:
    """Upper bounds of the probability of silence, step by step backwards in time.

    Silence at time t needs e(t) in an ellipsoid {|F e| <= 1}. Among Gaussians of one covariance,
    the one of mean 0 gives a convex symmetric set its largest probability (T. W. Anderson, "The
    integral of a symmetric unimodal function", 1955). Hence, for any e(t), the probability of
    silence at t + 1, …, t + j is at most ρ(j). ρ(j) is the least product of such probabilities over
    any choice of times in between.

    ``curvature`` (n, n) is S(t) = Σ ρ(j) (Aʲ)ᵀ W Aʲ over j >= 0, for the last added time t.
    """

    def __init__(self, transition: Array, weights: Array, horizon: int) -> None:
        size = len(transition)
        self._transition = transition
        self._ellipsoids: list[Array] = []  # of the times t + 1, t + 2, …
        self._noises: list[Array] = []
        self._rho: list[Array] = [np.ones(1)]  # of the times t, t + 1, …
        power, grams = np.eye(size), []
        for _ in range(horizon):
            grams.append(power.T @ (weights[:, None] * power))
            power = transition @ power
        self._grams = np.array(grams)

    @property
    def curvature(self) -> Array:
        """S(t) of the last added time t."""
        rho = self._rho[0]
        return np.asarray(np.tensordot(rho, self._grams[: len(rho)], 1))

    def add(self, ellipsoid: Array, noise: Array) -> None:
        """Go back one step, with F (n, n) of the silent set {|F e| <= 1} and the noise Σ."""
        size = len(noise)
        self._ellipsoids.insert(0, ellipsoid)
        self._noises.insert(0, noise)
        looks = min(_LOOK, len(self._ellipsoids))
        del self._ellipsoids[_LOOK:], self._noises[_LOOK:]
        covariance, stretched = np.zeros((size, size)), np.empty((looks, size, size))
        for j in range(looks):
            covariance = self._transition @ covariance @ self._transition.T + self._noises[j]
            stretched[j] = covariance
        once = _inside(np.array(self._ellipsoids[:looks]), stretched)
        longest = len(self._rho[0])
        rho = np.ones(longest + 1)
        for j in range(looks):  # the first time is t + 1 + j
            later = self._rho[j]
            reach = longest + 1 - (j + 1)
            rho[j + 1 :] = np.minimum(rho[j + 1 :], once[j] * later[:reach])
        self._rho.insert(0, rho)
        del self._rho[_LOOK:]


def _inside(ellipsoids: Array, covariances: Array) -> Array:
    """Return upper bounds (J,) of P(|F z| <= 1), z ~ N(0, Γ), by the box around each ellipsoid."""
    variances = np.linalg.eigvalsh(ellipsoids @ covariances @ np.swapaxes(ellipsoids, -1, -2))
    deviations = np.sqrt(np.maximum(variances, 1e-300))
    return np.asarray(np.prod(2.0 * ndtr(1.0 / deviations) - 1.0, axis=-1))


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


_SURE = 3.0  # standard errors


class UpperValue(NamedTuple):
    """Means over simulated episodes, per step: ``cost`` with its standard error, and packets."""

    cost: float
    deviation: float
    packets: float

    @property
    def high(self) -> float:
        """The cost plus three standard errors."""
        return self.cost + _SURE * self.deviation


def simulate(
    problem: SilenceProblem, solution: SilenceSolution, episodes: int = 20_000, seed: int = 0
) -> UpperValue:
    """Run the solution's policy: silence near points of optimal silence, e = 0 after a packet."""
    draw = np.random.default_rng(seed)
    error = np.zeros((problem.size, episodes))
    cost, packets = np.zeros(episodes), 0.0
    for stage, noise in zip(solution.stages, problem.noise, strict=True):
        factor = covariance_factor(noise)
        moved = factor @ draw.standard_normal((factor.shape[1], episodes))
        error = problem.transition @ error + moved
        sends = _sends(stage, error)
        error[:, sends] = 0.0
        cost += problem.weights @ error**2 + problem.price * sends
        packets += float(sends.mean())
    cost /= problem.horizon
    deviation = float(cost.std(ddof=1)) / np.sqrt(episodes)
    return UpperValue(float(cost.mean()), deviation, packets / problem.horizon)


def _sends(stage: Stage, error: Array) -> NDArray[np.bool_]:
    """Return whether a packet is best at the point nearest to each of the errors (n, M)."""
    place = np.rint(stage.coordinates.inverse @ error / stage.step).astype(np.int64)
    place += stage.half[:, None]
    shape = np.array(stage.gain.shape)[:, None]
    inside = ((place >= 0) & (place < shape)).all(0)
    result = np.ones(error.shape[1], dtype=np.bool_)
    result[inside] = stage.gain[tuple(place[:, inside])] == 0.0
    return result
