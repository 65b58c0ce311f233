"""What could be known, what the centre knows, and what every transmission would be worth.

x* is the best estimate of whoever looks, x̂ the centre's if nobody transmits, x̂(s) if s alone does.
Value of a transmission: v(s) = ‖x* - x̂‖² - E‖x* - x̂(s)‖², the expectation over arrival; it can be
negative. With memory x* holds everything that its owner measured and heard
(:mod:`fusion_gym.core.memory`), without it what the centre knows and this step's measurements.

Sources: Y. Xu and J. P. Hespanha, "Optimal communication logics in networked control systems",
IEEE CDC 2004, and G. M. Lipsa and N. C. Martins, "Remote state estimation with communication costs
for first-order LTI systems", IEEE Trans. Automatic Control 56, 2011, who send when the two
estimates differ; A. Molin and S. Hirche, "On the optimality of certainty equivalence for
event-triggered control systems", IEEE Trans. Automatic Control 58, 2013, and T. Soleymani,
J. S. Baras and S. Hirche, "Value of information in feedback control: quantification", IEEE Trans.
Automatic Control 67, 2022, for its value.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array, take_runs
from fusion_gym.core.system import System
from fusion_gym.core.task import Task
from fusion_gym.fusion.intersection import covariance_intersection

Owner = Literal["scheduler", "own"]
Packets = NDArray[np.bool_]


@dataclass(slots=True)
class MemoryStates:
    """What is kept of N runs, states after sensing; ``None`` where it is not needed.

    ``every`` (N runs) has taken in all measurements · ``own`` (sensors · N runs, those of a sensor
    together) one sensor's, and what it heard · ``single`` (the same) is the centre to which that
    sensor alone has sent.
    """

    every: Any = None
    own: Any = None
    single: Any = None


@dataclass(frozen=True)
class Estimate:
    """``mean`` (k, n, N) and ``covariance`` (k, n, n, N): k = 1 for all, or one a sensor.

    Covariances may be ``source`` as a function, for they are large where there are many states.
    """

    mean: Array
    source: Array | Callable[[], Array]

    @cached_property
    def covariance(self) -> Array:
        """The covariance, computed when first looked at."""
        return self.source() if callable(self.source) else self.source

    def __iter__(self) -> Iterator[Array]:
        return iter((self.mean, self.covariance))

    def __reduce__(self) -> tuple[type[Estimate], tuple[Array, Array]]:
        """Pickled with the covariance, for a function cannot be."""
        return Estimate, (self.mean, self.covariance)


class Beliefs(ABC):
    """The estimates before anything is sent, of N runs, each computed when first looked at.

    ``arrival`` (sensors, N) is the probability that a packet sent now arrives; None: surely.
    """

    def __init__(
        self, task: Task, state: Any, memory_states: MemoryStates, best: Estimate | None = None
    ) -> None:
        if best is not None:
            vars(self)["best"] = best
        self.task, self.memory_states, self._state = task, memory_states, state
        system = task.system
        self.arrival: Array | None = None
        if system.offers("arrival_probability"):
            self.arrival = system.arrival_probability(state)
        self._runs = system.truth(state).shape[-1]

    @property
    @abstractmethod
    def silent(self) -> Estimate:
        """x̂, the centre's estimate if nobody transmits, as far as its owner knows it."""

    @property
    @abstractmethod
    def sent(self) -> Estimate:
        """x̂(s), k = sensors, the centre's estimate if the packet of s alone arrives."""

    @property
    @abstractmethod
    def best(self) -> Estimate:
        """x*, with all that its owner knows."""

    @property
    @abstractmethod
    def memory_posterior(self) -> Any:
        """The shadow with its owner's new measurements."""

    @cached_property
    def difference(self) -> Array:
        """x* - x̂ (k, n, N)."""
        return self.best.mean - self.silent.mean

    def loss(self, steps: int = 1) -> Array:
        """‖x* - x̂‖² (k, N), weighted by ``task.relative_weights``.

        Raises:
            ValueError: more steps than one, where its owner has no model of the centre.
        """
        _one(steps)
        return self._weighted(self.difference)

    def value(self, steps: int = 1) -> Array:
        """v(s) (sensors, N), weighted by ``task.relative_weights``.

        Raises:
            ValueError: as :meth:`loss`.
        """
        _one(steps)
        return self._expected(self.loss(), self._weighted(self.best.mean - self.sent.mean))

    def _expected(self, silent: Array, sent: Array) -> Array:
        gain = silent - sent
        return gain if self.arrival is None else self.arrival * gain

    def _weighted(self, difference: Array) -> Array:
        return (self.task.relative_weights * (difference * difference)).sum(-2)

    def _nobody(self, runs: int) -> Packets:
        return np.zeros((self.task.sensors, runs), dtype=np.bool_)


class SchedulerBeliefs(Beliefs):
    """Of whoever sees all sensors' new measurements and knows all that the centre knows."""

    @cached_property
    def silent(self) -> Estimate:
        """See :class:`Beliefs`."""
        return _of(self.task.system, self._silent)

    @cached_property
    def sent(self) -> Estimate:
        """See :class:`Beliefs`; with ``packet="estimate"`` every packet carries x*."""
        if self.task.packet == "estimate":
            return Estimate(*(np.repeat(part, self.task.sensors, axis=0) for part in self.best))
        if self.task.system.offers("fused_alone"):
            return Estimate(*self.task.system.fused_alone(self._state))
        each = [_of(self.task.system, delivered) for delivered in self._sent]
        return Estimate(
            np.concatenate([item.mean for item in each]),
            lambda: np.concatenate([item.covariance for item in each]),
        )

    @cached_property
    def best(self) -> Estimate:
        """See :class:`Beliefs`."""
        return _of(self.task.memory_system or self.task.system, self.memory_posterior)

    @cached_property
    def memory_posterior(self) -> Any:
        """See :class:`Beliefs`; without memory the centre's, had all packets arrived."""
        everyone = ~self._nobody(self._runs)
        if self.memory_states.every is None:
            return arrived(self.task.system, self._state, everyone)
        assert self.task.memory_system is not None
        return arrived(self.task.memory_system, self.memory_states.every, everyone)

    def loss(self, steps: int = 1) -> Array:
        """See :class:`Beliefs`; summed over ``steps`` times without noise and transmissions."""
        if steps == 1:
            return super().loss()
        return self._weighted(self._path(self._silent, steps) - self._best_path(steps)).sum(0)[None]

    def value(self, steps: int = 1) -> Array:
        """See :class:`Beliefs`; summed over ``steps`` times without noise and transmissions."""
        if steps == 1:
            return super().value()
        best = self._best_path(steps)
        if self.task.packet == "estimate":
            left = np.zeros((self.task.sensors, self._runs))
        else:
            left = np.stack(
                [self._weighted(self._path(sent, steps) - best).sum(0) for sent in self._sent]
            )
        return self._expected(self.loss(steps), left)

    @cached_property
    def _silent(self) -> Any:
        return self.task.system.deliver(self._state, self._nobody(self._runs))

    @cached_property
    def _sent(self) -> list[Any]:
        """The centre's states after each sensor's packet alone."""
        result = []
        for sensor in range(self.task.sensors):
            single = self._nobody(self._runs)
            single[sensor] = True
            result.append(arrived(self.task.system, self._state, single))
        return result

    def _best_path(self, steps: int) -> Array:
        return silent_path(
            self.task.memory_system or self.task.system, self.memory_posterior, steps
        )

    def _path(self, delivered: Any, steps: int) -> Array:
        return silent_path(self.task.system, delivered, steps)


class OwnBeliefs(Beliefs):
    """The beliefs of local sensors (k = sensors), by their measurements and what they receive."""

    @cached_property
    def silent(self) -> Estimate:
        """See :class:`Beliefs`."""
        system, sensors = self.task.system, self.task.sensors
        if self.task.broadcast == "none":
            nobody = self._nobody(sensors * self._runs)
            return self._each(system, system.deliver(self.memory_states.single, nobody))
        received = _of(system, system.deliver(self._state, self._nobody(self._runs)))
        return Estimate(
            np.repeat(received.mean, sensors, axis=0),
            lambda: np.repeat(received.covariance, sensors, axis=0),
        )

    @cached_property
    def sent(self) -> Estimate:
        """See :class:`Beliefs`."""
        system, itself = self.task.system, self._itself
        if self.memory_states.single is None:
            if system.offers("fused_alone"):
                return Estimate(*system.fused_alone(self._state))
            every = np.tile(np.arange(self._runs), self.task.sensors)
            return self._each(system, arrived(system, take_runs(self._state, every), itself))
        own = self._each(system, arrived(system, self.memory_states.single, itself))
        return own if self.task.broadcast == "none" else _joined(self.silent, own)

    @cached_property
    def best(self) -> Estimate:
        """See :class:`Beliefs`."""
        if self.task.memory_system is None:
            return self.sent
        own = self._each(self.task.memory_system, self.memory_posterior)
        if self.task.broadcast != "estimate":
            return own
        return _joined(self.sent if self.task.feedback else self.silent, own)

    @cached_property
    def memory_posterior(self) -> Any:
        """See :class:`Beliefs`."""
        assert self.task.memory_system is not None
        return arrived(self.task.memory_system, self.memory_states.own, self._itself)

    @property
    def _itself(self) -> Packets:
        """Each sensor's packet in its own runs (sensors, sensors · N)."""
        return np.repeat(np.eye(self.task.sensors, dtype=np.bool_), self._runs, axis=-1)

    def _each(self, system: System[Any], delivered: Any) -> Estimate:
        """From sensors · N runs to an estimate a sensor."""
        shape, whole = (self.task.sensors, self._runs), _of(system, delivered)

        def apart(values: Array) -> Array:
            return np.moveaxis(values.reshape(*values.shape[:-1], *shape), -2, 0)

        return Estimate(apart(whole.mean[0]), lambda: apart(whole.covariance[0]))


def _one(steps: int) -> None:
    if steps != 1:
        raise ValueError(
            f"steps = {steps} is not allowed here: it must be 1, for a sensor by itself cannot "
            "carry the centre's estimate on"
        )


def arriving(system: System[Any], state: Any, packets: Packets) -> Any:
    """The state of a system in which these packets (sensors, N), if they are sent, arrive."""
    return system.arriving(state, packets) if system.offers("arriving") else state


def silent_path(system: System[Any], delivered: Any, steps: int) -> Array:
    """Fused means (steps, n, N) from a delivered state on, without noise and transmissions.

    The expectation of a linear system.
    """
    runs = system.truth(delivered).shape[-1]
    still = np.zeros((system.noise_channels, runs))
    silence = np.zeros((system.sensor_count, runs), dtype=np.bool_)
    means = [system.fused_mean(delivered)]
    for _ in range(steps - 1):
        delivered = system.deliver(system.sense(delivered, still), silence)
        means.append(system.fused_mean(delivered))
    return np.stack(means)


def arrived(system: System[Any], state: Any, packets: Packets) -> Any:
    """The state after the arrival of these packets and no others."""
    return system.deliver(arriving(system, state, packets), packets)


def _of(system: System[Any], delivered: Any) -> Estimate:
    return Estimate(system.fused_mean(delivered)[None], lambda: system.fused(delivered)[1][None])


def _joined(first: Estimate, second: Estimate) -> Estimate:
    """Covariance intersection of two estimates, each sensor's by itself."""
    sensors, states, runs = first.mean.shape

    def flat(array: Array) -> Array:
        return np.moveaxis(array, 0, -2).reshape(*array.shape[1:-1], sensors * runs)

    fused = covariance_intersection(
        flat(first.mean), flat(first.covariance), flat(second.mean), flat(second.covariance)
    )
    shape = (sensors, runs)
    return Estimate(
        np.moveaxis(fused.mean.reshape(states, *shape), -2, 0),
        np.moveaxis(fused.covariance.reshape(states, states, *shape), -2, 0),
    )
