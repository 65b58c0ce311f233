"""The estimates with and without a transmission, and the value of each transmission.

x* is the best estimate of the memory's owner, x̂ the centre's estimate without a transmission, and
x̂(s) with a transmission of sensor s only. The value of a transmission is
v(s) = ‖x* - x̂‖² - E‖x* - x̂(s)‖², with the expectation over the arrival; it can be negative. With
memory x* uses all measurements and received packets of its owner (:mod:`fusion_gym.core.memory`),
without memory the centre's knowledge and the new measurements.

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

from fusion_gym import linalg
from fusion_gym.arrays import Array, take_runs
from fusion_gym.core.system import System
from fusion_gym.core.task import Task
from fusion_gym.fusion.intersection import covariance_intersection

Owner = Literal["scheduler", "own"]
Packets = NDArray[np.bool_]


@dataclass(slots=True)
class MemoryStates:
    """The memory states of N runs after sensing, ``None`` where none is needed.

    Attributes:
        every: State (N runs) of a filter with all measurements.
        own: States (sensors · N runs, a sensor's runs adjacent) of a filter with one sensor's
            measurements and received packets.
        single: States, in the order of ``own``, of a centre with deliveries from that sensor only.
    """

    every: Any = None
    own: Any = None
    single: Any = None


@dataclass(frozen=True)
class Estimate:
    """A mean (k, n, N) and a covariance (k, n, n, N), with k = 1 or one estimate per sensor.

    Args:
        mean: (k, n, N).
        source: The covariance (k, n, n, N), or a function that computes it on first access.
    """

    mean: Array
    source: Array | Callable[[], Array]

    @cached_property
    def covariance(self) -> Array:
        """Covariance, computed on first access."""
        return self.source() if callable(self.source) else self.source

    def __iter__(self) -> Iterator[Array]:
        return iter((self.mean, self.covariance))

    def __reduce__(self) -> tuple[type[Estimate], tuple[Array, Array]]:
        """Pickle the computed covariance, because its function may not be picklable."""
        return Estimate, (self.mean, self.covariance)


class Beliefs(ABC):
    """The estimates of N runs before any transmission, each computed on first access.

    Args:
        task: The task.
        state: The system's state after sensing.
        memory_states: The memory states.
        best: x*, if it is known.

    Attributes:
        arrival: Probability (sensors, N) that a packet arrives if it is sent now; ``None`` is 1.
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
        """x̂, the centre's estimate without a transmission, as the owner knows it."""

    @property
    @abstractmethod
    def sent(self) -> Estimate:
        """x̂(s), k = sensors, the centre's estimate if only the packet of s arrives."""

    @property
    @abstractmethod
    def best(self) -> Estimate:
        """x*, the estimate with all knowledge of the owner."""

    @property
    @abstractmethod
    def memory_posterior(self) -> Any:
        """Memory state after the update with the owner's new measurements."""

    @cached_property
    def difference(self) -> Array:
        """x* - x̂ (k, n, N)."""
        return self.best.mean - self.silent.mean

    def loss(self, steps: int = 1) -> Array:
        """Return ‖x* - x̂‖² (k, N), weighted by ``task.relative_weights``.

        Args:
            steps: 1, or for the scheduler the number of steps over which the loss is summed.

        Raises:
            ValueError: ``steps`` exceeds 1 for an owner without a model of the centre.
        """
        _require_single_step(steps)
        return self._weighted(self.difference)

    def value(self, steps: int = 1) -> Array:
        """Return v(s) (sensors, N), weighted by ``task.relative_weights``.

        Args:
            steps: 1, or for the scheduler the number of steps over which the value is summed.

        Raises:
            ValueError: ``steps`` exceeds 1 for an owner without a model of the centre.
        """
        _require_single_step(steps)
        return self._expected(self.loss(), self._weighted(self.best.mean - self.sent.mean))

    def _expected(self, silent: Array, sent: Array) -> Array:
        gain = silent - sent
        return gain if self.arrival is None else self.arrival * gain

    def _weighted(self, difference: Array) -> Array:
        return linalg.total(self.task.relative_weights * (difference * difference))

    def _no_packets(self, runs: int) -> Packets:
        return np.zeros((self.task.sensors, runs), dtype=np.bool_)


class SchedulerBeliefs(Beliefs):
    """The beliefs of the scheduler, from all new measurements and the centre's knowledge."""

    @cached_property
    def silent(self) -> Estimate:
        """x̂, the centre's estimate without a transmission."""
        return _fused(self.task.system, self._silent)

    @cached_property
    def sent(self) -> Estimate:
        """x̂(s); with ``packet="estimate"`` it is x* for every s."""
        if self.task.packet == "estimate":
            return Estimate(*(np.repeat(part, self.task.sensors, axis=0) for part in self.best))
        if self.task.system.offers("single_deliveries"):
            return Estimate(*self.task.system.single_deliveries(self._state))
        each = [_fused(self.task.system, delivered) for delivered in self._sent]
        return Estimate(
            np.concatenate([item.mean for item in each]),
            lambda: np.concatenate([item.covariance for item in each]),
        )

    @cached_property
    def best(self) -> Estimate:
        """x*, the estimate with all knowledge of the scheduler."""
        return _fused(self.task.memory_system or self.task.system, self.memory_posterior)

    @cached_property
    def memory_posterior(self) -> Any:
        """Memory state after the update; without memory the centre's state after all packets."""
        everyone = ~self._no_packets(self._runs)
        if self.memory_states.every is None:
            return arrived(self.task.system, self._state, everyone)
        assert self.task.memory_system is not None
        return arrived(self.task.memory_system, self.memory_states.every, everyone)

    def loss(self, steps: int = 1) -> Array:
        """Return ‖x* - x̂‖² (1, N), summed over ``steps`` steps without noise and transmissions."""
        if steps == 1:
            return super().loss()
        apart = self._path(self._silent, steps) - self._best_path(steps)
        return linalg.total(self._weighted(apart))[None]

    def value(self, steps: int = 1) -> Array:
        """Return v(s) (sensors, N), summed over ``steps`` steps without noise and transmissions."""
        if steps == 1:
            return super().value()
        best = self._best_path(steps)
        if self.task.packet == "estimate":
            left = np.zeros((self.task.sensors, self._runs))
        else:
            left = np.stack(
                [linalg.total(self._weighted(self._path(s, steps) - best)) for s in self._sent]
            )
        return self._expected(self.loss(steps), left)

    @cached_property
    def _silent(self) -> Any:
        return self.task.system.deliver(self._state, self._no_packets(self._runs))

    @cached_property
    def _sent(self) -> list[Any]:
        """The centre's states after each sensor's packet only."""
        result = []
        for sensor in range(self.task.sensors):
            single = self._no_packets(self._runs)
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
    """The beliefs of local sensors (k = sensors), from their measurements and received packets."""

    @cached_property
    def silent(self) -> Estimate:
        """x̂, the centre's estimate without a transmission, as each sensor knows it."""
        system, sensors = self.task.system, self.task.sensors
        if self.task.broadcast == "none":
            silence = self._no_packets(sensors * self._runs)
            return self._each(system, system.deliver(self.memory_states.single, silence))
        received = _fused(system, system.deliver(self._state, self._no_packets(self._runs)))
        return Estimate(
            np.repeat(received.mean, sensors, axis=0),
            lambda: np.repeat(received.covariance, sensors, axis=0),
        )

    @cached_property
    def sent(self) -> Estimate:
        """x̂(s), the centre's estimate if only the packet of s arrives, as sensor s knows it."""
        system, itself = self.task.system, self._itself
        if self.memory_states.single is None:
            if system.offers("single_deliveries"):
                return Estimate(*system.single_deliveries(self._state))
            every = np.tile(np.arange(self._runs), self.task.sensors)
            return self._each(system, arrived(system, take_runs(self._state, every), itself))
        own = self._each(system, arrived(system, self.memory_states.single, itself))
        return own if self.task.broadcast == "none" else _joined(self.silent, own)

    @cached_property
    def best(self) -> Estimate:
        """x*, the estimate with all knowledge of each sensor."""
        if self.task.memory_system is None:
            return self.sent
        own = self._each(self.task.memory_system, self.memory_posterior)
        if self.task.broadcast != "estimate":
            return own
        return _joined(self.sent if self.task.feedback else self.silent, own)

    @cached_property
    def memory_posterior(self) -> Any:
        """Memory states after the update with each sensor's own measurement."""
        assert self.task.memory_system is not None
        return arrived(self.task.memory_system, self.memory_states.own, self._itself)

    @property
    def _itself(self) -> Packets:
        """Each sensor's packet in its own runs (sensors, sensors · N)."""
        return np.repeat(np.eye(self.task.sensors, dtype=np.bool_), self._runs, axis=-1)

    def _each(self, system: System[Any], delivered: Any) -> Estimate:
        """Return one estimate per sensor from sensors · N runs."""
        shape, whole = (self.task.sensors, self._runs), _fused(system, delivered)

        def apart(values: Array) -> Array:
            return np.moveaxis(values.reshape(*values.shape[:-1], *shape), -2, 0)

        return Estimate(apart(whole.mean[0]), lambda: apart(whole.covariance[0]))


def _require_single_step(steps: int) -> None:
    if steps != 1:
        raise ValueError(
            f"steps = {steps} is not allowed here: it must be 1, because a local sensor cannot "
            "predict the centre's estimate over several steps"
        )


def arriving(system: System[Any], state: Any, packets: Packets) -> Any:
    """Return the state in which the channel does not lose these packets (sensors, N)."""
    return system.arriving(state, packets) if system.offers("arriving") else state


def silent_path(system: System[Any], delivered: Any, steps: int) -> Array:
    """Return fused means (steps, n, N) without noise and transmissions."""
    runs = system.truth(delivered).shape[-1]
    still = np.zeros((system.noise_channels, runs))
    silence = np.zeros((system.sensor_count, runs), dtype=np.bool_)
    means = [system.fused_mean(delivered)]
    for _ in range(steps - 1):
        delivered = system.deliver(system.sense(delivered, still), silence)
        means.append(system.fused_mean(delivered))
    return np.stack(means)


def arrived(system: System[Any], state: Any, packets: Packets) -> Any:
    """Return the state after the arrival of these packets and no others."""
    return system.deliver(arriving(system, state, packets), packets)


def _fused(system: System[Any], delivered: Any) -> Estimate:
    return Estimate(system.fused_mean(delivered)[None], lambda: system.fused(delivered)[1][None])


def _joined(first: Estimate, second: Estimate) -> Estimate:
    """Return the covariance intersection of two estimates of each sensor."""
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
