"""What the environments ask of a system: its moves, its signals and observation, who knows them.

Who knows what is one order, for signals, observations, policies and fair comparisons alike.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, TypeVar, get_args, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import validation
from fusion_gym.arrays import Array

Knowledge = Literal[
    "clock", "centre", "own", "coordinator", "own_memory", "coordinator_memory"
]  # fmt: skip
KNOWLEDGE: tuple[Knowledge, ...] = get_args(Knowledge)
MEANING: dict[Knowledge, str] = {
    "clock": "nothing but the time in the episode",
    "centre": "what the fusion centre knows before anything is sent",
    "own": "a sensor's new measurement and what the centre tells all sensors",
    "coordinator": "all sensors' new measurements and what the centre knows",
    "own_memory": "the same as own, and what that sensor measured and did not send",
    "coordinator_memory": "the same as coordinator, and what all sensors measured and did not send",
}
# What each class knows besides itself.
_BELOW: dict[Knowledge, tuple[Knowledge, ...]] = {
    "clock": (),
    "centre": ("clock",),
    "own": ("clock",),
    "coordinator": ("clock", "centre", "own"),
    "own_memory": ("clock", "own"),
    "coordinator_memory": ("clock", "centre", "own", "coordinator", "own_memory"),
}


def covers(knower: Knowledge, known: Knowledge) -> bool:
    """Whether whoever has the class ``knower`` knows all that belongs to the class ``known``.

    clock < centre and own < coordinator, and own and coordinator also with memory; centre and own
    do not cover each other.

    Raises:
        ConfigurationError: an unknown class.
    """
    for name, value in (("knower", knower), ("known", known)):
        validation.choice(name, value, KNOWLEDGE)
    return known == knower or known in _BELOW[knower]


def least_covering(classes: Iterable[Knowledge]) -> Knowledge:
    """The least class that covers all the given ones; ``"clock"`` for none."""
    wanted = tuple(classes)
    able = [k for k in KNOWLEDGE if all(covers(k, one) for one in wanted)]
    return min(able, key=lambda k: len(_BELOW[k]))


SignalArray = NDArray[Any]

StateT = TypeVar("StateT")


@dataclass(frozen=True)
class Signal:
    """A named quantity that a policy may look at: who knows it, its axes, and what it is.

    ``knowledge`` is ``"own"`` for what only the sensor knows before anything is sent (its new
    measurement and all that follows from it), ``"centre"`` for what the fusion centre knows as
    well, ``"clock"`` for what time alone tells. ``axes`` names the axes, as in
    ``"(sensors, m, N)"``; an array has as many, the batch axis N last.
    """

    name: str
    knowledge: Knowledge
    axes: str
    meaning: str


@dataclass(frozen=True)
class Block:
    """Entries of an agent's observation, all that there is to know of them in one place.

    ``labels`` has the labels of each axis: ``(("0", "1"), ("x1", "x2"))`` names the entries
    ``name[0,x1]``, ``name[0,x2]``, …, and no axes at all the one entry ``name``. ``value`` takes a
    state after sensing and returns the entries, scaled to order one, as an array of the labels'
    shape and N runs; they are clipped to ±``limit``, or without a limit to 0..1. ``constants`` are
    the numbers that ``meaning`` speaks of, by its own words, mostly one for each label of the last
    axes.

    ``knowledge`` is the least class that knows the block before anything is sent; ``node`` is what
    a sensor sees of it by itself: its own row of the first axis (``"own"``), all of it, for the
    centre tells everyone (``"told"``), or nothing (``"hidden"``).
    """

    name: str
    meaning: str
    value: Callable[[Any], NDArray[Any]]
    labels: tuple[tuple[str, ...], ...] = ()
    knowledge: Knowledge = "centre"
    node: Literal["own", "told", "hidden"] = "hidden"
    limit: float | None = None
    constants: Mapping[str, ArrayLike] = field(default_factory=dict)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the entries, without the batch axis."""
        return tuple(len(axis) for axis in self.labels)

    @property
    def places(self) -> tuple[tuple[str, ...], ...]:
        """The labels of each entry, in the order of a C-ordered array."""
        return tuple(itertools.product(*self.labels))

    @property
    def bounds(self) -> tuple[float, float]:
        """Lowest and highest value of an entry."""
        return (0.0, 1.0) if self.limit is None else (-self.limit, self.limit)

    def fill(self, state: Any) -> NDArray[Any]:
        """The entries (rows, N) of a state, not yet clipped.

        Raises:
            ValueError: ``value`` returned another shape.
        """
        filled = self.value(state)
        if filled.shape[:-1] != self.shape:
            raise ValueError(
                f"observation block {self.name!r} of shape {filled.shape} is not allowed: it must "
                f"be {(*self.shape, 'N')}"
            )
        return filled.reshape(-1, filled.shape[-1])


def age_block(sensors: tuple[str, ...]) -> Block:
    """The entry that all systems have, of a state with ``age`` (sensors, N)."""
    meaning = "a/(a + 10), a steps since the last delivery"
    return Block(
        "age", meaning, lambda state: state.age / (state.age + 10.0), (sensors,), node="own"
    )


def numbered(count: int) -> tuple[str, ...]:
    """The labels "0", "1", … of an axis."""
    return tuple(str(place) for place in range(count))


class SignalError(KeyError):
    """A signal that there is not, or that is withheld; a ``KeyError`` that shows plain text."""

    def __str__(self) -> str:
        return str(self.args[0])


class Signals(Mapping[str, SignalArray]):
    """The signals of one step, in physical units, batch axis last.

    A value may be given as a function; it is then computed when first looked at. ``hidden`` names
    the signals that exist but that the environment's information mode withholds, ``missing`` those
    that are not kept, and why.

    Raises:
        SignalError: (on access) an unknown or a withheld signal; the message says which.
    """

    def __init__(
        self,
        values: Mapping[str, SignalArray | Callable[[], SignalArray]],
        hidden: Sequence[str] = (),
        missing: Mapping[str, str] | None = None,
    ) -> None:
        self._values = dict(values)
        self._withheld = dict(missing or {}) | {
            name: f"signal {name!r} is known to the sensors only; information='centre' withholds "
            "it (use information='sensors', or a policy that looks at the centre's signals)"
            for name in hidden
        }

    def __getitem__(self, name: str) -> SignalArray:
        if name in self._withheld:
            raise SignalError(self._withheld[name])
        try:
            value = self._values[name]
        except KeyError:
            known = ", ".join(sorted(self))
            raise SignalError(f"unknown signal {name!r}: known are {known}") from None
        if callable(value):
            value = value()
            self._values[name] = value
        return value

    def __contains__(self, name: object) -> bool:
        return name in self._values and name not in self._withheld

    @property
    def withheld(self) -> Mapping[str, str]:
        """The names of the signals that are withheld or not kept, and why."""
        return self._withheld

    def __iter__(self) -> Iterator[str]:
        return (name for name in self._values if name not in self._withheld)

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
    def observation(self) -> tuple[Block, ...]:
        """The blocks of an agent's observation, in their order."""
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

    def visible(self, state: StateT) -> StateT:
        """The state without what no policy may know, for policies that plan with the model.

        The truth and all that is not yet measured are not a number, coming losses are taken out:
        :meth:`deliver` lets every grant arrive.
        """
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
class LossySystem(System[StateT], Protocol[StateT]):
    """A system whose channel may lose what was granted. Optional: others lose nothing."""

    def arrival_probability(self, state: StateT) -> Array | None:
        """Probability (sensors, N) that a packet sent after this sensing arrives, or None: surely.

        From what is known before anything is sent.
        """
        ...

    def arriving(self, state: StateT, packets: NDArray[np.bool_]) -> StateT:
        """The state in which these packets (sensors, N), if they are sent now, are not lost."""
        ...


@runtime_checkable
class AdoptingSystem(System[StateT], Protocol[StateT]):
    """A system whose centre can go on from an estimate that a packet brings. Optional."""

    def adopt(
        self, state: StateT, mean: Array, covariance: Array, runs: NDArray[np.bool_]
    ) -> StateT:
        """A delivered state with the centre's estimate (n, N), (n, n, N) replaced in ``runs``."""
        ...


@runtime_checkable
class TryingSystem(System[StateT], Protocol[StateT]):
    """A system that tells what each packet alone would make of the estimate. Optional."""

    def fused_alone(self, state: StateT) -> tuple[Array, Array] | None:
        """The centre's means (sensors, n, N) and covariances (sensors, n, n, N) after a delivery.

        The i-th is :meth:`fused` of what :meth:`deliver` makes of the packet of sensor i alone;
        ``None`` where one after another costs no more. Of a system that loses nothing.
        """
        ...


@runtime_checkable
class ManyStatesSystem(System[StateT], Protocol[StateT]):
    """A system whose covariances are large, and are left alone where means will do. Optional."""

    def fused_mean(self, state: StateT) -> Array:
        """The mean (n, N) of :meth:`fused`, without its covariance."""
        ...


@runtime_checkable
class ImaginableSystem(System[StateT], Protocol[StateT]):
    """A system that can put what could be in the place of all that is hidden. Optional.

    For policies that simulate what may come, from what is believed and not from the truth.
    """

    @property
    def imagination_channels(self) -> int | None:
        """Standard normals that :meth:`imagine` consumes; None where there is nothing to draw."""
        ...

    def imagine(self, state: StateT, mean: Array, covariance: Array, noise: Array) -> StateT:
        """The state after :meth:`sense` with all that :meth:`visible` hides drawn anew.

        The truth by what is believed of it, N(mean, covariance) of shapes (n, N) and (n, n, N);
        the rest by its law, as each system says; what has been measured stays. Two systems of one
        plant draw the same from the same ``noise`` (imagination_channels, N).
        """
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
