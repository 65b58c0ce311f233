"""Rules tuned on a fitted plant and measured on the held-out part of its log, at equal packets."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import minimize

from fusion_gym import seeds
from fusion_gym.arrays import Array
from fusion_gym.core.task import Task
from fusion_gym.entries import Options
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.evaluation.metrics import LEVEL, RESAMPLES, Interval
from fusion_gym.policies.registry import make_policy

ENV = "fusion_gym/RecordedFusion-v1"
FACTORS = 0.5, 0.7, 1.0, 1.4, 2.0  # of the target rate
PRACTICE = "practice"
METHODS = {  # name: filter, and whether every sensor has its own threshold
    PRACTICE: ("hold", False),
    "practice, one a sensor": ("hold", True),
    "silence ignored, one a sensor": ("joint", True),
    "silence used": ("truncated", False),
    "silence used, one a sensor": ("truncated", True),
    "centralised": ("joint", False),
}
_EPISODES, _TRIALS = 32, 150
_FAR, _NEAR, _CLOSE = 7.0, 1.5, 0.02  # reaches and tolerance of the logarithm of a common scale
_QUIET, _BUSY = 0.6, 0.8  # changes of logarithms where one sensor speaks for the others
_REACH = 3.0  # of the logarithm of a sensor's threshold, from the common scale
_BLOCK = 5  # windows of a block of the bootstrap


@dataclass(frozen=True)
class FieldStudy:
    """A log with its plant, and the rate at which rules are compared.

    Args:
        options: options of RecordedFusion: plant, log and share.
        rate: packets a sensor and step.
        shape: typical change of each channel in ten steps (sensors,), in its unit.
        horizon: steps of a window.
        source: source of the process noise of tuning and training.
    """

    options: Mapping[str, Any]
    rate: float
    shape: tuple[float, ...]
    horizon: int
    source: str

    @property
    def max_interval(self) -> int:
        """Most steps between two reports: a tenth of the packets, if nothing changes."""
        return round(10.0 / self.rate)

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
        rates: packets a step of each window and sensor (W, sensors).
        deviations: root mean square error of each channel, in its unit.
    """

    thresholds: list[float]
    simulated_error: float
    errors: list[float]
    rates: list[list[float]]
    deviations: list[float]


@dataclass(frozen=True)
class MethodResult:
    """A method compared with practice on the held-out part.

    Args:
        name: the method.
        error: its error at the target rate.
        relative: difference of its error to practice's at equal packets, as a share.
        packets: its packets at practice's error over practice's packets.
        ratio: real over simulated error, each at the same setting.
    """

    name: str
    error: float
    relative: Interval
    packets: float
    ratio: float


def measure(study: FieldStudy, name: str) -> list[MethodPoint]:
    """Tune a method at the target rate, and measure it at rates around it."""
    shape = np.ones(1) if name == "centralised" else np.array(study.shape)
    middle = at_rate(study, name, shape, study.rate)
    if METHODS[name][1]:
        start = np.log(middle)

        def objective(change: Array) -> float:
            error, rate = simulate_sizes(study, name, np.exp(start + change))
            apart = np.log(max(rate, 1e-3 * study.rate) / study.rate)
            return float(np.log(error) + 4.0 * apart**2)

        # The common scale, and one sensor that speaks for the others: Powell ends in the nearest
        # minimum.
        single = _QUIET - (_QUIET + _BUSY) * np.eye(len(shape))
        first = min([np.zeros(len(shape)), *single], key=objective)
        bounds: Any = [(-_REACH, _REACH)] * len(shape)
        limits: Any = {"maxfev": _TRIALS, "xtol": 0.05, "ftol": 0.005}
        best = minimize(objective, first, method="Powell", bounds=bounds, options=limits)
        middle = np.exp(start + best.x)
    sizes = [at_rate(study, name, middle, study.rate * factor, _NEAR) for factor in FACTORS]
    return [
        point_at(study, own.tolist(), METHODS[name][0], *rule_of(study, name, own)) for own in sizes
    ]


def rule_of(study: FieldStudy, name: str, sizes: Array) -> tuple[Options, str]:
    """Return the options and the text of a method's rule."""
    if name == "centralised":
        return {}, f"value_of_information:threshold={float(sizes[0])!r},at_most=1"
    text = "/".join(repr(float(f"{size:.4g}")) for size in sizes)
    rule = f"report_on_change:reportable_change={text},max_interval={study.max_interval}"
    if METHODS[name][0] != "truncated":
        return {}, rule
    thresholds = [float(f"{size:.4g}") for size in sizes]
    return {"trigger": "report_on_change", "trigger_threshold": thresholds}, rule


def point_at(
    study: FieldStudy, sizes: list[float], filter_name: str, options: Mapping[str, Any], rule: str
) -> MethodPoint:
    """Return a rule's results in simulation and on all windows of the held-out part."""
    runs = []
    for source in (study.source, "recorded"):
        task = study.task(filter_name, source, **options)
        count = getattr(task.noise, "count", 4 * _EPISODES)
        runs.append(run_episodes(task, make_policy(rule, task), count, 0))
    return point_of(study, sizes, *runs)


def point_of(
    study: FieldStudy, sizes: list[float], simulated: EpisodeResults, real: EpisodeResults
) -> MethodPoint:
    """Return a point from the results in simulation and on the windows.

    Errors on the windows are divided by the share of readings, because others count as zero.
    """
    noise: Any = study.task("joint", "recorded").noise
    squared = real.squared_error.mean(0)[: len(study.shape)] / noise.readings.mean(0)
    weights = np.array(study.options["state_weights"])[: len(study.shape)]
    scale = float(weights @ squared) / max(float(real.error_cost.mean()), 1e-300)
    return MethodPoint(
        sizes,
        float(simulated.error_cost.mean()),
        (scale * real.error_cost).tolist(),
        real.rate.tolist(),
        np.sqrt(squared).tolist(),
    )


def simulate_sizes(study: FieldStudy, name: str, sizes: Array) -> tuple[float, float]:
    """Return error and rate in simulation, on the tuning episodes."""
    options, rule = rule_of(study, name, sizes)
    task = study.task(METHODS[name][0], study.source, **options)
    results = run_episodes(task, make_policy(rule, task), _EPISODES, seeds.FIELD.start)
    return float(results.error_cost.mean()), float(results.rate.mean())


def at_rate(study: FieldStudy, name: str, shape: Array, rate: float, reach: float = _FAR) -> Array:
    """Return sizes of this shape with the rate in simulation, within a factor exp(reach)."""
    low, high, middle = -reach, reach, 0.0
    while high - low > _CLOSE:
        middle = 0.5 * (low + high)
        if simulate_sizes(study, name, np.exp(middle) * shape)[1] > rate:
            low = middle
        else:
            high = middle
    return np.exp(middle) * shape


def compare_with_practice(
    study: FieldStudy, points: Mapping[str, Sequence[MethodPoint]]
) -> list[MethodResult]:
    """Compare all methods with practice at equal packets, with block-bootstrap intervals.

    Args:
        study: the log.
        points: points of each method.
    """
    curves = {
        name: (
            np.array([point.errors for point in own]),
            np.array([np.mean(point.rates, axis=1) for point in own]),
        )
        for name, own in points.items()
    }
    windows = curves[PRACTICE][0].shape[1]
    whole = np.arange(windows, dtype=np.int64)
    blocks = np.array_split(whole, max(windows // _BLOCK, 1))
    results = []
    for name, own in points.items():
        middle = own[len(own) // 2]

        def relative(sample: Any, name: str = name) -> float:
            places = np.concatenate([blocks[int(block)] for block in sample])
            least = _error_at(*curves[PRACTICE], study.rate, places)
            return _error_at(*curves[name], study.rate, places) / least - 1.0

        numbers = np.arange(len(blocks))
        mean = relative(numbers)
        low = high = mean
        if name != PRACTICE and len(blocks) > 1:
            ends = stats.bootstrap(
                (numbers,), relative, vectorized=False, n_resamples=RESAMPLES,
                confidence_level=LEVEL, method="percentile", rng=np.random.default_rng(0),
            ).confidence_interval  # fmt: skip
            low, high = float(ends.low), float(ends.high)
        error = _error_at(*curves[name], study.rate, whole)
        practice = _error_at(*curves[PRACTICE], study.rate, whole)
        packets = _rate_at(*curves[name], practice, whole) / study.rate
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
