"""The best periodic schedule of all: a reference for systems whose covariances need no data."""

import itertools
import math
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.system import Knowledge, Signals, System
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Requests
from fusion_gym.policies.schedule_file import (
    Patterns,
    Schedule,
    load_schedule,
    schedule_key,
    store_schedule,
)
from fusion_gym.validation import ConfigurationError

_MOST = 200_000  # schedules that one search may compare
_TOGETHER = 4096  # schedules side by side
_LONGEST = 1000  # steps after which traces that have not settled are taken as they are
_SETTLED = 1e-9  # relative change from one cycle to the next below which they have
AVERAGES = ("steady", "episode")

_found: dict[str, Schedule] = {}


class PeriodicOptimum:
    r"""Repeat the schedule of ``packets`` requests in ``period`` steps with the smallest trace.

    All schedules are compared by the system's own recursion, whatever it costs: the phase against
    the sensors' sampling and the start matters, so none is left out. It looks at no signal but the
    clock, and supposes that every request is granted; under a token limit the network may deny
    some.

    The trace is the plain one of the fused error's covariance:

    - the actual covariance, thus the mean squared error, if the system claims only a bound but
      can tell (CorrelatedTracking-v1; where the noise scale is drawn, the mean over scales);
    - else the claimed one. It is the mean squared error in MarkovJumpTracking-v1 with matrix
      weights or at a centre, and of uncensored Kalman filters with federated fusion. Under
      covariance intersection it is a bound, and in UnknownInput-v1 a claim under the filter's
      model of the input, so the best schedule by the claim need not have the smallest error.

    ``average="steady"`` takes its mean over the steady state and supposes that an episode is long
    against the transient from the start. ``"episode"`` takes the mean over the task's horizon from
    the start, transient included: what an evaluation measures, and the right choice where the
    plant or a node never settles.

    The result of a search is kept while the process lives, and with ``cache``, a path, in a file.

    Args:
        packets: q, the requests of all sensors in a period.
        period: p, in steps.
        cache: path of a file that keeps the schedule; None for none.
        average: ``steady`` for the steady state, or ``episode`` for an episode from its start.

    Raises:
        ConfigurationError: a number that is not allowed, more schedules than can be compared, a
            task whose access is not "any", or a system whose covariances depend on the data (it
            declares the contrary by a ``covariance_cycle`` that is not None).

    Equation:
        $$
        \min_{\pi}\ \frac{1}{T}\sum_{t=1}^{T}\mathrm{tr}\,P_t(\pi)\qquad \text{over
        all}\ \pi\in\{0,1\}^{p\times l}\ \text{with}\ \sum\pi=q
        $$

        π is repeated every p (``period``) steps and has q (``packets``) requests of l sensors. The
        mean is over the steady state or an episode (``average``).

    Assumes: covariances that depend on no data, and that every request is granted.

    Source: none of one paper; exhaustive search. That a periodic schedule comes arbitrarily
    near the best of all: L. Zhao, W. Zhang, J. Hu, A. Abate and C. J. Tomlin, "On the optimal
    solutions of the infinite-horizon linear sensor scheduling problem", IEEE Trans. Automatic
    Control 59, 2014.

    Example: ``periodic_optimum:packets=2,period=6`` in ``fusion_gym/MarkovJumpTracking-v1``.
    """

    knowledge: ClassVar[Knowledge] = "clock"
    stateless: ClassVar[bool] = True

    def __init__(
        self,
        task: Task,
        packets: int = 4,
        period: int = 6,
        cache: str | None = None,
        average: str = "steady",
    ) -> None:
        validation.integer("period", period, at_least=1, at_most=validation.MOST_STEPS)
        validation.integer("packets", packets, at_least=1, at_most=period * task.sensors)
        validation.choice("average", average, AVERAGES)
        if cache is not None and not isinstance(cache, str):
            raise ConfigurationError(f"cache = {cache!r} is not allowed: it must be a path")
        if task.access != "any":
            raise ConfigurationError(
                f"access = {task.access!r} is not allowed with policy 'periodic_optimum': it must "
                "be 'any', for the search grants every request"
            )
        _cycle(task.system)
        count = math.comb(period * task.sensors, packets)
        if count > _MOST:
            raise ConfigurationError(
                f"packets = {packets} with period = {period} and {task.sensors} sensors is not "
                f"allowed: of {count} schedules at most {_MOST} can be compared, so period must "
                "be smaller"
            )
        steps = task.horizon if average == "episode" else None
        self.schedule, self.trace = optimum(task.system, packets, period, cache, steps)

    def reset(self, runs: int, seed: int = 0) -> None:
        """Nothing to forget."""

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        place = np.asarray(signals["step"]) % len(self.schedule)
        return np.ascontiguousarray(self.schedule[place].T)


def optimum(
    system: System[Any],
    packets: int,
    period: int,
    cache: str | None = None,
    steps: int | None = None,
) -> Schedule:
    """The schedule with the smallest trace, from memory or ``cache`` if it is known.

    The trace is averaged over the first ``steps`` steps from the start; ``None`` stands for the
    steady state. Of equal traces (to a relative 1e-9) the first in the order of its steps and
    sensors wins.

    Raises:
        ConfigurationError: the system's covariances depend on the data.
    """
    key = schedule_key(system, packets, period, steps)
    if key not in _found:
        stored = load_schedule(cache, key, packets, (period, system.sensor_count))
        _found[key] = _search(system, packets, period, steps) if stored is None else stored
    if cache is not None:
        store_schedule(cache, key, _found[key])
    return _found[key]


def steady_traces(system: System[Any], schedules: Patterns) -> Array:
    """Plain traces (N,) of the fused error's covariance, settled, of periodic schedules.

    The system runs without noise, one run a schedule: its covariances do not depend on the data.
    The average is over the common period of schedules and sampling, the first one that differs
    by less than 1e-9 from the one before in all runs, or the one in which step 1,000 lies. That
    is no steady state where the plant or a node never settles.

    Args:
        system: declares a ``covariance_cycle``.
        schedules: (period, sensors, N) bool, row 0 for the first step of an episode.

    Raises:
        ConfigurationError: the system's covariances depend on the data.
    """
    length = math.lcm(len(schedules), _cycle(system))
    run = _Still(system, schedules)
    before = np.full(schedules.shape[-1], np.inf)
    for _ in range(0, _LONGEST, length):
        total = run.total(length)
        settled = np.abs(total - before) <= _SETTLED * total
        before = total
        if settled.all():
            break
    return np.asarray(before / length)


def episode_traces(system: System[Any], schedules: Patterns, steps: int) -> Array:
    """Plain traces (N,) as in :func:`steady_traces`, averaged over ``steps`` steps from the start.

    Raises:
        ConfigurationError: the system's covariances depend on the data.
    """
    _cycle(system)
    return _Still(system, schedules).total(steps) / steps


class _Still:
    """Runs without noise from the start, one a schedule (period, sensors, N)."""

    def __init__(self, system: System[Any], schedules: Patterns) -> None:
        self._covariance: Callable[[Any], Array] = lambda state: system.fused(state)[1]
        self._system, self._schedules, self._step = system, schedules, 0
        if system.offers("error_covariance"):
            self._system = system.with_actual_covariance()
            self._covariance = self._system.error_covariance
        runs = schedules.shape[-1]
        self._still = np.zeros((system.noise_channels, runs))
        self._state = self._system.start(np.zeros((system.start_channels, runs)))

    def total(self, steps: int) -> Array:
        """Sum (N,) of the traces over the next ``steps`` steps."""
        total = np.zeros(self._schedules.shape[-1])
        for step in range(self._step, self._step + steps):
            delivered = self._schedules[step % len(self._schedules)]
            sensed = self._system.sense(self._state, self._still)
            self._state = self._system.deliver(sensed, delivered)
            total += linalg.trace(self._covariance(self._state))
        self._step += steps
        return total


def _search(system: System[Any], packets: int, period: int, steps: int | None) -> Schedule:
    sensors = system.sensor_count
    places = period * sensors
    every = itertools.combinations(range(places), packets)
    best, trace = np.zeros((period, sensors), dtype=np.bool_), math.inf
    while part := list(itertools.islice(every, _TOGETHER)):
        schedules = np.zeros((places, len(part)), dtype=np.bool_)
        for number, selection in enumerate(part):
            schedules[list(selection), number] = True
        shaped = schedules.reshape(period, sensors, -1)
        if steps is None:
            traces = steady_traces(system, shaped)
        else:
            traces = episode_traces(system, shaped, steps)
        first = int(np.flatnonzero(traces <= traces.min() * (1.0 + 1e-9))[0])
        if traces[first] < trace * (1.0 - 1e-9):
            best, trace = schedules[:, first].reshape(period, sensors), float(traces[first])
    return Schedule(best, trace)


def _cycle(system: System[Any]) -> int:
    if not system.offers("covariance_cycle"):
        raise ConfigurationError(
            f"policy 'periodic_optimum' is not allowed with {type(system).__name__}: it must be a "
            "system whose covariances do not depend on the data but on what is delivered, such as "
            "MarkovJumpTracking-v1 with filter='local' or 'centralised', CorrelatedTracking-v1, "
            "or UnknownInput-v1 with filter='random_walk' or 'predict'"
        )
    return system.covariance_cycle
