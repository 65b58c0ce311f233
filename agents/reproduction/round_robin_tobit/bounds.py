"""The bounds of Theorems 4 and 5 of round_robin_tobit, step by step beside the covariances."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import fusion_gym
from fusion_gym import gaussian, linalg
from fusion_gym.arrays import Array
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Policy

from .runs import Turn, censored, round_robin, walk

# Where the text leaves a choice: the sign of φ (Theorem 4 adds it, (15) with an infinite right
# threshold subtracts it), and whether the correction holds the filter's covariance, as printed, or
# the bound itself.
UPPER = {
    "as printed": (1.0, False),
    "the sign of φ as in (15)": (-1.0, False),
    "the bound in its own correction": (1.0, True),
    "both": (-1.0, True),
}
# And for the lower bound whether the factor 1 - (1 - ᾱ - β̄)² stands at every step, as printed, or
# at the sensor's turns alone, and whether the process covariance stands whole or, as in (49), with
# the factor (1 - ᾱ - β̄)².
LOWER = {
    "as printed": (False, False),
    "at the sensor's turns": (True, False),
    "as in (49)": (False, True),
}
SHARE = 0.5  # ε of a node, the paper's 1/p


class Censoring(NamedTuple):
    """What a sensor's filter expects, (N,): α, 1 - α - β, and φ of Theorem 4 without its sign."""

    left: Array
    inside: Array
    narrowing: Array


@dataclass
class BoundRecursion(ABC):
    """A bound (states, states, N) of a sensor, beside the covariance P⁻ that it is to bound.

    ``inflation`` is 1 for a filter by itself and ε⁻¹ for a node, whose process covariance is
    Q/ε by (27).
    """

    task: Task
    sensor: int
    inflation: float
    value: Array = field(default_factory=lambda: np.zeros(0), init=False)

    @abstractmethod
    def begin(self, covariance: Array) -> None:
        """At the first step, from P⁻."""

    @abstractmethod
    def holds(self, covariance: Array) -> NDArray[np.bool_]:
        """Whether (N,) it bounds P⁻."""

    @abstractmethod
    def advance(self, covariance: Array, observed: Censoring, turn: bool) -> None:
        """To the next step, from P⁻, what is expected, and whether it is this sensor's turn."""

    def moved(self, stored: Array, share: Array | float = 1.0) -> Array:
        """A ``stored`` Aᵀ and the process covariance, of which the lower bound may take a share."""
        model = censored(self.task).model
        process = model.process_covariance * self.inflation
        return linalg.congruence(model.transition, stored) + share * process


@dataclass
class Upper(BoundRecursion):
    """P^u of Theorem 4, in a reading of :data:`UPPER`."""

    sign: float
    own: bool

    def begin(self, covariance: Array) -> None:
        """P^u = P⁻, as the proof has it."""
        self.value = covariance.copy()

    def holds(self, covariance: Array) -> NDArray[np.bool_]:
        """See :class:`BoundRecursion`."""
        return matrix_below(covariance, self.value)

    def advance(self, covariance: Array, observed: Censoring, turn: bool) -> None:
        """See :class:`BoundRecursion`."""
        sensors, stored = censored(self.task).centre.sensors, self.value
        if turn:
            row = sensors.measurement_matrix[self.sensor, 0]
            cross = linalg.matvec(self.value if self.own else covariance, row)
            noise = sensors.variance[self.sensor, 0] * (1.0 + self.sign * observed.narrowing)
            weight = (1.0 - observed.left) ** 2
            innovation = weight * linalg.dot(row, cross) + noise
            stored = stored - linalg.outer(cross, cross) * weight / innovation
        self.value = self.moved(stored)


@dataclass
class Lower(BoundRecursion):
    """P^l of Theorem 4, in a reading of :data:`LOWER`."""

    turns: bool
    part: bool

    def begin(self, covariance: Array) -> None:
        """P^l = 0, as the proof has it."""
        self.value = np.zeros_like(covariance)

    def holds(self, covariance: Array) -> NDArray[np.bool_]:
        """See :class:`BoundRecursion`."""
        return matrix_below(self.value, covariance)

    def advance(self, covariance: Array, observed: Censoring, turn: bool) -> None:
        """See :class:`BoundRecursion`."""
        inside = observed.inside**2 if turn or not self.turns else np.zeros_like(observed.inside)
        self.value = self.moved((1.0 - inside) * self.value, inside if self.part else 1.0)


def failures(
    task: Task, policy: Policy, episodes: int, seed: int, bounds: Sequence[BoundRecursion]
) -> tuple[Array, Array]:
    """Shares of an episode's steps in which a bound fails.

    Of Theorem 4, (bounds, episodes); of Theorem 5, (pairs, episodes), for pairs of bounds of both
    sensors in the order in which they stand.
    """
    pairs = [bounds[i : i + 2] for i in range(0, len(bounds) - 1, 2)]
    local, fused = np.zeros((len(bounds), episodes)), np.zeros((len(pairs), episodes))

    def before(batch: EpisodeBatch, step: int, runs: slice) -> None:
        covariance = batch.state.prior_covariance
        observed = [_seen(task, batch, sensor) for sensor in range(task.sensors)]
        for place, bound in enumerate(bounds):
            own = covariance * bound.inflation
            if step == 0:
                bound.begin(own)
            local[place, runs] += ~bound.holds(own)
        for place, pair in enumerate(pairs if step else []):
            ends = _joined([item.value for item in pair]), covariance[:2, :2]
            low, high = ends if isinstance(pair[0], Lower) else ends[::-1]
            fused[place, runs] += ~matrix_below(low, high)
        for bound in bounds:
            turn = step % task.sensors == bound.sensor
            bound.advance(covariance * bound.inflation, observed[bound.sensor], turn)

    walk(task, policy, episodes, seed, lambda *_: None, before)
    return local / (task.horizon - 1), fused / (task.horizon - 1)


def _of(task: Task, sensor: int, inflation: float) -> dict[str, BoundRecursion]:
    """Both bounds of a sensor in all their readings."""
    uppers = {f"upper/{name}": Upper(task, sensor, inflation, *how) for name, how in UPPER.items()}
    lowers = {f"lower/{name}": Lower(task, sensor, inflation, *how) for name, how in LOWER.items()}
    return {**uppers, **lowers}


def _seen(task: Task, batch: EpisodeBatch, sensor: int) -> Censoring:
    sensors, expected = censored(task).centre.sensors, batch.state.prediction.expectation
    limit, deviation = sensors.threshold[sensor, 0], sensors.deviation[sensor, 0]
    low = (limit - expected.latent[sensor, 0]) / deviation
    hazard = gaussian.hazard(low)
    inside = expected.uncensored_probability[sensor, 0]
    return Censoring(gaussian.upper_tail(-low), inside, hazard * (hazard - low))


def matrix_below(first: Array, second: Array) -> NDArray[np.bool_]:
    """Whether (N,) ``first`` ≤ ``second``, both (n, n, N), up to rounding; NaN bounds nothing."""
    scale = np.maximum(linalg.trace(np.abs(first)), linalg.trace(np.abs(second)))
    gap = linalg.add_diagonal(second - first, np.broadcast_to(1e-9 * scale, second.shape[1:]))
    return np.asarray(np.isfinite(linalg.cholesky(gap)).all((0, 1)))


def _joined(parts: list[Array]) -> Array:
    """(Σ P_m⁻¹)⁻¹ of x, as Theorem 5 joins the bounds; NaN where one is indefinite."""
    return linalg.inverse(sum((linalg.inverse(part) for part in parts), np.zeros(1)))[:2, :2]


def compute_bound_recursion(env: str, episodes: int, seed: int, **options: Any) -> dict[str, Array]:
    """Shares of failures (episodes,) by theorem, end, reading and sensor."""
    task = fusion_gym.make_task(env, **options)
    data: dict[str, Array] = {}
    for sensor in range(2):
        single = _of(task, sensor, 1.0)
        local, _ = failures(task, Turn(sensor), episodes, seed, list(single.values()))
        for name, sample in zip(single, local, strict=True):
            data[f"4/{name}/{sensor}"] = sample
    nodes = [_of(task, sensor, 1.0 / SHARE) for sensor in range(2)]
    bounds = [node[name] for name in nodes[0] for node in nodes]
    _, fused = failures(task, round_robin(task), episodes, seed, bounds)
    for name, sample in zip(nodes[0], fused, strict=True):
        data[f"5/{name}"] = sample
    return data
