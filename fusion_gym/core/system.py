"""The interface of a system: dynamics, signals, observation blocks, and their knowledge classes.

One partial order of knowledge classes serves signals, observations and policies.
"""

from __future__ import annotations

import copy
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
    "clock": "the time in the episode and the order of the last grants",
    "centre": "the fusion centre's knowledge before a transmission",
    "own": "a sensor's new measurement and the broadcasts",
    "scheduler": "all sensors' new measurements and the centre's knowledge",
    "own_memory": "own, and that sensor's unsent measurements",
    "scheduler_memory": "scheduler, and all sensors' unsent measurements",
}
# Classes that each class covers besides itself.
_BELOW: dict[Knowledge, tuple[Knowledge, ...]] = {
    "clock": (),
    "centre": ("clock",),
    "own": ("clock",),
    "scheduler": ("clock", "centre", "own"),
    "own_memory": ("clock", "own"),
    "scheduler_memory": ("clock", "centre", "own", "scheduler", "own_memory"),
}


def covers(knower: Knowledge, known: Knowledge) -> bool:
    """Return whether the class ``knower`` knows everything that the class ``known`` knows.

    clock < centre < scheduler and clock < own < scheduler; centre and own are not comparable. A
    class with memory covers the same class without it.

    Args:
        knower: A class of ``KNOWLEDGE``.
        known: A class of ``KNOWLEDGE``.

    Raises:
        ConfigurationError: A class is unknown.
    """
    for name, value in (("knower", knower), ("known", known)):
        validation.choice(name, value, KNOWLEDGE)
    return known == knower or known in _BELOW[knower]


def least_covering(classes: Iterable[Knowledge]) -> Knowledge:
    """Return the least class that covers all ``classes``; ``"clock"`` for none."""
    required = tuple(classes)
    able = [k for k in KNOWLEDGE if all(covers(k, item) for item in required)]
    return min(able, key=lambda k: len(_BELOW[k]))


SignalArray = NDArray[Any]

StateT = TypeVar("StateT")
PredictionT = TypeVar("PredictionT")


@dataclass(frozen=True)
class Signal:
    """A named quantity that a policy may use.

    Args:
        name: Name of the signal.
        knowledge: Least class that knows it before any transmission: ``"own"`` for a sensor's new
            measurement and its consequences, ``"centre"`` for the fusion centre's knowledge,
            ``"clock"`` for the time.
        axes: Axes of the array, such as ``"(sensors, m, N)"``, the batch axis N last.
        meaning: Short description.
        joint: Whether a sensor's row depends on other sensors, so that the sensor does not know it.

    Example:
        >>> from fusion_gym import Signal
        >>> Signal("surprise", "own", "(sensors, N)", "distance to the prediction").knowledge
        'own'
    """

    name: str
    knowledge: Knowledge
    axes: str
    meaning: str
    joint: bool = False

    def known_to(self, knower: Knowledge) -> bool:
        """Return whether a policy of this class may read the signal, or a sensor its row."""
        node = self.knowledge == "centre" and self.axes.startswith("(sensors") and not self.joint
        return covers(knower, self.knowledge) or (node and covers(knower, "own"))

    def __post_init__(self) -> None:
        validation.choice("knowledge", self.knowledge, KNOWLEDGE)


# The signals of every system with their default meanings.
_COMMON: tuple[tuple[str, Knowledge, str], ...] = (
    ("measurement", "own", "the new measurement"),
    ("innovation", "own", "measurement minus its expectation"),
    ("held", "centre", "the last delivered measurement"),
    ("age", "centre", "steps since the last delivery"),
    ("expected_measurement", "centre", "expectation of the measurement"),
    ("innovation_deviation", "centre", "predicted standard deviation of the innovation"),
    ("prior_mean", "centre", "prediction of the fused estimate"),
    ("prior_covariance", "centre", "covariance of the prediction"),
    ("silent_variance", "centre", "weighted trace of the fused covariance without a delivery"),
    ("variance_reduction", "centre", "reduction of this trace by this sensor's packet"),
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

    Args:
        axes: Axes of a measurement.
        **meanings: Descriptions by signal, which replace the general ones.
    """
    return tuple(
        Signal(n, k, _COMMON_AXES.get(n, axes), meanings.get(n, text), n == "variance_reduction")
        for n, k, text in _COMMON
    )


@dataclass(frozen=True)
class Block:
    """Declare a named group of entries of the agent's observation.

    Entries are clipped to ±``limit``, or without a limit to [0, 1].

    Args:
        name: Name of the block.
        meaning: Short description or formula.
        value: Function of a state after sensing. It returns the entries, scaled to order one, with
            the shape of the labels and N runs.
        labels: Labels of each axis. ``(("0", "1"), ("x1", "x2"))`` names the entries
            ``name[0,x1]``, ``name[0,x2]``, …; no axis names the one entry ``name``.
        knowledge: Least class that knows the block before any transmission.
        node: Part that a local sensor observes: its row of the first axis (``"own"``), all
            (``"broadcast"``) or none (``"hidden"``).
        limit: Bound of the entries' absolute value.
        constants: Numbers in ``meaning`` by symbol, mostly one per label of the last axes.

    Raises:
        ConfigurationError: ``knowledge`` or ``node`` is unknown.

    Example:
        >>> import numpy as np
        >>> from fusion_gym.core.system import Block
        >>> block = Block("mean", "x/2", lambda state: state / 2, labels=(("x1", "x2"),), limit=5.0)
        >>> block.places, block.bounds
        ((('x1',), ('x2',)), (-5.0, 5.0))
        >>> block.fill(np.ones((2, 3))).shape
        (2, 3)
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
        """Labels of each entry, in the order of a C-ordered array."""
        return tuple(itertools.product(*self.labels))

    @property
    def bounds(self) -> tuple[float, float]:
        """Lowest and highest value of an entry."""
        return (0.0, 1.0) if self.limit is None else (-self.limit, self.limit)

    def fill(self, state: Any) -> NDArray[Any]:
        """Return the entries of a state before clipping.

        Args:
            state: State of N runs after sensing.

        Returns:
            Entries (rows, N).

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
    """Return the block of a state's ``age`` (sensors, N), which every system has.

    Args:
        sensors: names of the sensors.

    Example:
        >>> from fusion_gym import age_block
        >>> age_block(("0", "1")).name
        'age'
    """
    meaning = "a/(a + 10), a steps since the last delivery"
    return Block(
        "age", meaning, lambda state: state.age / (state.age + 10.0), (sensors,), node="own"
    )


def sensed(prediction: PredictionT | None) -> PredictionT:
    """Return the prediction of a sensed state, or raise a ``RuntimeError`` for ``None``."""
    if prediction is None:
        raise RuntimeError("the state has no measurements yet: call sense first")
    return prediction


def log_deviation(covariance: Array, reference: Array) -> Array:
    """Return ln √(variance/reference) (..., n, N), minus infinity for a variance of zero.

    Args:
        covariance: (..., n, n, N).
        reference: Variances (n,), zero for a state that is always known.
    """
    possible = np.where(reference > 0.0, reference, np.inf)
    with np.errstate(divide="ignore"):
        return 0.5 * np.log(np.maximum(linalg.diagonal(covariance), 0.0) / possible[:, None])


def numbered(count: int) -> tuple[str, ...]:
    """Return the labels "0", "1", … of an axis."""
    return tuple(str(place) for place in range(count))


class SignalError(KeyError):
    """An unknown or withheld signal; a ``KeyError`` that shows plain text."""

    def __str__(self) -> str:
        return str(self.args[0])


class Signals(Mapping[str, SignalArray]):
    """The signals of one step, in physical units, batch axis last.

    Args:
        values: Arrays by name, or functions that compute them on first access.
        hidden: Names of signals that the information mode withholds.
        missing: Names of signals that are not computed, and the reasons.

    Raises:
        SignalError: On access to an unknown or withheld signal.
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
            "it (use information='sensors', or a policy that reads the centre's signals)"
            for name in hidden
        }

    def limit(self, refused: Mapping[str, str]) -> Self:
        """Return the signals without the ``refused`` ones, names and reasons."""
        result = copy.copy(self)
        result._withheld = {**self._withheld, **refused}
        return result

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
        """Names of the withheld or missing signals, and the reasons."""
        return self._withheld

    def __iter__(self) -> Iterator[str]:
        return (name for name in self._values if name not in self._withheld)

    def __len__(self) -> int:
        return sum(1 for _ in self)


# Methods and properties that a system may implement.
CAPABILITIES = (
    *("adopt", "arrival_probability", "arriving", "covariance_cycle", "error_covariance"),
    *("single_deliveries", "imagination_channels", "imagine", "with_actual_covariance"),
    *("available", "with_possible"),
)


class System(ABC, Generic[StateT]):
    """Define a networked estimation system for N runs at once.

    A state is a dataclass of arrays whose last axis is the batch; no method changes a state in
    place. In the shapes below n is the number of states.

    Attributes:
        state_names: Names of the plant's n states.
        signals: Declarations of the signals that :meth:`read` returns.
        nature: Departure of the truth from the model.
        extensions: Names of the public methods that a class adds to its bases.

    Raises:
        TypeError: A subclass has a public method that is neither in a base nor in ``extensions``.

    Example:
        >>> import numpy as np
        >>> import fusion_gym
        >>> system = fusion_gym.make_task("fusion_gym/TobitOscillator-v1").system
        >>> state = system.start(np.zeros((system.start_channels, 4)))
        >>> state = system.sense(state, np.zeros((system.noise_channels, 4)))
        >>> delivered = system.deliver(state, np.ones((system.sensor_count, 4), dtype=bool))
        >>> mean, covariance = system.fused(delivered)
        >>> mean.shape, covariance.shape
        ((2, 4), (2, 2, 4))
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
        """Return whether this system implements an optional capability.

        Args:
            capability: A name of ``CAPABILITIES``.

        Raises:
            ValueError: The capability is unknown.
        """
        if capability not in CAPABILITIES:
            raise ValueError(f"capability = {capability!r} is not allowed: see CAPABILITIES")
        return getattr(type(self), capability) is not getattr(System, capability)

    @property
    def numpy_only(self) -> str | None:
        """Name of the option that needs ``backend="numpy"``, ``None`` if JAX runs the system."""
        return "system"

    @property
    @abstractmethod
    def sensor_count(self) -> int:
        """Number of sensors."""

    @property
    @abstractmethod
    def noise_channels(self) -> int:
        """Number of standard normals that :meth:`sense` takes per run."""

    @property
    @abstractmethod
    def start_channels(self) -> int:
        """Number of standard normals that :meth:`start` takes per run, including ``nature``."""

    @property
    @abstractmethod
    def observation(self) -> tuple[Block, ...]:
        """Blocks of an agent's observation, in order."""

    @abstractmethod
    def start(self, noise: Array) -> StateT:
        """Return the state at time 0.

        Args:
            noise: Standard normals (start_channels, N).
        """

    @abstractmethod
    def sense(self, state: StateT, noise: Array) -> StateT:
        """Return the state after a step of the plant and the new measurements.

        Args:
            state: State after :meth:`deliver` or :meth:`start`.
            noise: Standard normals (noise_channels, N).
        """

    @abstractmethod
    def deliver(self, state: StateT, granted: NDArray[np.bool_]) -> StateT:
        """Return the state after the updates of the nodes and the fusion.

        Args:
            state: State after :meth:`sense`.
            granted: (sensors, N) bool, the granted packets.
        """

    @abstractmethod
    def read(self, state: StateT) -> Mapping[str, SignalArray | Callable[[], SignalArray]]:
        """Return the signals by name, as arrays or as functions that compute them.

        Args:
            state: State after :meth:`sense`.
        """

    @abstractmethod
    def visible(self, state: StateT) -> StateT:
        """Return the state without hidden quantities, for policies that plan.

        The truth and all future measurements are NaN. No packet is lost: :meth:`deliver` lets every
        granted packet arrive.

        Args:
            state: State after :meth:`sense`.
        """

    @abstractmethod
    def local_means(self, state: StateT) -> Array:
        """Return the nodes' means (sensors, n, N) before any feedback.

        Args:
            state: State after :meth:`deliver`.
        """

    @abstractmethod
    def open_loop(self, horizon: int) -> Array:
        """Return the mean error variance (n,) over t = 1..horizon without any delivery.

        Args:
            horizon: Steps of an episode.
        """

    def rounding(self, horizon: int) -> tuple[float, float]:
        """Return two ratios that bound the loss of float64's precision; 0 if unknown.

        Args:
            horizon: Steps of an episode.

        Returns:
            The largest mean square of a measurement over its noise variance, and the largest ratio
            of a predicted variance to the variance after a packet that ends a silence.
        """
        return 0.0, 0.0

    def truth(self, state: StateT) -> Array:
        """Return the plant's state (n, N), for the reward and metrics, never for a policy.

        Args:
            state: Any state.
        """
        truth: Array = cast(Any, state).truth
        return truth

    def fused(self, state: StateT) -> tuple[Array, Array]:
        """Return the fusion centre's mean (n, N) and covariance (n, n, N).

        Args:
            state: State after :meth:`deliver`.
        """
        delivered = cast(Any, state)
        return delivered.mean, delivered.covariance

    def fused_mean(self, state: StateT) -> Array:
        """Return the mean of :meth:`fused` (n, N); override it where the covariance is large.

        Args:
            state: State after :meth:`deliver`.
        """
        return self.fused(state)[0]

    @property
    def censored_beyond(self) -> Mapping[int, tuple[float, float]]:
        """Lowest and highest uncensored value of a state, by its number, for pictures."""
        return {}

    def arrival_probability(self, state: StateT) -> Array:
        """Return the probability (sensors, N) that a packet arrives if it is sent now.

        It depends only on the knowledge before any transmission. Systems with a lossy channel offer
        it.

        Args:
            state: State after :meth:`sense`.
        """
        raise self._missing("arrival_probability")

    def arriving(self, state: StateT, packets: NDArray[np.bool_]) -> StateT:
        """Return the state in which the channel does not lose these packets.

        Args:
            state: State after :meth:`sense`.
            packets: (sensors, N) bool.
        """
        raise self._missing("arriving")

    def adopt(
        self, state: StateT, mean: Array, covariance: Array, runs: NDArray[np.bool_]
    ) -> StateT:
        """Return a state whose fusion centre has another estimate in some runs.

        Args:
            state: State after :meth:`deliver`.
            mean: (n, N).
            covariance: (n, n, N).
            runs: (N,) bool, the runs whose estimate is replaced.
        """
        raise self._missing("adopt")

    def single_deliveries(self, state: StateT) -> tuple[Array, Array]:
        """Return the fused estimates after a delivery of each single packet.

        Systems without losses offer it where one common computation is faster than one per sensor.

        Args:
            state: State after :meth:`sense`.

        Returns:
            Means (sensors, n, N) and covariances (sensors, n, n, N). Entry i is :meth:`fused` after
            :meth:`deliver` of sensor i's packet only.
        """
        raise self._missing("single_deliveries")

    @property
    def imagination_channels(self) -> int:
        """Number of standard normals that :meth:`imagine` takes per run."""
        raise self._missing("imagination_channels")

    def imagine(self, state: StateT, mean: Array, covariance: Array, noise: Array) -> StateT:
        """Return a state with samples of all quantities that :meth:`visible` hides.

        The truth follows N(mean, covariance), and the other quantities follow their own laws.
        Measurements remain. Two systems of one plant draw the same samples from the same ``noise``.

        Args:
            state: State after :meth:`sense`.
            mean: (n, N).
            covariance: (n, n, N).
            noise: Standard normals (imagination_channels, N).
        """
        raise self._missing("imagine")

    @property
    def covariance_cycle(self) -> int:
        """Period, in steps, of the covariance recursion.

        Systems whose covariances depend only on the deliveries offer it.
        """
        raise self._missing("covariance_cycle")

    def available(self, state: StateT) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return the sensors (sensors, N) with a reading, and the states (n, N) of known truth.

        A sensor without a reading cannot request, and errors of other states count as zero. Systems
        that replay a recording with gaps offer it.

        Args:
            state: State after :meth:`sense`.
        """
        raise self._missing("available")

    def with_possible(self, state: StateT, possible: NDArray[np.bool_]) -> StateT:
        """Return the state for a delivery of which silence is information.

        Args:
            state: State after :meth:`sense`.
            possible: Sensors (sensors, N) whose requests the network would have granted.
        """
        raise self._missing("with_possible")

    def with_actual_covariance(self) -> System[StateT]:
        """Return the same system with states that :meth:`error_covariance` can evaluate."""
        raise self._missing("with_actual_covariance")

    def error_covariance(self, state: StateT) -> Array:
        """Return the actual covariance (n, n, N) of the fused error.

        After a start with zero noise it is the mean over all episodes, provided that the deliveries
        do not depend on the noise.

        Args:
            state: State after :meth:`deliver`, of :meth:`with_actual_covariance`.
        """
        raise self._missing("error_covariance")

    def _missing(self, capability: str) -> NotImplementedError:
        return NotImplementedError(f"{type(self).__name__} does not offer {capability!r}")
