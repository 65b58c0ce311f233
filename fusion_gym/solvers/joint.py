"""Two sources that share the network: the optimum over both errors and the tokens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.token_bucket import BucketOptions, TokenBucket
from fusion_gym.errors import forbidden
from fusion_gym.solvers.single import iterate_values
from fusion_gym.solvers.source import ErrorGrid, Resolution, SourceProblem, TokenLevels

_RESOLUTION = Resolution(finest=20.0, coarsest=4.0, points=160, negligible=1e-5)
_RESOLUTION_TOKENS = _RESOLUTION._replace(points=110)  # where tokens are limited
_TOLERANCE, _ITERATIONS = 1e-6, 20_000  # of relative value iteration


@dataclass(frozen=True)
class JointProblem:
    """Two sources whose channels lose packets independently, with a common network.

    Args:
        sources: the sources; ``price`` is the price of a transmission of the source, and its own
            tokens are ignored.
        tokens: levels of the common bucket.
        at_most: largest number of transmissions in a step.
    """

    sources: tuple[SourceProblem, SourceProblem]
    tokens: TokenLevels
    at_most: int

    @classmethod
    def create(
        cls, sources: tuple[SourceProblem, ...], bucket: TokenBucket | None = None, at_most: int = 2
    ) -> JointProblem:
        """Return the checked problem; without a bucket the tokens are unlimited."""
        if len(sources) != 2:
            raise validation.refusal("sensors", len(sources), "2", "for the joint optimum")
        first, second = sources
        for source in sources:
            source.stationary_curvature()
        if len(first.drop) > 1 or len(second.drop) > 1:
            reason = "the channel must lose packets independently"
            raise forbidden("channel", "gilbert_elliott", reason, "for the joint optimum")
        if bucket is None:
            bucket = TokenBucket(BucketOptions(tokens="unlimited"), sensors=2)
        limit = validation.integer("at_most", at_most, at_least=1, at_most=2)
        return cls((first, second), TokenLevels.create(bucket), limit)

    @property
    def allowed(self) -> NDArray[np.bool_]:
        """The sets of sources that may be requested at each level (K, 4)."""
        small = np.array([selected.bit_count() <= self.at_most for selected in range(4)])
        return self.tokens.affordable & small

    def grids(self, horizon: int | None = None) -> tuple[ErrorGrid, ErrorGrid]:
        """Return a grid for each source's error, coarser than the grid of one source."""
        wait = max(2.0 / self.at_most, self.tokens.wait)
        resolution = _RESOLUTION if len(self.tokens.level) == 1 else _RESOLUTION_TOKENS
        first, second = (s.grid(horizon, wait=wait, resolution=resolution) for s in self.sources)
        return first, second


class JointBellman:
    """One step of backward induction; functions have the shape (M1, M2, K).

    Beyond the grids a value grows with each error's square as the ``curvature`` of its source says.
    """

    def __init__(self, problem: JointProblem, grids: tuple[ErrorGrid, ErrorGrid]) -> None:
        self.problem, self.grids = problem, grids
        first, two = (
            source.error_weight * grid.points**2
            for source, grid in zip(problem.sources, grids, strict=True)
        )
        self.error_cost = (first[:, None] + two)[..., None]
        self.shape = (len(first), len(two), len(problem.tokens.level))
        self.curvature = [np.zeros((1, 1)) for _ in problem.sources]
        self.squares = grids[0].points[:, None, None] ** 2, grids[1].points[:, None] ** 2

    def decide(self, value: Array) -> tuple[Array, NDArray[np.int8]]:
        """Return the least cost (M1, M2, K) and the best set of sources, as bits."""
        first, second = self.grids
        parts = zip(self.problem.sources, self.curvature, self.squares, strict=True)
        grown: Any = 0.0
        for source, curvature, square in parts:
            value = value - curvature * square
            next_square = source.coefficient**2 * square + source.deviation**2
            grown = grown + curvature * next_square
        ahead = (first.kernel @ value.reshape(self.shape[0], -1)).reshape(self.shape)
        remains = self.error_cost + np.matmul(second.kernel, ahead) + grown
        best = remains[..., self.problem.tokens.following[:, 0]]
        choice = np.zeros(self.shape, dtype=np.int8)
        for selected in (1, 2, 3):
            allowed = self.problem.allowed[:, selected]
            if not allowed.any():
                continue
            cost = remains[..., self.problem.tokens.following[:, selected]]
            for i, source in enumerate(self.problem.sources):
                if selected >> i & 1:
                    drop = source.drop[0]
                    cost = source.price + drop * cost + (1.0 - drop) * cost.take([0], axis=i)
            better = (cost < best) & allowed
            best = np.where(better, cost, best)
            choice[better] = selected
        return best, choice


@dataclass(frozen=True)
class JointAverageSolution:
    """The stationary optimum: ``cost`` per step, between ``lower`` and ``upper``.

    ``choice`` (M1, M2, K) is the best set of sources, as bits, on the ``grids``.
    """

    cost: float
    lower: float
    upper: float
    choice: NDArray[np.int8]
    grids: tuple[ErrorGrid, ErrorGrid]


def solve_joint_average(problem: JointProblem) -> JointAverageSolution:
    """Return the least average cost by relative value iteration, to a relative 1e-6."""
    bellman = JointBellman(problem, problem.grids())
    bellman.curvature = [source.stationary_curvature() for source in problem.sources]
    lower, upper, choice = iterate_values(bellman.decide, bellman.shape, _TOLERANCE, _ITERATIONS)
    return JointAverageSolution(0.5 * (lower + upper), lower, upper, choice, bellman.grids)


@dataclass(frozen=True)
class JointFiniteSolution:
    """The optimum of an episode: ``cost`` is the expected sum over its steps.

    ``choice`` (T, M1, M2, K) is the best set of sources, as bits, on the ``grids``.
    """

    cost: float
    choice: NDArray[np.int8]
    grids: tuple[ErrorGrid, ErrorGrid]


def solve_joint_finite(
    problem: JointProblem, horizon: int, initial_deviation: tuple[float, float] = (0.0, 0.0)
) -> JointFiniteSolution:
    """Return the least expected cost of ``horizon`` steps by dynamic programming."""
    steps = validation.integer("horizon", horizon, at_least=1)
    bellman = JointBellman(problem, problem.grids(steps))
    value = np.zeros(bellman.shape)
    choices = np.empty((steps, *bellman.shape), dtype=np.int8)
    for step in reversed(range(steps)):
        value, choices[step] = bellman.decide(value)
        bellman.curvature = [
            source.curvature(later)
            for source, later in zip(problem.sources, bellman.curvature, strict=True)
        ]
    grown = 0.0
    parts = zip(problem.sources, bellman.curvature, bellman.squares, initial_deviation, strict=True)
    for source, curvature, square, spread in parts:
        value = value - curvature * square
        grown += float(curvature[0, 0]) * ((source.coefficient * spread) ** 2 + source.deviation**2)
    value = value[..., problem.tokens.initial]
    for source, grid, spread in zip(problem.sources, bellman.grids, initial_deviation, strict=True):
        value = source.first_law(grid, spread) @ value
    return JointFiniteSolution(float(value) + grown, choices, bellman.grids)
