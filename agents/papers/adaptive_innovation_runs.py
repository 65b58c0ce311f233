"""Runs of the tracking example in one batch, and the record of their errors."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import fusion_gym
from agents.papers.paper import Settings
from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.knowledge import Signals
from fusion_gym.core.runs import Outcome, State
from fusion_gym.policies.base import decide
from fusion_gym.systems.correlated.environment import CorrelatedTrackingOptions
from fusion_gym.systems.correlated.system import CorrelatedTrackingPlant, CorrelatedTrackingTruth

STEPS = 600
SENSORS = ("sensor 1", "sensor 2", "sensor 3")
ELLIPSES = 100  # the step of Figure 9
_EVERY = 5  # steps from one comparison of the nodes' matrices to the next
_ROUNDING = 1e-8  # of a generalised eigenvalue: without noise below the bounds it is 1

# Signals and the trigger's requests (sensors, N) to the requests of the same runs.
RequestFunction = Callable[[Signals, NDArray[np.bool_]], NDArray[np.bool_]]


class Lane(NamedTuple):
    """A setting of every episode: actual over bound variances, and the requests.

    ``rule`` replaces the trigger's requests; ``known_start`` sets x(0) to its mean.
    """

    scale: float = 1.0
    rule: RequestFunction | None = None
    known_start: bool = False


@dataclass(frozen=True, kw_only=True)
class SideBySide(CorrelatedTrackingPlant):
    """The plant with a noise scale for each run (N,), and runs that begin at the mean (N,)."""

    scales: Array
    known_start: NDArray[np.bool_]

    def _scale(self, noise: Array) -> Array:
        return self.scales

    def start(self, noise: Array) -> tuple[CorrelatedTrackingTruth, None]:
        """Return time 0, with x(0) at its mean in some runs."""
        state, announcement = super().start(noise)
        truth = np.where(self.known_start, self.dynamics.initial_mean, state.truth)
        return replace(state, truth=truth), announcement


class Step(NamedTuple):
    """A step of all lanes: ``state`` after the delivery, ``outcome`` the network's answer."""

    number: int
    state: State
    outcome: Outcome
    innovation: Array  # (sensors, N)


def steps(
    lanes: Iterable[Lane], episodes: int, seed: int, settings: Settings, **options: Any
) -> Iterator[Step]:
    """Yield the steps of all lanes with the same episodes, one lane after another along N."""
    lanes = list(lanes)
    options = {"horizon": STEPS} | settings["options"] | options
    task = fusion_gym.make_task(CorrelatedTrackingOptions(**options))
    plant = SideBySide(
        **vars(task.plant), scales=np.repeat([lane.scale for lane in lanes], episodes),
        known_start=np.repeat([lane.known_start for lane in lanes], episodes),
    )  # fmt: skip
    batch = EpisodeBatch(replace(task, plant=plant), len(lanes) * episodes)
    runs = np.arange(batch.num_envs)
    batch.seed(runs, (seed + runs % episodes).tolist())
    batch.reset()
    trigger = fusion_gym.make_policy(settings["policy"], task)
    for number, event in enumerate(decide(trigger, batch, seed)):
        signals = batch.signals()
        innovation = signals["innovation"][:, 0].copy()
        requests = event.copy()
        for place, lane in enumerate(lanes):
            if lane.rule is not None:
                own = slice(place * episodes, (place + 1) * episodes)
                requests[:, own] = lane.rule(signals, event)[:, own]
        outcome = batch.step(requests)
        yield Step(number, batch.delivered, outcome, innovation)


class ErrorRecord:
    """Sums over the steps of L settings with E episodes each.

    By lane, (L, …, E), means over an episode: ``mse``, ``actual`` and ``conservative`` (trace),
    ``inside`` (L, n, E) the share of errors within three actual deviations, ``ordered`` (L, n, E)
    the share of steps in which the actual deviation is at most the conservative one, ``bounded``
    the share in which P - P̄ is positive semidefinite, ``whitened`` (L, n, n, E) the mean of
    L⁻¹ e eᵀ L⁻ᵀ with P = L Lᵀ; ``worst`` is the largest generalised eigenvalue of P̄ against P in
    any step. ``square`` (L, n, E) and ``level`` (L, n, E): mean squares
    of the fused errors, and of the states about their start. ``beats`` (L, sensors, E): the share
    of steps in which the fused conservative trace is the smaller, ``encloses`` (L, sensors, E) in
    which a node's conservative covariance is at least the fused one, ``encloses_plane`` of
    position and velocity alone.

    Over steps, (L, H): means ``mse_steps``, ``actual_steps``, ``conservative_steps``.

    Of the nodes: ``node_bounded`` (L, sensors, E), ``node_gap`` (L, sensors) the largest difference
    of P and P̄ over P's largest entry, ``node_mse`` (L, sensors, E).

    Of the first episode, (L, H, n): ``truth``, ``mean``, ``actual_deviation``,
    ``conservative_deviation``; of its step ``ELLIPSES``, estimate 0 fused, then the nodes:
    ``ellipses`` (L, 2, sensors + 1, n, n), conservative and actual.
    """

    def __init__(self, count: int, episodes: int, with_nodes: bool) -> None:
        self.count, self.episodes, self.with_nodes = count, episodes, with_nodes
        self.sums: dict[str, Array] = {}
        self.most: dict[str, Array] = {}
        self.compared = 0
        self.rows: defaultdict[str, list[Array]] = defaultdict(list)
        self.stored: dict[str, Array] = {}

    def arrays(self) -> dict[str, Array]:
        """Return all arrays by name."""
        compared = ("encloses", "encloses_plane", "node_bounded")
        return (
            {
                name: value / (self.compared if name in compared else STEPS)
                for name, value in self.sums.items()
            }
            | self.most
            | {name: np.stack(rows, axis=1) for name, rows in self.rows.items()}
            | self.stored
        )

    def add(self, step: Step) -> None:
        """Add a step."""
        truth, estimate = step.state.plant.truth, step.state.estimate
        joint = step.state.plant.scale * estimate.joint
        claimed, actual = estimate.covariances[0], joint[0, 0]
        error = truth - estimate.means[0]
        deviation = np.sqrt(linalg.diagonal(actual))
        bound = np.sqrt(linalg.diagonal(claimed))
        mse, traces = (error**2).sum(0), (linalg.trace(actual), linalg.trace(claimed))
        largest = _largest(actual, claimed)
        start = truth - np.array(CorrelatedTrackingOptions().initial_mean)[:, None]
        self._add(
            mse=mse, actual=traces[0], conservative=traces[1],
            inside=np.abs(error) <= 3.0 * deviation, ordered=deviation <= bound * (1.0 + _ROUNDING),
            bounded=largest <= 1.0 + _ROUNDING, whitened=_whitened(error, claimed), square=error**2,
            level=start**2, beats=traces[1] <= linalg.trace(estimate.covariances[1:]),
        )  # fmt: skip
        self._most(worst=largest)
        for name, value in zip(("mse", "actual", "conservative"), (mse, *traces), strict=True):
            self.rows[f"{name}_steps"].append(self._lanes(value).mean(-1))
        first = {
            "truth": truth, "mean": estimate.means[0], "actual_deviation": deviation,
            "conservative_deviation": bound,
        }  # fmt: skip
        for name, value in first.items():
            self.rows[name].append(self._lanes(value)[..., 0])
        if self.with_nodes:
            self._add(node_mse=((truth - estimate.means[1:]) ** 2).sum(1))
        if step.number % _EVERY == 0:
            self._compare(step)
        if step.number + 1 == ELLIPSES:
            own = np.arange(len(SENSORS) + 1)
            both = np.stack((estimate.covariances, joint[own, own]))
            self.stored["ellipses"] = self._lanes(both)[..., 0]

    def _compare(self, step: Step) -> None:
        estimate = step.state.estimate
        self.compared += 1
        nodes, fused = estimate.covariances[1:], estimate.covariances[:1]
        self._add(
            encloses=_largest(fused, nodes) <= 1.0 + _ROUNDING,
            encloses_plane=_largest(fused[:, :2, :2], nodes[:, :2, :2]) <= 1.0 + _ROUNDING,
        )
        if self.with_nodes:
            own = np.arange(1, len(SENSORS) + 1)
            actual = step.state.plant.scale * estimate.joint[own, own]
            self._add(node_bounded=_largest(actual, nodes) <= 1.0 + _ROUNDING)
            gap = np.abs(nodes - actual).max((1, 2)) / np.abs(nodes).max((1, 2))
            self._most(node_gap=gap)

    def _lanes(self, value: NDArray[Any]) -> NDArray[Any]:
        """Reshape (…, L·E) to (L, …, E)."""
        split = value.reshape(*value.shape[:-1], self.count, self.episodes)
        return np.moveaxis(split, -2, 0)

    def _add(self, **values: NDArray[Any]) -> None:
        for name, value in values.items():
            self.sums[name] = self.sums.get(name, 0.0) + self._lanes(value).astype(float)

    def _most(self, **values: Array) -> None:
        for name, value in values.items():
            result = self._lanes(value)
            self.most[name] = np.maximum(self.most.get(name, result), result)


def _first(covariance: Array) -> NDArray[np.float64]:
    """Transpose (…, n, n, N) to (…, N, n, n)."""
    return np.moveaxis(covariance, -1, -3)


def _largest(actual: Array, claimed: Array) -> Array:
    """Return the largest λ (…, N) with det(P̄ - λ P) = 0: P bounds P̄ where λ <= 1."""
    factor = np.linalg.inv(np.linalg.cholesky(_first(claimed)))
    whitened = factor @ _first(actual) @ factor.swapaxes(-1, -2)
    even = 0.5 * (whitened + whitened.swapaxes(-1, -2))
    return np.asarray(np.linalg.eigvalsh(even)[..., -1], dtype=float)


def _whitened(error: Array, claimed: Array) -> Array:
    """Return L⁻¹ e eᵀ L⁻ᵀ (n, n, N) of errors (n, N), with P = L Lᵀ."""
    root = np.linalg.cholesky(_first(claimed))
    z = np.linalg.solve(root, error.T[..., None])[..., 0].T
    return z[:, None] * z[None]


def top(whitened: Array) -> Array:
    """Return the sample (E,) along the leading eigenvector of the mean of (n, n, E)."""
    direction = np.linalg.eigh(whitened.mean(-1))[1][:, -1]
    return np.einsum("i,ijk,j->k", direction, whitened, direction)
