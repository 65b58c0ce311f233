"""Runs of the tracking example in one batch, readings of its trigger, and a record of errors."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

import fusion_gym
from agents.papers.paper import Settings
from agents.papers.whitening import whitened_square
from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.knowledge import Signals
from fusion_gym.core.runs import Outcome, State
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Requests, decide, surprise
from fusion_gym.policies.rules import AdaptiveInnovation
from fusion_gym.systems.correlated.environment import CorrelatedTrackingOptions
from fusion_gym.systems.correlated.filters import JointErrorCovariance
from fusion_gym.systems.correlated.system import CorrelatedTrackingPlant, CorrelatedTrackingTruth

STEPS = 600
SENSORS = ("sensor 1", "sensor 2", "sensor 3")
_EVERY = 5  # steps from one comparison of the nodes' matrices to the next
_START = np.array(CorrelatedTrackingOptions().initial_mean)[:, None]
_ROUNDING = 1e-8  # of a generalised eigenvalue: without noise below the bounds it is 1

# Signals and the trigger's requests (sensors, N) to the requests of the same runs.
RequestFunction = Callable[[Signals, NDArray[np.bool_]], NDArray[np.bool_]]


@dataclass
class TriggerReading(AdaptiveInnovation):
    """The trigger with another reading of (10) and (11).

    ``sign`` is the sign of c and ``power`` the power of |ε| in the exponent. With ``same_step`` a
    request needs |ε|² to reach its own threshold, l(k) = k.
    """

    sign: float = -1.0
    power: float = 1.0
    same_step: bool = False

    def threshold_after(self, last: Array) -> Array:
        """See :class:`AdaptiveInnovation`."""
        return super().threshold_after(-self.sign * last**self.power)

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        if self.same_step:
            squared = surprise(signals)
            return self.limit(squared >= self.threshold_after(np.sqrt(squared)), signals)
        return super().__call__(signals)


def make_trigger(settings: Settings, task: Task) -> TriggerReading:
    """Return the trigger of the settings ``policy``, ``power`` and ``same_step``."""
    rule: Any = fusion_gym.make_policy(settings["policy"], task)
    return TriggerReading(**asdict(rule), power=settings["power"], same_step=settings["same_step"])


class Lane(NamedTuple):
    """A setting of every episode: actual over bound variances, and the requests.

    ``ratios`` are of the process noise, the sensors' own noises, and x(0). ``rule`` replaces the
    trigger's requests.
    """

    ratios: tuple[float, float, float] = (1.0, 1.0, 1.0)
    rule: RequestFunction | None = None


@dataclass(frozen=True, kw_only=True)
class SideBySide(CorrelatedTrackingPlant):
    """The plant with ``ratios`` (3, N) of each run, see :class:`Lane`."""

    ratios: Array

    def _scale(self, noise: Array) -> Array:
        return self.ratios[2]

    def start(self, noise: Array) -> tuple[CorrelatedTrackingTruth, None]:
        """Return time 0, with a scale for each noise of the following steps."""
        state, announcement = super().start(noise)
        counts = self.dynamics.noise_channels, self.sensors.count * self.sensors.size
        return replace(state, scale=np.repeat(self.ratios[:2], counts, axis=0)), announcement


def actual_covariance(plant: SideBySide) -> JointErrorCovariance:
    """Return the recursion of the actual covariances (23), (28), (43), (55) of each run."""
    (process, own, start), model, sensors = plant.ratios, plant.dynamics, plant.sensors
    model = replace(model, process_covariance=process * model.process_covariance)
    model = replace(model, initial_covariance=start * model.initial_covariance)
    covariance, crossed = process * sensors.covariance, process * sensors.cross_covariance
    each = np.arange(sensors.count)
    covariance[each, each] += (own - process) * sensors.deviation[:, :, None] ** 2
    sensors = replace(sensors, covariance=covariance, cross_covariance=crossed)
    return JointErrorCovariance.create(model, sensors)


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
    ratios = np.repeat([lane.ratios for lane in lanes], episodes, axis=0).T
    plant, estimator = SideBySide(**vars(task.plant), ratios=ratios), cast(Any, task.estimator)
    trigger = make_trigger(settings, task)
    joint = actual_covariance(plant) if options.get("track_actual") else None
    task = replace(task, plant=plant, estimator=replace(estimator, joint=joint))
    batch = EpisodeBatch(task, len(lanes) * episodes)
    runs = np.arange(batch.num_envs)
    batch.seed(runs, (seed + runs % episodes).tolist())
    batch.reset()
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

    """

    def __init__(self, count: int, episodes: int, with_nodes: bool) -> None:
        self.count, self.episodes, self.with_nodes = count, episodes, with_nodes
        self.sums: dict[str, Array] = {}
        self.most: dict[str, Array] = {}
        self.compared = 0
        self.rows: defaultdict[str, list[Array]] = defaultdict(list)

    def arrays(self) -> dict[str, Array]:
        """Return all arrays by name."""
        compared = ("encloses", "encloses_plane", "node_bounded")
        means = {
            name: value / (self.compared if name in compared else STEPS)
            for name, value in self.sums.items()
        }
        series = {name: np.stack(rows, axis=1) for name, rows in self.rows.items()}
        return means | self.most | series

    def add(self, step: Step) -> None:
        """Add a step."""
        truth, estimate = step.state.plant.truth, step.state.estimate
        joint = estimate.joint
        claimed, actual = estimate.covariances[0], joint[0, 0]
        error = truth - estimate.means[0]
        deviation = np.sqrt(linalg.diagonal(actual))
        bound = np.sqrt(linalg.diagonal(claimed))
        mse, traces = (error**2).sum(0), (linalg.trace(actual), linalg.trace(claimed))
        largest = _largest(actual, claimed)
        start = truth - _START
        self._add(
            mse=mse, actual=traces[0], conservative=traces[1],
            inside=np.abs(error) <= 3.0 * deviation, ordered=deviation <= bound * (1.0 + _ROUNDING),
            bounded=largest <= 1.0 + _ROUNDING, whitened=whitened_square(error, claimed),
            square=error**2, level=start**2,
            beats=traces[1] <= linalg.trace(estimate.covariances[1:]),
        )  # fmt: skip
        self._most(worst=largest)
        for name, value in zip(("mse", "actual", "conservative"), (mse, *traces), strict=True):
            self.rows[f"{name}_steps"].append(self._lanes(value).mean(-1))
        if self.with_nodes:
            self._add(node_mse=((truth - estimate.means[1:]) ** 2).sum(1))
        if step.number % _EVERY == 0:
            self._compare(step)

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
            actual = estimate.joint[own, own]
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
