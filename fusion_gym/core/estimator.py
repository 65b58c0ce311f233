"""The contract of an estimator: local filters and fusion centre, without the truth."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Generic, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.core.knowledge import Block, Signal, SignalArray

StateT = TypeVar("StateT")
SignalValues = Mapping[str, SignalArray | Callable[[], SignalArray]]


class Reception(NamedTuple):
    """The packets that arrive in a step, and what a silence may mean.

    Args:
        arrived: Sensors (l, N) bool whose packet arrives.
        possible: Sensors (l, N) bool whose request the network would have granted; ``None`` is all.
        failure: Probability (l, N) that the network loses a granted packet; ``None`` is 0.

    Example:
        >>> import numpy as np
        >>> from fusion_gym import Reception
        >>> Reception(np.ones((2, 4), dtype=bool)).possible is None
        True
    """

    arrived: NDArray[Any]
    possible: NDArray[Any] | None = None
    failure: Array | None = None


class Estimator(ABC, Generic[StateT]):
    """Define local filters and fusion centre for N runs at once.

    A state is a dataclass of arrays whose last axis is the batch; no method changes a state in
    place. It depends on measurements and receptions only. In the shapes below n is the number of
    states, l of sensors, m of a sensor's channels. A state has the fields ``measurement``
    (l, m, N), ``mean`` (n, N) and ``covariance`` (n, n, N), or the class overrides :meth:`mean` and
    :meth:`covariance`.

    Attributes:
        signals: Declarations of the signals that :meth:`read` returns.
        traceable: Whether JAX traces the methods, so that compiled code and JAX run them, too.
        reads_silence: Whether :meth:`update` uses ``possible`` and ``failure``.
        covariance_fields: Fields of a state that depend only on the receptions; they have one
            column for all runs while the receptions (l, 1) are equal.
        independent_nodes: Whether a sensor's part of the signals and of the observation depends on
            no other sensor's packets.
        covariance_cycle: Period, in steps, of a covariance recursion that depends only on the
            receptions; ``None`` if it depends on the measurements.

    Example:
        >>> import numpy as np
        >>> import fusion_gym
        >>> from fusion_gym.core.estimator import Reception
        >>> task = fusion_gym.make_task("fusion_gym/TobitOscillator-v1")
        >>> estimator, first = task.estimator, np.zeros((3, 1, 4))
        >>> state = estimator.start(first, np.zeros((2, 4)))
        >>> state = estimator.observe(estimator.predict(state), first)
        >>> state = estimator.update(state, Reception(np.ones((3, 4), dtype=bool)))
        >>> estimator.mean(state).shape, estimator.covariance(state).shape
        ((2, 4), (2, 2, 4))
    """

    signals: tuple[Signal, ...]
    traceable: bool = False
    reads_silence: bool = False
    covariance_fields: tuple[str, ...] = ()
    independent_nodes: bool = False
    covariance_cycle: int | None = None

    @property
    @abstractmethod
    def observation(self) -> tuple[Block, ...]:
        """Blocks of an agent's observation, functions of a state after :meth:`observe`."""

    @abstractmethod
    def start(self, measurement: Array, announcement: Any) -> StateT:
        """Return the state at time 0.

        Args:
            measurement: First measurements (l, m, N), known without charge; NaN is none.
            announcement: What the plant announces of its start.
        """

    @abstractmethod
    def predict(self, state: StateT) -> StateT:
        """Return the state one step later, before a measurement.

        With a :class:`~fusion_gym.core.control.Controller` it takes the input ``control`` (k, N).

        Args:
            state: State after :meth:`update` or :meth:`start`.
        """

    def observe(self, state: StateT, measurement: Array) -> StateT:
        """Return the state after each node has its own new measurement.

        By default only the field ``measurement`` changes.

        Args:
            state: State after :meth:`predict`.
            measurement: (l, m, N); NaN where a sensor has no reading.
        """
        observed: StateT = replace(cast(Any, state), measurement=measurement)
        return observed

    @abstractmethod
    def update(self, state: StateT, reception: Reception) -> StateT:
        """Return the state after the packets that arrive, and the fusion.

        Args:
            state: State after :meth:`observe`; after :meth:`predict` if no packet arrives.
            reception: Packets that arrive.
        """

    def mean(self, state: StateT) -> Array:
        """Return the fusion centre's mean (n, N).

        Args:
            state: State after :meth:`update`.
        """
        mean: Array = cast(Any, state).mean
        return mean

    def covariance(self, state: StateT) -> Array:
        """Return the fusion centre's covariance (n, n, N).

        Args:
            state: State after :meth:`update`.
        """
        covariance: Array = cast(Any, state).covariance
        return covariance

    def local_means(self, state: StateT) -> Array:
        """Return the nodes' means (l, n, N) before any feedback, by default the centre's.

        Args:
            state: State after :meth:`update`.
        """
        mean = self.mean(state)
        return np.broadcast_to(mean, (len(cast(Any, state).measurement), *mean.shape))

    def read(self, state: StateT, failure: Array | None = None) -> SignalValues:
        """Return the signals by name, as arrays or as functions that compute them.

        By default they are the state's fields of the same names. ``variance_reduction`` supposes an
        arrival.

        Args:
            state: State after :meth:`observe`.
            failure: Probability (l, N) that the network loses a packet now; ``None`` is 0.
        """
        names = (signal.name for signal in self.signals)
        return {name: getattr(state, name) for name in names if hasattr(state, name)}

    def adopt(self, state: StateT, mean: Array, covariance: Array, runs: NDArray[Any]) -> StateT:
        """Return a state whose fusion centre has another estimate in some runs.

        Args:
            state: State after :meth:`update`.
            mean: (n, N).
            covariance: (n, n, N).
            runs: (N,) bool, the runs whose estimate is replaced.
        """
        raise NotImplementedError(f"{type(self).__name__} does not offer 'adopt'")

    def single_deliveries(self, state: StateT) -> tuple[Array, Array] | None:
        """Return the fused estimates after a delivery of each single packet.

        Args:
            state: State after :meth:`observe`.

        Returns:
            Means (l, n, N) and covariances (l, n, n, N), of which entry i has sensor i's packet
            only; ``None`` where one update per sensor is as fast.
        """
        return None

    def select_sensor(self, sensor: int) -> Estimator[StateT] | None:
        """Return an estimator of one sensor alone.

        Args:
            sensor: Number of the sensor.

        Returns:
            An estimator with the same fused estimates while no other sensor transmits; ``None``
            where there is none that is faster.
        """
        return None
