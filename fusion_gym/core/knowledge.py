"""Signals and observation blocks, and the classes of knowledge that they belong to.

One partial order of knowledge classes serves signals, observations and policies.
"""

from __future__ import annotations

import copy
import functools
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, TypeVar, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.declaration import Mark, OptionGroup, Scaling
from fusion_gym.errors import refusal
from fusion_gym.namespace import namespace

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


# Knowledge class of each information mode.
INFORMATION_MODES: dict[str, Knowledge] = {"sensors": "scheduler", "centre": "centre"}
Feature = Literal["difference", "value"]
FEATURES: tuple[Feature, ...] = get_args(Feature)


@dataclass(frozen=True)
class ObservationOptions(OptionGroup):
    """The options of an episode's length and of an agent's observation."""

    belief_features: Sequence[Feature] | bool | None = None
    """Observation entries of the memory's estimate: ``"difference"`` from the fusion centre's
    estimate and ``"value"`` of a transmission. ``True`` is both, the default with memory. A delay
    excludes the value."""
    horizon: Annotated[int, Scaling(), Mark(validation.integer, at_least=1)] = 100
    """Steps of an episode. The open-loop error over the horizon scales reward and observation."""
    clock: Annotated[bool, Scaling()] = False
    """Whether the observation shows the steps left; the end of an episode is then a termination."""
    information: Literal["sensors", "centre"] = "sensors"
    """Content of the observation: the new measurements of all sensors (``"sensors"``), or only the
    fusion centre's knowledge before any transmission (``"centre"``)."""
    own_number: bool = True
    """Whether a local sensor observes its own number. ``False`` makes sensors of one kind
    indistinguishable to a shared policy."""

    def features(self, *, memory: bool, delayed: bool) -> tuple[Feature, ...]:
        """Return the observation entries of the memory, by default all with memory."""
        value: Any = self.belief_features
        if value is None:
            usual = FEATURES[:1] if delayed else FEATURES
            return usual if memory else ()
        if value is True:
            return FEATURES
        values = (value,) if isinstance(value, str) else value
        if not isinstance(values, Sequence):
            raise refusal("belief_features", value, f"a list of some of {FEATURES}, or true")
        for name in values:
            validation.choice("belief_features", name, FEATURES)
        return tuple(name for name in FEATURES if name in values)


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
        node: Part of the centre's knowledge that a local sensor has: its row of the first axis
            (``"own"``), all of it (``"broadcast"``) or none (``"hidden"``).

    Example:
        >>> from fusion_gym import Signal
        >>> Signal("surprise", "own", "(sensors, N)", "distance to the prediction").knowledge
        'own'
    """

    name: str
    knowledge: Knowledge
    axes: str
    meaning: str
    node: Literal["own", "broadcast", "hidden"] = "hidden"

    def __post_init__(self) -> None:
        validation.choice("knowledge", self.knowledge, KNOWLEDGE)
        validation.choice("node", self.node, ("own", "broadcast", "hidden"))

    def known_to(self, knower: Knowledge) -> bool:
        """Return whether a policy of this class may read the signal, or a sensor its row."""
        node = self.knowledge == "centre" and self.node != "hidden"
        return covers(knower, self.knowledge) or (node and covers(knower, "own"))


# The signals of every estimator with their default meanings.
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
_OF_CENTRE = ("prior_mean", "prior_covariance", "silent_variance", "variance_reduction")
_COMMON_AXES = {
    "age": "(sensors, N)",
    "prior_mean": "(n, N)",
    "prior_covariance": "(n, n, N)",
    "silent_variance": "(N,)",
    "variance_reduction": "(sensors, N)",
}


# Of estimators whose nodes have their own estimates.
LOCAL_VARIANCE = Signal(
    "local_variance",
    "centre",
    "(sensors, N)",
    "plain trace of the covariance of the node's state before a packet",
    "own",
)


# Knowledge in a task with memory; without memory "scheduler" and "own" suffice.
MEMORY_SIGNALS = (
    Signal(
        "belief_difference",
        "scheduler_memory",
        "(n, N)",
        "x* − x̂, the scheduler's estimate minus the centre's without a transmission",
    ),
    Signal(
        "transmission_value",
        "scheduler_memory",
        "(sensors, N)",
        "v(m) = ‖x* − x̂‖² − E‖x* − x̂(m)‖², in weights of mean 1",
    ),
    Signal("own_difference", "own_memory", "(sensors, n, N)", "x* − x̂ of each sensor"),
    Signal("own_value", "own_memory", "(sensors, N)", "v(m) of each sensor"),
)
NETWORK_SIGNALS = (
    Signal(
        "energy",
        "centre",
        "(sensors, N)",
        "tokens that pay for a sensor's packets: its own with budget='sensor', or the shared ones",
        "own",
    ),
    Signal(
        "channel_state",
        "centre",
        "(sensors, N)",
        "state of the channel at the step before: 0 bad, 1 good; (sensors, channels, N) with "
        '`access="assignment"`',
        "own",
    ),
    Signal(
        "arrival_probability",
        "centre",
        "(sensors, N)",
        "probability that a packet sent now arrives now, by the model, on the best channel",
        "own",
    ),
    Signal(
        "variance_order",
        "centre",
        "(sensors, N)",
        "a score in the order of `variance_reduction`, which a delay does not exclude",
    ),
    Signal(
        "link_probability",
        "centre",
        "(sensors, channels, N)",
        "probability that a packet sent now on this channel of an assignment arrives now",
        "own",
    ),
)
CONTROL_SIGNAL = Signal(
    "control", "centre", "(k, N)", "the last input of a controller", "broadcast"
)
# For policies that plan, and for saved agents.
PLANNING_SIGNALS = (
    Signal("estimate", "scheduler", "a state", "the estimator's state"),
    Signal("beliefs", "scheduler_memory", "beliefs", "the scheduler's belief of the state"),
    Signal("own_beliefs", "own_memory", "beliefs", "each sensor's belief of the state"),
)


def common_signals(axes: str = "(sensors, m, N)", **meanings: str) -> tuple[Signal, ...]:
    """Return the signals that every estimator offers.

    Args:
        axes: Axes of a measurement.
        **meanings: Descriptions by signal, which replace the general ones.
    """
    return tuple(
        Signal(
            name,
            knowledge,
            _COMMON_AXES.get(name, axes),
            meanings.get(name, text),
            "hidden" if name in _OF_CENTRE else "own",
        )
        for name, knowledge, text in _COMMON
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
        >>> from fusion_gym.core.knowledge import Block
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
    """Return the block of a state's ``age`` (sensors, N), which every estimator has.

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
    xp, variance = namespace(covariance), linalg.diagonal(covariance)
    with np.errstate(divide="ignore"):
        return 0.5 * xp.log(xp.maximum(variance, 0.0) / possible[:, None])


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
        nodes: The signals by what the sensors suppose; ``None`` is these signals.

    Raises:
        SignalError: On access to an unknown or withheld signal.
    """

    def __init__(
        self,
        values: Mapping[str, SignalArray | Callable[[], SignalArray]],
        hidden: Sequence[str] = (),
        missing: Mapping[str, str] | None = None,
        nodes: Signals | None = None,
    ) -> None:
        self._values, self.nodes = dict(values), nodes
        self._withheld = dict(missing or {}) | {
            name: f"signal {name!r} is known to the sensors only; information='centre' withholds "
            "it (use information='sensors', or a policy that reads the centre's signals)"
            for name in hidden
        }

    def limit(self, refused: Mapping[str, str], local: bool = False) -> Signals:
        """Return the signals, with ``local`` the sensors', without ``refused`` ones (reasons)."""
        result = copy.copy(self if self.nodes is None or not local else self.nodes)
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
