"""What the environments ask of a system, and the signals that a policy may look at."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array

Knowledge = Literal["sensor", "centre"]
SignalArray = NDArray[Any]

StateT = TypeVar("StateT")


@dataclass(frozen=True)
class Signal:
    """A named quantity: who knows it before anything is sent, its axes, and what it is.

    ``knowledge`` is ``"sensor"`` for what only the sensor knows (its new measurement and all that
    follows from it) and ``"centre"`` for what the fusion centre knows as well.
    """

    name: str
    knowledge: Knowledge
    axes: str
    meaning: str


@dataclass(frozen=True)
class Feature:
    """One entry of an agent's observation: its name, who knows it, and its bounds.

    ``sensor`` is the number of the sensor whose node knows the entry by itself, ``broadcast``
    marks what every node is told; other entries are none of a single sensor's knowledge. A block
    of ``Feature`` entries is filled by one array of as many rows.
    """

    name: str
    knowledge: Knowledge
    low: float
    high: float
    sensor: int | None = None
    broadcast: bool = False


def feature_block(
    kind: str,
    places: Iterable[tuple[int | None, str]],
    knowledge: Knowledge,
    limit: float | None = None,
) -> tuple[Feature, ...]:
    """Entries ``kind[place]`` of (the sensor that knows it by itself, place).

    Between -limit and limit, or without a limit from 0 to 1.
    """
    low, high = (0.0, 1.0) if limit is None else (-limit, limit)
    return tuple(
        Feature(f"{kind}[{place}]", knowledge, low, high, sensor=node) for node, place in places
    )


class Signals(Mapping[str, SignalArray]):
    """The signals of one step, in physical units, batch axis last.

    A value may be given as a function; it is then computed when first looked at. ``hidden`` names
    the signals that exist but that the environment's information mode withholds.

    Raises:
        LookupError: (on access) an unknown or a withheld signal; the message says which.
    """

    def __init__(
        self,
        values: Mapping[str, SignalArray | Callable[[], SignalArray]],
        hidden: Sequence[str] = (),
    ) -> None:
        self._values = dict(values)
        self._hidden = frozenset(hidden)

    def __getitem__(self, name: str) -> SignalArray:
        if name in self._hidden:
            raise LookupError(
                f"signal {name!r} is known to the sensors only; information='centre' withholds it "
                "(use information='sensors', or a policy that looks at the centre's signals)"
            )
        try:
            value = self._values[name]
        except KeyError:
            known = ", ".join(sorted(self))
            raise LookupError(f"unknown signal {name!r}: known are {known}") from None
        if callable(value):
            value = value()
            self._values[name] = value
        return value

    def __iter__(self) -> Iterator[str]:
        return (name for name in self._values if name not in self._hidden)

    def __len__(self) -> int:
        return sum(1 for _ in self)


class System(Protocol[StateT]):
    """A networked estimation system, for N runs at once (batch axis last).

    A state is a dataclass of arrays whose last axis is the batch; no method changes one in place.
    """

    @property
    def sensor_count(self) -> int:
        """Number of sensors."""
        ...

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the plant's states, n of them."""
        ...

    @property
    def noise_channels(self) -> int:
        """Standard normals that :meth:`sense` consumes."""
        ...

    @property
    def start_channels(self) -> int:
        """Standard normals that :meth:`start` consumes."""
        ...

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The signals that :meth:`read` offers."""
        ...

    @property
    def features(self) -> tuple[tuple[Feature, ...], ...]:
        """The blocks of an agent's observation, in the order of :meth:`observe`."""
        ...

    def start(self, noise: Array) -> StateT:
        """Time 0 from standard normals (start_channels, N)."""
        ...

    def sense(self, state: StateT, noise: Array) -> StateT:
        """The plant moves and the sensors measure, with standard normals (noise_channels, N)."""
        ...

    def deliver(self, state: StateT, granted: NDArray[np.bool_]) -> StateT:
        """The nodes update with what was granted (sensors, N), the centre fuses."""
        ...

    def read(self, state: StateT) -> Mapping[str, SignalArray | Callable[[], SignalArray]]:
        """The signals after :meth:`sense`."""
        ...

    def observe(self, state: StateT) -> Sequence[Array]:
        """The observation's blocks after :meth:`sense`, each (rows, N), scaled to order one."""
        ...

    def truth(self, state: StateT) -> Array:
        """The plant's state (n, N): for the reward and for metrics, never for a policy."""
        ...

    def fused(self, state: StateT) -> tuple[Array, Array]:
        """The centre's mean (n, N) and covariance (n, n, N) after :meth:`deliver`."""
        ...

    def local_means(self, state: StateT) -> Array:
        """The nodes' means (sensors, n, N) after :meth:`deliver`, before any feedback."""
        ...

    def open_loop(self, horizon: int) -> Array:
        """Mean error variance (n,) over t = 1..horizon of a centre that never receives."""
        ...


@runtime_checkable
class PredictableSystem(System[StateT], Protocol[StateT]):
    """A system that says whether its covariances follow from what is delivered alone.

    Optional: a system without ``covariance_cycle`` counts as one whose covariances need the data.
    """

    @property
    def covariance_cycle(self) -> int | None:
        """Steps after which the covariances' recursion repeats itself (1 if it is always the same).

        None where the data enter the covariances, or where deliveries do not.
        """
        ...


@runtime_checkable
class ConservativeSystem(PredictableSystem[StateT], Protocol[StateT]):
    """A predictable system that claims a bound and can tell the actual covariance beside it.

    Optional, as above.
    """

    def with_actual_covariance(self) -> ConservativeSystem[StateT]:
        """The same system, its states carrying what :meth:`error_covariance` needs."""
        ...

    def error_covariance(self, state: StateT) -> Array:
        """Actual covariance (n, n, N) of the fused error after :meth:`deliver`.

        After a start with zeros for noise it is the mean over all episodes. Deliveries must not
        depend on the noise.
        """
        ...
