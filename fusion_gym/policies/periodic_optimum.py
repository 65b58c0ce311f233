"""The best periodic schedule, a reference for covariances that do not depend on the data."""

import hashlib
import itertools
import math
import pickle
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.estimator import Reception
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Requests, Stateless
from fusion_gym.systems.solvable import BoundingEstimator

_MOST = 200_000  # schedules of one search
_TOGETHER = 4096  # schedules in one batch
_LONGEST = 1000  # steps until traces settle, at most
_SETTLED = 1e-9  # relative change of a settled trace from one cycle to the next
AVERAGES = ("steady", "episode")

Patterns = NDArray[np.bool_]


class Schedule(NamedTuple):
    """Requests (period, sensors) bool from the start of an episode, and their mean ``trace``."""

    requests: Patterns
    trace: float


_cache: dict[str, Schedule] = {}


class PeriodicOptimum(Stateless):
    r"""Repeat the schedule of ``packets`` requests in ``period`` steps with the smallest trace.

    The search compares all schedules by the system's own recursion, since their phase against the
    sensors' sampling and the start matters. The policy uses only the clock. It supposes that every
    request is granted; under a token limit the network may deny some requests.

    The trace is the unweighted trace of the covariance of the fused error:

    - the actual covariance, so the trace is the mean squared error, if the system can compute it
      (CorrelatedTracking-v1; the mean over scales where the noise scale is drawn);
    - else the estimated covariance. Its trace is the mean squared error in MarkovJumpTracking-v1
      with matrix weights or at a centre, and for uncensored Kalman filters with federated
      fusion. Under covariance intersection it is a bound, and in UnknownInput-v1 it relies on
      the filter's model of the input. There the best schedule need not have the smallest
      error.

    ``average="steady"`` takes the mean over the steady state, for episodes that are long against
    the transient. ``"episode"`` takes the mean over the task's horizon from the start, as an
    evaluation does; it is the right choice where the plant or a node never settles.

    The process caches the result of a search.

    Args:
        task: the task; a text cannot set it.
        packets: q, the requests of all sensors in a period.
        period: p, in steps.
        average: ``steady`` for the steady state, or ``episode`` for an episode from its start.

    Raises:
        ConfigurationError: a number that is not allowed, more schedules than can be compared, a
            task whose access is not "any", or a system whose covariances depend on the data
            (without a ``covariance_cycle``).

    Equation:
        $$
        \min_{\pi}\ \frac{1}{T}\sum_{t=1}^{T}\mathrm{tr}\,P_t(\pi)\qquad \text{over
        all}\ \pi\in\{0,1\}^{p\times l}\ \text{with}\ \sum\pi=q
        $$

        π is repeated every p (``period``) steps and has q (``packets``) requests of l sensors. The
        mean is over the steady state or an episode (``average``).

    Assumes: covariances that depend on no data, and that every request is granted.

    Source: exhaustive search, no single paper. L. Zhao, W. Zhang, J. Hu, A. Abate and
    C. J. Tomlin, "On the optimal solutions of the infinite-horizon linear sensor scheduling
    problem", IEEE Trans. Automatic Control 59, 2014, show that periodic schedules come arbitrarily
    near the optimum.

    Example: ``periodic_optimum:packets=2,period=6`` in ``fusion_gym/MarkovJumpTracking-v1``.
    """

    knowledge: ClassVar[Knowledge] = "clock"

    def __init__(
        self, task: Task, packets: int = 4, period: int = 6, average: str = "steady"
    ) -> None:
        validation.integer("period", period, at_least=1, at_most=validation.MOST_STEPS)
        validation.integer("packets", packets, at_least=1, at_most=period * task.sensors)
        validation.choice("average", average, AVERAGES)
        if task.options.access != "any":
            where = "with policy 'periodic_optimum'"
            allowed = "'any', because the search grants every request"
            raise validation.refusal("access", task.options.access, allowed, where)
        _cycle(task)
        count = math.comb(period * task.sensors, packets)
        if count > _MOST:
            raise validation.ConfigurationError(
                f"packets = {packets} with period = {period} and {task.sensors} sensors is not "
                f"allowed: these are {count} schedules, but the search compares at most {_MOST}; "
                "use a smaller period"
            )
        steps = task.horizon if average == "episode" else None
        self.schedule, self.trace = optimum(task, packets, period, steps)

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        place = np.asarray(signals["step"]) % len(self.schedule)
        return np.ascontiguousarray(self.schedule[place].T)


def optimum(task: Task, packets: int, period: int, steps: int | None = None) -> Schedule:
    """Return the schedule with the smallest trace, from the cache if it is known.

    Of equal traces (to a relative 1e-9) the first schedule in the order of steps and sensors wins.

    Args:
        task: its estimator declares a ``covariance_cycle``.
        packets: requests of all sensors in a period.
        period: number of steps of the schedule.
        steps: number of steps of the mean from the start; None for the steady state.

    Raises:
        ConfigurationError: the covariances depend on the data.
    """
    parts = task.plant, task.estimator, packets, period, steps
    key = hashlib.sha256(pickle.dumps(parts)).hexdigest()
    if key not in _cache:
        _cache[key] = _search(task, packets, period, steps)
    return _cache[key]


def steady_traces(task: Task, schedules: Patterns) -> Array:
    """Return the steady-state traces (N,) of the fused error's covariance under periodic schedules.

    The plant runs without noise, one run per schedule, since the covariances do not depend on the
    data. A cycle is the common period of schedules and sampling. The mean is over the first cycle
    that differs in all runs by less than a relative 1e-9 from the cycle before. After 1,000 steps
    it is over the last cycle, which is no steady state where the plant or a node never settles.

    Args:
        task: its estimator declares a ``covariance_cycle``.
        schedules: (period, sensors, N) bool, row 0 for the first step of an episode.

    Raises:
        ConfigurationError: the covariances depend on the data.
    """
    length = math.lcm(len(schedules), _cycle(task))
    run = _Still(task, schedules)
    before = np.full(schedules.shape[-1], np.inf)
    for _ in range(0, _LONGEST, length):
        total = run.total(length)
        settled = np.abs(total - before) <= _SETTLED * total
        before = total
        if settled.all():
            break
    return np.asarray(before / length)


def episode_traces(task: Task, schedules: Patterns, steps: int) -> Array:
    """Return traces (N,) as in :func:`steady_traces`, averaged over the first ``steps`` steps."""
    _cycle(task)
    return _Still(task, schedules).total(steps) / steps


class _Still:
    """Runs without noise from the start, one per schedule (period, sensors, N)."""

    def __init__(self, task: Task, schedules: Patterns) -> None:
        estimator: Any = task.estimator
        self._covariance: Callable[[Any], Array] = estimator.covariance
        if isinstance(estimator, BoundingEstimator):
            estimator = estimator.with_actual_covariance()
            self._covariance = estimator.error_covariance
        self._plant, self._estimator = task.plant, estimator
        self._schedules, self._step = schedules, 0
        runs = schedules.shape[-1]
        self._still = np.zeros((task.plant.noise_channels, runs))
        start = np.zeros((task.plant.start_channels, runs))
        self._truth, announcement = task.plant.start(start)
        self._state = estimator.start(task.plant.measurement(self._truth), announcement)

    def total(self, steps: int) -> Array:
        """Return the sum (N,) of the traces over the next ``steps`` steps."""
        total = np.zeros(self._schedules.shape[-1])
        for step in range(self._step, self._step + steps):
            reception = Reception(self._schedules[step % len(self._schedules)])
            self._truth = self._plant.sense(self._truth, self._still)
            measurement = self._plant.measurement(self._truth)
            state = self._estimator.observe(self._estimator.predict(self._state), measurement)
            self._state = self._estimator.update(state, reception)
            total += linalg.trace(self._covariance(self._state))
        self._step += steps
        return total


def _search(task: Task, packets: int, period: int, steps: int | None) -> Schedule:
    sensors = task.sensors
    places = period * sensors
    every = itertools.combinations(range(places), packets)
    best, trace = np.zeros((period, sensors), dtype=np.bool_), math.inf
    while part := list(itertools.islice(every, _TOGETHER)):
        schedules = np.zeros((places, len(part)), dtype=np.bool_)
        for number, selection in enumerate(part):
            schedules[list(selection), number] = True
        shaped = schedules.reshape(period, sensors, -1)
        traces = episode_traces(task, shaped, steps) if steps else steady_traces(task, shaped)
        first = int(np.flatnonzero(traces <= traces.min() * (1.0 + 1e-9))[0])
        if traces[first] < trace * (1.0 - 1e-9):
            best, trace = schedules[:, first].reshape(period, sensors), float(traces[first])
    return Schedule(best, trace)


def _cycle(task: Task) -> int:
    estimator = task.estimator
    if task.network.channel is not None and task.network.channel.loses:
        allowed = "'perfect', because the schedule supposes arrivals"
        raise validation.refusal("channel", task.settings["channel"], allowed)
    task.refuse_delay("the schedule supposes arrivals in the step of a request")
    if estimator.covariance_cycle is None:
        raise validation.ConfigurationError(
            f"policy 'periodic_optimum' is not allowed with {type(estimator).__name__}: its "
            "covariances must depend only on deliveries, as in MarkovJumpTracking-v1 with "
            "filter='local' or 'centralised', CorrelatedTracking-v1 without a schedule, or "
            "UnknownInput-v1 with filter='random_walk' or 'predict'"
        )
    return estimator.covariance_cycle
