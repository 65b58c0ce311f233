"""Rules tuned on a fitted plant and measured on the held-out part of its log.

The target is a rate, at which errors are compared, or a tolerance, which the least packets keep.
The fitted part selects what keeps it. At the target, the held-out part is replayed in one piece.
Elsewhere, windows begin with steps that do not count, because their first state is known.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from joblib import Memory
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import minimize

from fusion_gym import seeds
from fusion_gym.arrays import Array
from fusion_gym.core.task import Task
from fusion_gym.entries import Options
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import run_episodes, seeded
from fusion_gym.evaluation.metrics import LEVEL, RESAMPLES, Interval
from fusion_gym.policies.base import decide, owner_of
from fusion_gym.policies.registry import make_policy
from fusion_gym.recordings.environment import WindowNoise
from fusion_gym.validation import LONGEST_HORIZON

ENV = "fusion_gym/RecordedFusion-v1"
FACTORS = 0.5, 0.7, 1.0, 1.4, 2.0  # of the target rate, or of 1 / tolerance²
HELD = "held values"
METHODS = {  # name: filter, and whether every sensor has its own threshold
    HELD: ("hold", False),
    "held values, one per sensor": ("hold", True),
    "silence ignored, one per sensor": ("joint", True),
    "silence used": ("truncated", False),
    "silence used, one per sensor": ("truncated", True),
    "centralised": ("joint", False),
}
_EPISODES, _TRIALS = 32, 150
_FAR, _NEAR, _CLOSE = 7.0, 1.5, 0.02  # reaches and tolerance of the logarithm of a common scale
_QUIET, _BUSY = 0.6, 0.8  # changes of logarithms where one sensor speaks for the others
_REACH = 3.0  # of the logarithm of a sensor's threshold, from the common scale
_BLOCK = 5  # windows of a block of the bootstrap
Work = dict[str, tuple[int, int]]  # most calls of a function, and steps of a call


class Trial(NamedTuple):
    """A method's error, packets per sensor and step, and each channel's root mean square error."""

    error: float
    rate: float
    deviations: list[float]


class Replay(NamedTuple):
    """W windows of the log: errors (W,), packets per step (W, l) and root mean square errors (l,).

    The mean of the errors is the weighted mean of the squared errors at the steps with a reading.
    """

    errors: Array
    rates: Array
    deviations: Array


@dataclass(frozen=True)
class FieldStudy:
    """A log with its plant, and the target of the rules.

    Args:
        options: options of RecordedFusion: plant, log and share.
        rate: packets per sensor and step.
        shape: thresholds of one scale (sensors,), in the channels' units.
        horizon: steps of a window.
        source: source of the process noise of tuning and training.
        tolerance: largest root mean square error of each channel, in its unit; empty for the rate.
        steps: step and largest value of each sensor's threshold; empty for any value.
        lengths: steps of the fitted and of the held-out part.
        longest: most steps between two reports that a device holds.
        trials: folder of finished simulations; None for none.
    """

    options: Mapping[str, Any]
    rate: float
    shape: tuple[float, ...]
    horizon: int
    source: str
    tolerance: tuple[float, ...] = ()
    steps: tuple[tuple[float, float], ...] = ()
    lengths: tuple[int, int] = (0, 0)
    longest: float = math.inf
    trials: Path | None = None

    @property
    def max_interval(self) -> int:
        """Most steps between two reports: a tenth of the packets, if nothing changes."""
        return int(min(round(10.0 / self.rate), self.longest))

    def excess(self, deviations: Sequence[float]) -> float:
        """Return the largest ratio of a channel's error and its tolerance."""
        return float(np.max(np.asarray(deviations) / self.tolerance))

    def sends_enough(self, trial: Trial, factor: float) -> bool:
        """Return whether thresholds may grow: above a multiple of the rate, or in the tolerance."""
        if self.tolerance:
            return self.excess(trial.deviations) <= factor**-0.5
        return trial.rate > factor * self.rate

    def order(self, trial: Trial) -> tuple[float, float]:
        """Return what decides between trials: to keep the tolerance, then few packets."""
        return max(self.excess(trial.deviations), 1.0), trial.rate

    def quantize(self, sizes: Array) -> Array:
        """Return sizes as a device holds them, in its steps or else with four digits."""
        limits = np.array(self.steps or [(0.0, math.inf)] * len(sizes))[: len(sizes)]
        step = np.where(limits[:, 0] > 0.0, limits[:, 0], 10.0 ** (np.floor(np.log10(sizes)) - 3))
        values = np.minimum(np.maximum(np.round(sizes / step), 1.0) * step, limits[:, 1])
        return np.array([float(f"{value:.9g}") for value in values])

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return a function's result, which an interrupted study keeps."""
        return Memory(self.trials, verbose=0).cache(function)(self, *arguments)

    def replay(
        self, source: str, filter_name: str, options: Mapping[str, Any], rule: str,
        whole: bool = False,
    ) -> Replay:  # fmt: skip
        """Return a rule's results on a part of the log, in windows or as a whole."""
        length, first = self.lengths[source == "recorded"], 0
        if whole:
            horizon = (length - 1) // math.ceil((length - 1) / LONGEST_HORIZON) - 1
        else:
            first = min(self.max_interval, length // 4)
            horizon = min(first + max(self.horizon, first), length - 2)
        task = self.task(filter_name, source, **{**options, "horizon": horizon})
        policy, noise = make_policy(rule, task), cast(WindowNoise, task.noise)
        batch = seeded(task, owner_of(policy), np.arange(noise.count))
        sums = np.zeros((3, noise.count, len(self.shape)))
        for step, requests in enumerate(decide(policy, batch, 0)):
            outcome, known = batch.step(requests), cast(Any, batch.delivered.known)
            if step >= first:
                sums += [part[: len(self.shape)].T
                         for part in (outcome.squared_error, known, outcome.granted)]  # fmt: skip
        squared, readings, packets = sums
        weights = np.array(self.options["state_weights"])[: len(self.shape)]
        squared = squared / readings.mean(0)
        return Replay(squared @ weights, packets / (horizon - first), np.sqrt(squared.mean(0)))

    def task(self, filter_name: str, source: str, **options: Any) -> Task:
        """Return the task of a filter, in which a packet costs one token."""
        free = {"tokens": "unlimited", "token_cost": 1.0, "reward_scale": None}
        free |= {"horizon": self.horizon, "filter": filter_name, "source": source}
        return make_task(ENV, **{**self.options, **free, **options})


@dataclass(frozen=True)
class MethodPoint:
    """A method at one setting: its sizes, and error and packets in simulation and each window.

    Args:
        thresholds: threshold of each sensor, or one, or the price of an agent.
        simulated_error: error in the simulation that tuned it.
        errors: error of each window (W,), relative to the channels' variance.
        rates: packets per step of each window and sensor (W, sensors).
        order: excess over the tolerance and packets on the fitted part; empty for a rate.
        packets: packets per step of each sensor on the whole held-out part, at the target alone.
        deviations: root mean square error of each channel there, in its unit.
    """

    thresholds: list[float]
    simulated_error: float
    errors: list[float]
    rates: list[list[float]]
    order: list[float]
    packets: list[float] = field(default_factory=list)
    deviations: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class MethodResult:
    """A method compared with held values on the held-out part.

    Args:
        name: the method.
        error: its error at the target rate.
        relative: difference of its error to the error of held values at equal packets, as a share.
        packets: its packets at the error of held values, over their packets.
        ratio: real over simulated error, each at the same setting.
    """

    name: str
    error: float
    relative: Interval
    packets: float
    ratio: float


def work(study: FieldStudy, name: str) -> Work:
    """Return the work of a method, or of an agent, whose prices are at two rates."""
    far, near = (math.ceil(math.log2(2.0 * reach / _CLOSE)) for reach in (_FAR, _NEAR))
    window, trials = study.max_interval + max(study.horizon, study.max_interval), 2 * far
    if name in METHODS:
        each = METHODS[name][1]
        trials = far + len(FACTORS) * near + each * (_TRIALS + 1 + len(study.shape))
        trials += far * (1 + each) * bool(study.tolerance)
    length = study.horizon + window * (1 + bool(study.tolerance))
    measured = {"point_at": (len(FACTORS), length), "replay_whole": (1, study.lengths[1])}
    return {"run_trial": (trials, study.horizon), **measured}


def measure(study: FieldStudy, name: str) -> list[MethodPoint]:
    """Tune a method at the target, and measure it there and around it."""
    shape = np.ones(1) if name == "centralised" else np.array(study.shape)
    middle = scale(study, name, shape)
    if METHODS[name][1]:
        start = np.log(middle)

        def objective(change: Array) -> float:
            trial = study.call(run_trial, name, np.exp(start + change), study.source)
            rate = max(trial.rate, 1e-3 * study.rate) / study.rate
            cost, ratio = trial.error, rate
            if study.tolerance:
                cost, ratio = rate, max(study.excess(trial.deviations), 1e-3)
            return float(np.log(cost) + 4.0 * np.log(ratio) ** 2)

        # The common scale, and one sensor that speaks for the others: Powell ends in the nearest
        # minimum.
        single = _QUIET - (_QUIET + _BUSY) * np.eye(len(shape))
        first = min([np.zeros(len(shape)), *single], key=objective)
        bounds: Any = [(-_REACH, _REACH)] * len(shape)
        limits: Any = {"maxfev": _TRIALS, "xtol": 0.05, "ftol": 0.005}
        best = minimize(objective, first, method="Powell", bounds=bounds, options=limits)
        middle = np.exp(start + best.x)
    sizes = [scale(study, name, middle, factor, _NEAR) for factor in FACTORS]
    if study.tolerance:
        shapes = [middle, shape] if METHODS[name][1] else [middle]
        each = [scale(study, name, own, 1.0, _FAR, "fitted") for own in shapes]
        trials = [study.call(run_trial, name, own, "fitted") for own in each]
        orders = [study.order(trial) for trial in trials]
        sizes[len(sizes) // 2] = each[orders.index(min(orders))]
    rules = [(own.tolist(), METHODS[name][0], *rule_of(study, name, own))
             for own in map(study.quantize, sizes)]  # fmt: skip
    return measured(study, rules, len(rules) // 2)


def measured(
    study: FieldStudy, rules: Sequence[tuple[Any, ...]], target: int | None = None
) -> list[MethodPoint]:
    """Return the points of rules, as arguments of ``point_at``, one as a whole.

    Without a target it is the point that keeps the tolerance on the fitted part.
    """
    points = [study.call(point_at, *own) for own in rules]
    if target is None:
        target = min(range(len(points)), key=lambda place: points[place].order)
    replay = study.call(replay_whole, *rules[target][1:])
    points[target] = replace(
        points[target], packets=replay.rates.mean(0).tolist(), deviations=replay.deviations.tolist()
    )
    return points


def rule_of(study: FieldStudy, name: str, sizes: Array) -> tuple[Options, str]:
    """Return the options and the text of a method's rule."""
    if name == "centralised":
        return {}, f"value_of_information:threshold={float(sizes[0])!r},at_most=1"
    thresholds = study.quantize(sizes).tolist()
    text = "/".join(map(repr, thresholds))
    rule = f"report_on_change:reportable_change={text},max_interval={study.max_interval}"
    if METHODS[name][0] != "truncated":
        return {}, rule
    return {"trigger": "report_on_change", "trigger_threshold": thresholds}, rule


def point_at(
    study: FieldStudy, sizes: list[float], filter_name: str, options: Mapping[str, Any], rule: str
) -> MethodPoint:
    """Return a rule's results in simulation and on windows of the held-out part."""
    task = study.task(filter_name, study.source, **options)
    simulated = run_episodes(task, make_policy(rule, task), 4 * _EPISODES, 0)
    windows = study.replay("recorded", filter_name, options, rule)
    order = list[float]()
    if study.tolerance:
        order += study.order(_trial(study.replay("fitted", filter_name, options, rule)))
    error = float(simulated.error_cost.mean())
    return MethodPoint(sizes, error, windows.errors.tolist(), windows.rates.tolist(), order)


def replay_whole(
    study: FieldStudy, filter_name: str, options: Mapping[str, Any], rule: str
) -> Replay:
    """Return a rule's results on the whole held-out part."""
    return study.replay("recorded", filter_name, options, rule, whole=True)


def _trial(replay: Replay) -> Trial:
    error, rate = float(replay.errors.mean()), float(replay.rates.mean())
    return Trial(error, rate, replay.deviations.tolist())


def run_trial(study: FieldStudy, name: str, sizes: Array, source: str) -> Trial:
    """Return the results on the tuning episodes, or on windows of a part of the log."""
    filter_name, (options, rule) = METHODS[name][0], rule_of(study, name, sizes)
    if source in ("fitted", "recorded"):
        return _trial(study.replay(source, filter_name, options, rule))
    task = study.task(filter_name, source, **options)
    results = run_episodes(task, make_policy(rule, task), _EPISODES, seeds.FIELD.start)
    squared = results.squared_error.mean(0)[: len(study.shape)]
    error, rate = float(results.error_cost.mean()), float(results.rate.mean())
    return Trial(error, rate, np.sqrt(squared).tolist())


def scale(
    study: FieldStudy, name: str, shape: Array, factor: float = 1.0, reach: float = _FAR,
    source: str | None = None,
) -> Array:  # fmt: skip
    """Return the largest sizes of this shape, within a factor exp(reach), that send enough."""
    low, high = -reach, reach
    while high - low > _CLOSE:
        middle = 0.5 * (low + high)
        trial = study.call(run_trial, name, np.exp(middle) * shape, source or study.source)
        if study.sends_enough(trial, factor):
            low = middle
        else:
            high = middle
    return np.exp(low) * shape


def compare_with_held(
    study: FieldStudy, points: Mapping[str, Sequence[MethodPoint]]
) -> list[MethodResult]:
    """Compare all methods with held values at equal packets, with block-bootstrap intervals.

    Args:
        study: the log.
        points: points of each method.
    """
    curves = {name: (np.array([point.errors for point in own]),
                     np.array([np.mean(point.rates, axis=1) for point in own]))
              for name, own in points.items()}  # fmt: skip
    windows = curves[HELD][0].shape[1]
    whole = np.arange(windows, dtype=np.int64)
    blocks = np.array_split(whole, max(windows // _BLOCK, 1))
    results = []
    for name, own in points.items():
        middle = own[len(own) // 2]

        def relative(sample: Any, name: str = name) -> float:
            places = np.concatenate([blocks[int(block)] for block in sample])
            least = _error_at(*curves[HELD], study.rate, places)
            return _error_at(*curves[name], study.rate, places) / least - 1.0

        numbers = np.arange(len(blocks))
        mean = relative(numbers)
        low = high = mean
        if name != HELD and len(blocks) > 1:
            ends = stats.bootstrap(
                (numbers,), relative, vectorized=False, n_resamples=RESAMPLES,
                confidence_level=LEVEL, method="percentile", rng=np.random.default_rng(0),
            ).confidence_interval  # fmt: skip
            low, high = float(ends.low), float(ends.high)
        error = _error_at(*curves[name], study.rate, whole)
        held = _error_at(*curves[HELD], study.rate, whole)
        packets = _rate_at(*curves[name], held, whole) / study.rate
        ratio = float(np.mean(middle.errors)) / middle.simulated_error
        results.append(MethodResult(name, error, Interval(mean, low, high), packets, ratio))
    return results


def _line(errors: Array, rates: Array, places: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return logarithms of rate and error, in the order of the rates."""
    rate, error = (
        np.log(np.maximum(values[:, places].mean(1), 1e-12)) for values in (rates, errors)
    )
    order = np.argsort(rate)
    return rate[order], error[order]


def _error_at(errors: Array, rates: Array, rate: float, places: NDArray[np.int64]) -> float:
    return float(np.exp(np.interp(np.log(rate), *_line(errors, rates, places))))


def _rate_at(errors: Array, rates: Array, error: float, places: NDArray[np.int64]) -> float:
    """Return the rate with an error, beyond the measured rates along the last two."""
    rate, level = _line(errors, rates, places)
    if np.log(error) > level[0]:  # fewer packets than measured
        slope = (level[1] - level[0]) / (rate[1] - rate[0])
        return float(np.exp(rate[0] + (np.log(error) - level[0]) / min(slope, -1e-9)))
    return float(np.exp(np.interp(-np.log(error), -level, rate)))
