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
from fusion_gym.core.estimator import Estimator, Reception
from fusion_gym.core.task import Task
from fusion_gym.fusion.intersection import covariance_intersection

Owner = Literal["scheduler", "own"]
Packets = NDArray[np.bool_]


# States of N runs after sensing: "every" (N runs) of an estimator with all measurements, "own"
# (sensors · N runs, a sensor's runs adjacent) with one sensor's measurements and received packets,
# and "single", in the order of "own", of a centre with deliveries from that sensor only.
MemoryStates = dict[str, Any]


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
        estimate: The estimator's state after observing.
        memory_states: The memory states.
        arrival: Probability (sensors, N) that a packet sent now arrives; ``None`` is 1.
        best: x*, if it is known.
    """

    def __init__(
        self,
        task: Task,
        estimate: Any,
        memory_states: MemoryStates,
        arrival: Array | None,
        best: Estimate | None = None,
    ) -> None:
        if best is not None:
            vars(self)["best"] = best
        self.task, self.memory_states, self.arrival = task, memory_states, arrival
        self._estimate, self._runs = estimate, estimate.measurement.shape[-1]

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

    def update(self, estimator: Estimator[Any], state: Any, packets: Packets) -> Any:
        """Return the state after the arrival of these packets (sensors, …) and no others."""
        failure = None
        if estimator.reads_silence and self.arrival is not None:
            failure = np.tile(1.0 - self.arrival, packets.shape[-1] // self._runs)
        return estimator.update(state, Reception(packets, failure=failure))

    @cached_property
    def difference(self) -> Array:
        """x* - x̂ (k, n, N)."""
        return self.best.mean - self.silent.mean

    @cached_property
    def loss(self) -> Array:
        """‖x* - x̂‖² (k, N), weighted by ``task.relative_weights``."""
        return self._weighted(self.difference)

    @cached_property
    def value(self) -> Array:
        """v(s) (sensors, N), weighted by ``task.relative_weights``."""
        gain = self.loss - self._weighted(self.best.mean - self.sent.mean)
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
        return _fused(self.task.estimator, self._silent)

    @cached_property
    def sent(self) -> Estimate:
        """x̂(s); with ``packet="estimate"`` it is x* for every s."""
        if self.task.packet == "estimate":
            return Estimate(*(np.repeat(part, self.task.sensors, axis=0) for part in self.best))
        single = self.task.estimator.single_deliveries(self._estimate)
        if single is not None:
            return Estimate(*single)
        each = [_fused(self.task.estimator, updated) for updated in self._sent]
        return Estimate(
            np.concatenate([item.mean for item in each]),
            lambda: np.concatenate([item.covariance for item in each]),
        )

    @cached_property
    def best(self) -> Estimate:
        """x*, the estimate with all knowledge of the scheduler."""
        return _fused(self.task.memory_estimator or self.task.estimator, self.memory_posterior)

    @cached_property
    def memory_posterior(self) -> Any:
        """Memory state after the update; without memory the centre's state after all packets."""
        everyone = ~self._no_packets(self._runs)
        if "every" not in self.memory_states:
            return self.update(self.task.estimator, self._estimate, everyone)
        assert self.task.memory_estimator is not None
        return self.update(self.task.memory_estimator, self.memory_states["every"], everyone)

    @cached_property
    def _silent(self) -> Any:
        return self.update(self.task.estimator, self._estimate, self._no_packets(self._runs))

    @cached_property
    def _sent(self) -> list[Any]:
        """The centre's states after each sensor's packet only."""
        result = []
        for sensor in range(self.task.sensors):
            single = self._no_packets(self._runs)
            single[sensor] = True
            result.append(self.update(self.task.estimator, self._estimate, single))
        return result


class OwnBeliefs(Beliefs):
    """The beliefs of local sensors (k = sensors), from their measurements and received packets."""

    @cached_property
    def silent(self) -> Estimate:
        """x̂, the centre's estimate without a transmission, as each sensor knows it."""
        estimator, sensors = self.task.estimator, self.task.sensors
        if self.task.broadcast == "none":
            silence = self._no_packets(sensors * self._runs)
            single = self.memory_states["single"]
            return self._each(estimator, self.update(estimator, single, silence))
        silence = self._no_packets(self._runs)
        received = _fused(estimator, self.update(estimator, self._estimate, silence))
        return Estimate(
            np.repeat(received.mean, sensors, axis=0),
            lambda: np.repeat(received.covariance, sensors, axis=0),
        )

    @cached_property
    def sent(self) -> Estimate:
        """x̂(s), the centre's estimate if only the packet of s arrives, as sensor s knows it."""
        estimator, state = self.task.estimator, self.memory_states.get("single")
        if state is None:
            single = estimator.single_deliveries(self._estimate)
            if single is not None:
                return Estimate(*single)
            every = np.tile(np.arange(self._runs), self.task.sensors)
            state = take_runs(self._estimate, every)
        own = self._each(estimator, self.update(estimator, state, self._itself))
        alone = "single" not in self.memory_states or self.task.broadcast == "none"
        return own if alone else _joined(self.silent, own)

    @cached_property
    def best(self) -> Estimate:
        """x*, the estimate with all knowledge of each sensor."""
        if self.task.memory_estimator is None:
            return self.sent
        own = self._each(self.task.memory_estimator, self.memory_posterior)
        if self.task.broadcast != "estimate":
            return own
        return _joined(self.sent if self.task.feedback else self.silent, own)

    @cached_property
    def memory_posterior(self) -> Any:
        """Memory states after the update with each sensor's own measurement."""
        assert self.task.memory_estimator is not None
        return self.update(self.task.memory_estimator, self.memory_states["own"], self._itself)

    @property
    def _itself(self) -> Packets:
        """Each sensor's packet in its own runs (sensors, sensors · N)."""
        return np.repeat(np.eye(self.task.sensors, dtype=np.bool_), self._runs, axis=-1)

    def _each(self, estimator: Estimator[Any], updated: Any) -> Estimate:
        """Return one estimate per sensor from sensors · N runs."""
        shape, whole = (self.task.sensors, self._runs), _fused(estimator, updated)

        def apart(values: Array) -> Array:
            return np.moveaxis(values.reshape(*values.shape[:-1], *shape), -2, 0)

        return Estimate(apart(whole.mean[0]), lambda: apart(whole.covariance[0]))


def _fused(estimator: Estimator[Any], updated: Any) -> Estimate:
    mean = estimator.mean(updated)[None]
    return Estimate(mean, lambda: estimator.covariance(updated)[None])


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
