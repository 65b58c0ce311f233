"""What the environments ask of a system: its moves, its signals and observation, who knows them.

Who knows what is one order, for signals, observations, policies and fair comparisons alike.
"""

from __future__ import annotations

import functools
import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import FunctionType
from typing import Any, ClassVar, Generic, Literal, Self, TypeVar, cast, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.nature import AS_ASSUMED, Nature

Knowledge = Literal[
    "clock", "centre", "own", "scheduler", "own_memory", "scheduler_memory"
]  # fmt: skip
KNOWLEDGE: tuple[Knowledge, ...] = get_args(Knowledge)
MEANING: dict[Knowledge, str] = {
    "clock": "nothing but the time in the episode and the order of the last grants",
    "centre": "what the fusion centre knows before anything is sent",
    "own": "a sensor's new measurement and what the centre tells all sensors",
    "scheduler": "all sensors' new measurements and what the centre knows",
    "own_memory": "the same as own, and what that sensor measured and did not send",
    "scheduler_memory": "the same as scheduler, and what all sensors measured and did not send",
}
# What each class knows besides itself.
_BELOW: dict[Knowledge, tuple[Knowledge, ...]] = {
    "clock": (),
    "centre": ("clock",),
    "own": ("clock",),
    "scheduler": ("clock", "centre", "own"),
    "own_memory": ("clock", "own"),
    "scheduler_memory": ("clock", "centre", "own", "scheduler", "own_memory"),
}


def covers(knower: Knowledge, known: Knowledge) -> bool:
    """Whether whoever has the class ``knower`` knows all that belongs to the class ``known``.

    clock < centre and own < scheduler, and own and scheduler also with memory; centre and own
    do not cover each other.

    Raises:
        ConfigurationError: an unknown class.
    """
    for name, value in (("knower", knower), ("known", known)):
        validation.choice(name, value, KNOWLEDGE)
    return known == knower or known in _BELOW[knower]


def least_covering(classes: Iterable[Knowledge]) -> Knowledge:
    """The least class that covers all the given ones; ``"clock"`` for none."""
    required = tuple(classes)
    able = [k for k in KNOWLEDGE if all(covers(k, item) for item in required)]
    return min(able, key=lambda k: len(_BELOW[k]))


SignalArray = NDArray[Any]

StateT = TypeVar("StateT")
PredictionT = TypeVar("PredictionT")


@dataclass(frozen=True)
class Signal:
    """A named quantity that a policy may look at: who knows it, its axes, and what it is.

    ``knowledge`` is ``"own"`` for what only the sensor knows before anything is sent (its new
    measurement and all that follows from it), ``"centre"`` for what the fusion centre knows as
    well, ``"clock"`` for what time alone tells. ``axes`` names the axes, as in
    ``"(sensors, m, N)"``; an array has as many, the batch axis N last. ``joint`` marks a row a
    sensor that no sensor knows, for it depends on the others.
    """

    name: str
    knowledge: Knowledge
    axes: str
    meaning: str
    joint: bool = False

    def known_to(self, knower: Knowledge) -> bool:
        """Return whether a policy of this class may read it; a sensor reads its own row, too."""
        node = self.knowledge == "centre" and self.axes.startswith("(sensors") and not self.joint
        return covers(knower, self.knowledge) or (node and covers(knower, "own"))

    def __post_init__(self) -> None:
        validation.choice("knowledge", self.knowledge, KNOWLEDGE)


# The signals of every system, and what they are where the system does not say otherwise.
_COMMON: tuple[tuple[str, Knowledge, str], ...] = (
    ("measurement", "own", "the new measurement"),
    ("innovation", "own", "measurement minus its expectation"),
    ("held", "centre", "the last delivered measurement"),
    ("age", "centre", "steps since the last delivery"),
    ("expected_measurement", "centre", "expectation of the measurement"),
    ("innovation_deviation", "centre", "predicted standard deviation of the innovation"),
    ("prior_mean", "centre", "prediction of the fused estimate"),
    ("prior_covariance", "centre", "covariance of that prediction"),
    ("silent_variance", "centre", "weighted trace of the fused covariance without a delivery"),
    ("variance_reduction", "centre", "fall of that trace if this sensor alone transmits"),
)
_COMMON_AXES = {
    "age": "(sensors, N)",
    "prior_mean": "(n, N)",
    "prior_covariance": "(n, n, N)",
    "silent_variance": "(N,)",
    "variance_reduction": "(sensors, N)",
}


def common_signals(axes: str = "(sensors, m, N)", **meanings: str) -> tuple[Signal, ...]:
    """Return the signals that every system offers.

    ``axes`` are those of a measurement; ``meanings`` replace the general ones by name.
    """
    return tuple(
        Signal(n, k, _COMMON_AXES.get(n, axes), meanings.get(n, text), n == "variance_reduction")
        for n, k, text in _COMMON
    )


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
    centre tells everyone (``"broadcast"``), or nothing (``"hidden"``).
    """

    name: str
    meaning: str
    value: Callable[[Any], NDArray[Any]]
    labels: tuple[tuple[str, ...], ...] = ()
    knowledge: Knowledge = "centre"
    node: Literal["own", "broadcast", "hidden"] = "hidden"
    limit: float | None = None
    constants: Mapping[str, ArrayLike] = field(default_factory=dict)

    def __post_init__(self) -> None:
        validation.choice("knowledge", self.knowledge, KNOWLEDGE)
        validation.choice("node", self.node, ("own", "broadcast", "hidden"))

    @functools.cached_property
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


def sensed(prediction: PredictionT | None) -> PredictionT:
    """Return the prediction of a state, which it has after :meth:`System.sense`.

    Raises:
        RuntimeError: the state was never sensed.
    """
    if prediction is None:
        raise RuntimeError("the state has no measurements yet: call sense first")
    return prediction


def log_deviation(covariance: Array, reference: Array) -> Array:
    """Return ln √(variance/reference) (..., n, N) of covariances (..., n, n, N).

    ``reference`` (n,) are variances, zero of a state that is always known. Minus infinity for a
    variance of zero.
    """
    possible = np.where(reference > 0.0, reference, np.inf)
    with np.errstate(divide="ignore"):
        return 0.5 * np.log(np.maximum(linalg.diagonal(covariance), 0.0) / possible[:, None])


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

    def limit(self, refused: Mapping[str, str]) -> Self:
        """Withhold these signals too, for the reasons given; returns the signals themselves."""
        if refused:
            self._withheld |= refused
        return self

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


# What a system may have beside what every system has.
CAPABILITIES = (
    *("adopt", "arrival_probability", "arriving", "covariance_cycle", "error_covariance"),
    *("fused_alone", "imagination_channels", "imagine", "with_actual_covariance"),
)


class System(ABC, Generic[StateT]):
    """A networked estimation system, for N runs at once (batch axis last).

    A state is a dataclass of arrays whose last axis is the batch; no method changes one in place.
    ``state_names`` names the plant's n states, ``signals`` declares what :meth:`read` returns, and
    ``nature`` says how the truth departs from the model. ``extensions`` lists the public methods
    that a class has beyond those of its bases.

    Raises:
        TypeError: (on subclassing) a public method that is neither a base's nor in ``extensions``.
    """

    state_names: tuple[str, ...]
    signals: tuple[Signal, ...]
    nature: Nature = AS_ASSUMED
    extensions: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        known = set(cls.extensions).union(*(vars(base) for base in cls.__mro__[1:]))
        methods = (FunctionType, property, functools.cached_property, classmethod, staticmethod)
        for name, value in vars(cls).items():
            if name[0] != "_" and isinstance(value, methods) and name not in known:
                raise TypeError(
                    f"{cls.__name__}.{name} is not allowed: it must override a method of a base "
                    "class, begin with '_', or be listed in extensions"
                )

    def offers(self, capability: str) -> bool:
        """Return whether this system has an optional capability, one of ``CAPABILITIES``.

        Raises:
            ValueError: an unknown capability.
        """
        if capability not in CAPABILITIES:
            raise ValueError(f"capability = {capability!r} is not allowed: see CAPABILITIES")
        return getattr(type(self), capability) is not getattr(System, capability)

    @property
    @abstractmethod
    def sensor_count(self) -> int:
        """Number of sensors."""

    @property
    @abstractmethod
    def noise_channels(self) -> int:
        """Standard normals that :meth:`sense` consumes."""

    @property
    @abstractmethod
    def start_channels(self) -> int:
        """Standard normals that :meth:`start` consumes, the last ones by ``nature``."""

    @property
    @abstractmethod
    def observation(self) -> tuple[Block, ...]:
        """The blocks of an agent's observation, in their order."""

    @abstractmethod
    def start(self, noise: Array) -> StateT:
        """Return time 0 from standard normals (start_channels, N)."""

    @abstractmethod
    def sense(self, state: StateT, noise: Array) -> StateT:
        """Move the plant and measure, with standard normals (noise_channels, N)."""

    @abstractmethod
    def deliver(self, state: StateT, granted: NDArray[np.bool_]) -> StateT:
        """Update the nodes with what was granted (sensors, N), and fuse."""

    @abstractmethod
    def read(self, state: StateT) -> Mapping[str, SignalArray | Callable[[], SignalArray]]:
        """Return the signals after :meth:`sense`."""

    @abstractmethod
    def visible(self, state: StateT) -> StateT:
        """Return the state without what no policy may know, for policies that plan.

        The truth and all that is not yet measured are not a number, coming losses are taken out:
        :meth:`deliver` lets every grant arrive.
        """

    @abstractmethod
    def local_means(self, state: StateT) -> Array:
        """Return the nodes' means (sensors, n, N) after :meth:`deliver`, before any feedback."""

    @abstractmethod
    def open_loop(self, horizon: int) -> Array:
        """Return the mean error variance (n,) over t = 1..horizon without any delivery."""

    def rounding(self, horizon: int) -> tuple[float, float]:
        """Return what float64 may lose at t = 0..horizon, in units of its precision; 0 if unknown.

        The largest mean square of a measurement over its noise's variance, and the largest ratio of
        a predicted variance to what a packet after silence leaves of it.
        """
        return 0.0, 0.0

    def truth(self, state: StateT) -> Array:
        """Return the plant's state (n, N): for the reward and for metrics, never for a policy."""
        truth: Array = cast(Any, state).truth
        return truth

    def fused(self, state: StateT) -> tuple[Array, Array]:
        """Return the centre's mean (n, N) and covariance (n, n, N) after :meth:`deliver`."""
        delivered = cast(Any, state)
        return delivered.mean, delivered.covariance

    def fused_mean(self, state: StateT) -> Array:
        """Return the mean of :meth:`fused` (n, N); override it where the covariance is large."""
        return self.fused(state)[0]

    @property
    def censored_beyond(self) -> Mapping[int, tuple[float, float]]:
        """Lowest and highest value that is seen of a state, by its number, for pictures."""
        return {}

    def arrival_probability(self, state: StateT) -> Array:
        """Return the probability (sensors, N) that a packet sent after this sensing arrives.

        From what is known before anything is sent. Offered where the channel may lose packets.
        """
        raise self._missing("arrival_probability")

    def arriving(self, state: StateT, packets: NDArray[np.bool_]) -> StateT:
        """Return the state in which these packets (sensors, N), if sent now, are not lost."""
        raise self._missing("arriving")

    def adopt(
        self, state: StateT, mean: Array, covariance: Array, runs: NDArray[np.bool_]
    ) -> StateT:
        """Replace the centre's estimate (n, N), (n, n, N) of a delivered state in ``runs`` (N,)."""
        raise self._missing("adopt")

    def fused_alone(self, state: StateT) -> tuple[Array, Array]:
        """Return means (sensors, n, N) and covariances (sensors, n, n, N) after single deliveries.

        Entry i is :meth:`fused` after :meth:`deliver` of sensor i's packet alone. Offered where
        all together cost less than one after another, and no packet is lost.
        """
        raise self._missing("fused_alone")

    @property
    def imagination_channels(self) -> int:
        """Standard normals that :meth:`imagine` consumes."""
        raise self._missing("imagination_channels")

    def imagine(self, state: StateT, mean: Array, covariance: Array, noise: Array) -> StateT:
        """Draw all that :meth:`visible` hides in a state after :meth:`sense`.

        The truth follows N(mean, covariance) of shapes (n, N) and (n, n, N), the rest its law;
        what has been measured stays. Two systems of one plant draw the same from the same
        ``noise`` (imagination_channels, N).
        """
        raise self._missing("imagine")

    @property
    def covariance_cycle(self) -> int:
        """Steps after which the recursion of the covariances repeats itself.

        Offered where the covariances follow from the deliveries alone, whatever is measured.
        """
        raise self._missing("covariance_cycle")

    def with_actual_covariance(self) -> System[StateT]:
        """Return the same system with states that carry what :meth:`error_covariance` needs."""
        raise self._missing("with_actual_covariance")

    def error_covariance(self, state: StateT) -> Array:
        """Return the actual covariance (n, n, N) of the fused error after :meth:`deliver`.

        After a start with zeros for noise it is the mean over all episodes. Deliveries must not
        depend on the noise.
        """
        raise self._missing("error_covariance")

    def _missing(self, capability: str) -> NotImplementedError:
        return NotImplementedError(f"{type(self).__name__} does not offer {capability!r}")
