"""The interface of every policy, and functions that the rules share."""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, NamedTuple, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.knowledge import (
    CONTROL_SIGNAL,
    KNOWLEDGE,
    MEMORY_SIGNALS,
    NETWORK_SIGNALS,
    PLANNING_SIGNALS,
    Knowledge,
    Signal,
    Signals,
    covers,
    least_covering,
)
from fusion_gym.core.memory import Owner
from fusion_gym.core.task import Task
from fusion_gym.namespace import namespace

Requests = NDArray[np.bool_]
PerSensor = float | tuple[float, ...]
_BLOCK = 64  # steps that a ChanceRule draws at a time


class Policy(Protocol):
    """A function from signals to requests, for N runs.

    ``reset(runs, seed)`` precedes the first call; a policy that draws uses ``seed``. A call takes
    the signals of one step and returns requests (sensors, N) bool; with ``access="assignment"``
    they may be channels from 1, and 0 for silence. A run begins a new episode where
    ``signals["start"]`` is true.

    A policy that uses beliefs (:mod:`fusion_gym.core.knowledge`) has an attribute ``memory_owner``,
    ``"scheduler"`` or ``"own"``, the owner of the beliefs. A policy that uses only the signals of
    the present step may have a true attribute ``stateless``; simulations may then call it inside an
    episode.

    Example:
        >>> import fusion_gym
        >>> task = fusion_gym.make_task("fusion_gym/TobitOscillator-v1")
        >>> policy: fusion_gym.Policy = fusion_gym.make_policy("always", task)
        >>> policy.knowledge
        'clock'
    """

    @property
    def knowledge(self) -> Knowledge:
        """The least class (:mod:`fusion_gym.core.knowledge`) that has every signal it uses."""
        ...

    def reset(self, runs: int, seed: int = 0) -> None:
        """Clear the memory before N = ``runs`` new episodes."""
        ...

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N) for these signals."""
        ...


def owner_of(policy: Policy) -> Owner | None:
    """Return the owner of the beliefs that a policy uses, or ``None`` if it uses no beliefs."""
    owner: Owner | None = getattr(policy, "memory_owner", None)
    if owner is not None:
        validation.choice("memory_owner", owner, get_args(Owner))
    return owner


def refused_signals(policy: Policy, task: Task) -> dict[str, str]:
    """Return the signals outside a policy's declared knowledge, with the reason of each refusal."""
    knower = getattr(policy, "knowledge", None) or KNOWLEDGE[-1]  # no declaration: all signals
    if not task.options.memory and covers(knower, "own"):
        knower = least_covering((knower, "own_memory"))  # beliefs use only the new measurements
    common = (*MEMORY_SIGNALS, *NETWORK_SIGNALS, *PLANNING_SIGNALS, CONTROL_SIGNAL)
    every = (*task.estimator.signals, *common)
    least = {signal.name: signal for signal in every}
    node: Knowledge = "own" if covers(task.knowledge, "own") else task.knowledge
    bucket = task.network.bucket
    if bucket.per_sensor and not bucket.unlimited:  # a sensor knows only its own energy
        least["tokens"] = Signal("tokens", "centre", "(N,)", "tokens of all buckets")
    least["observation"] = Signal("observation", node, "(N, entries)", "rows of every class")
    return {
        name: f"signal {name!r} belongs to the class {signal.knowledge!r}, and the policy "
        f"{type(policy).__name__} declares knowledge = {policy.knowledge!r}: declare a class that "
        "covers it"
        for name, signal in least.items()
        if not signal.known_to(knower)
    }


def guard(policy: Policy, task: Task) -> Callable[[Signals], Requests]:
    """Return the policy as a function that cannot read signals outside its declared knowledge."""
    refused, knower = refused_signals(policy, task), getattr(policy, "knowledge", None)
    local = knower is not None and not covers(knower, "centre")
    return lambda signals: policy(signals.limit(refused, local))


def decide(policy: Policy, batch: EpisodeBatch, seed: int) -> Iterator[Requests]:
    """Yield a policy's requests (sensors, N) before each step of an episode; the caller steps.

    This is the one loop of a policy over an episode. The policy reads no signal outside its
    declared knowledge.

    Args:
        policy: The policy, which is reset first.
        batch: Runs at the start of an episode, with the memory of :func:`owner_of` the policy.
        seed: Seed of a policy that draws.

    Raises:
        LookupError: The policy uses a signal outside its knowledge, or one that the task withholds.
    """
    policy.reset(batch.num_envs, seed)
    decision = guard(policy, batch.task)
    for _ in range(batch.task.horizon):
        yield decision(batch.signals())


class SearchRange(NamedTuple):
    """Where :mod:`fusion_gym.evaluation.rule_search` looks for a parameter.

    Args:
        low: least value; equal ends fix a parameter whose unit another one has too.
        high: largest value.
        per_sensor: whether every sensor has a value of its own.
        logarithmic: whether the search moves the logarithm.
        deviation: first standard deviation, of the logarithm if that moves.
        whole: whether the values are whole numbers.

    Example:
        >>> from fusion_gym.policies.base import SearchRange
        >>> SearchRange(1, 100, whole=True).value(np.log([2.2, 7.9])).tolist()
        [2, 8]
    """

    low: float
    high: float
    per_sensor: bool = True
    logarithmic: bool = True
    deviation: float = 0.3
    whole: bool = False

    def coordinate(self, value: Any) -> Any:
        """Return the coordinate of a value."""
        with np.errstate(divide="ignore"):
            return np.log(value) if self.logarithmic else value

    def value(self, coordinate: Array) -> Array:
        """Return the value of a coordinate, within the range."""
        value = np.exp(coordinate) if self.logarithmic else coordinate
        value = np.clip(value, self.low, self.high)
        return np.rint(value).astype(np.int64) if self.whole else value


THRESHOLD = SearchRange(1e-4, 1e4)
SHARED_THRESHOLD = THRESHOLD._replace(per_sensor=False)
PRICE = {"price": SHARED_THRESHOLD}  # of policies without fields
INTERVAL = SearchRange(1, 1000, per_sensor=False, whole=True)


def parameter(
    default: Any, check: Callable[..., Any], search: SearchRange | None = None, **limits: Any
) -> Any:
    """Return the field of a parameter with its default and ``check(name, value, **limits)``.

    Args:
        default: the default value.
        check: function that refuses a value, such as a check of :mod:`fusion_gym.validation`.
        search: range of a search, a :class:`~fusion_gym.policies.base.SearchRange`; None for none.
        **limits: keywords of the check.

    Example:
        >>> from dataclasses import dataclass
        >>> from fusion_gym import Rule, parameter, validation
        >>> @dataclass
        ... class Late(Rule):
        ...     steps: int = parameter(5, validation.integer, at_least=1)
        >>> Late().steps
        5
    """
    check = functools.partial(check, **limits)
    return dataclasses.field(default=default, metadata={"check": check, "search": search})


def optional(check: Callable[..., Any], **limits: Any) -> Callable[[str, Any], None]:
    """Return a check that also allows None."""

    def checked(name: str, value: Any) -> None:
        if value is not None:
            check(name, value, **limits)

    return checked


check_at_most = optional(validation.integer, at_least=1, at_most=validation.MOST_SENSORS)
check_price = optional(validation.number, at_least=0.0)


class Stateless:
    """Base class of policies that have no memory and draw nothing."""

    stateless: ClassVar[bool] = True

    def reset(self, runs: int, seed: int = 0) -> None:
        """Do nothing; the policy has no memory."""


class Rule:
    """Base class of the trigger rules: a dataclass whose fields are the parameters of the rule.

    A subclass declares ``knowledge``, the least knowledge class with all its signals, and returns
    requests (sensors, N) bool from ``__call__``. Parameters with a check (:func:`parameter`) are
    checked at construction. A rule with variables overrides ``reset``, which runs at construction
    and before the first call. A rule without variables and draws may declare ``stateless = True``;
    its subclasses declare it again.

    Raises:
        ConfigurationError: a parameter that is not allowed.

    Example:
        >>> from dataclasses import dataclass
        >>> from typing import ClassVar
        >>> import numpy as np
        >>> from fusion_gym.policies.base import Rule, shape_of
        >>> @dataclass
        ... class EveryThird(Rule):
        ...     knowledge: ClassVar[str] = "clock"
        ...     stateless: ClassVar[bool] = True
        ...
        ...     def __call__(self, signals):
        ...         return np.broadcast_to(signals["step"] % 3 == 0, shape_of(signals)).copy()
        >>> EveryThird().stateless
        True
    """

    stateless: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        """Take ``stateless`` from the class itself, because its call may draw."""
        cls.stateless = cls.__dict__.get("stateless", False)

    @property
    def knowledge(self) -> Knowledge:
        """The least knowledge class with all signals of the rule; each rule declares its own."""
        raise TypeError(f"{type(self).__name__} must declare knowledge")

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            value = getattr(self, field.name)
            if (check := field.metadata.get("check")) and namespace(value) is np:
                check(field.name, value)
        self.reset(0)

    def column(self, name: str, sensors: int) -> Array:
        """Return a parameter as (sensors, 1), from one number for all sensors or one for each."""
        value, xp = getattr(self, name), namespace(getattr(self, name))
        if xp is not np:
            return xp.broadcast_to(value, (sensors,))[:, None]
        return validation.spread(name, value, (sensors,))[:, None]

    def admissible(self, values: dict[str, Array]) -> dict[str, Array]:
        """Return parameters (size, K) that a search tries as the nearest allowed ones."""
        return values

    def reset(self, runs: int, seed: int = 0) -> None:
        """Clear the variables of the rule; the base class has none."""

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N) for these signals."""
        raise TypeError(f"{type(self).__name__} must implement __call__")


@dataclasses.dataclass(kw_only=True)
class LocalRule(Rule):
    """Base class of the rules of single sensors, with the intervals of devices.

    Args:
        min_interval: least steps between two deliveries of a sensor, >= 1.
        max_interval: most steps between two deliveries of a sensor; None for no limit.

    Raises:
        ConfigurationError: an interval below 1, or a max_interval below min_interval.
    """

    min_interval: int = parameter(1, validation.integer, INTERVAL, at_least=1)
    max_interval: int | None = parameter(None, optional(validation.integer, at_least=1), INTERVAL)

    def __post_init__(self) -> None:
        super().__post_init__()
        pair = self.min_interval, self.max_interval
        if self.max_interval is not None and namespace(*pair) is np:
            validation.integer("max_interval", self.max_interval, at_least=self.min_interval)

    def admissible(self, values: dict[str, Array]) -> dict[str, Array]:
        """Return parameters with max_interval at least min_interval."""
        if "max_interval" in values:
            least = values.get("min_interval", np.array(self.min_interval))
            values |= {"max_interval": np.maximum(values["max_interval"], least)}
        return values

    def limit(self, requests: Requests, signals: Signals) -> Requests:
        """Return the requests (sensors, N) within the intervals."""
        if self.max_interval is not None:
            requests = requests | (signals["age"] >= self.max_interval)
        if namespace(self.min_interval) is not np or self.min_interval > 1:
            requests = requests & (signals["age"] >= self.min_interval)
        return requests


class ChanceRule(Rule):
    """A rule that draws uniform numbers in [0, 1), independent of the noise of the same seeds.

    Run i has the stream of ``seed + i`` and the rule's number ``stream``, so its draws depend
    neither on the other runs nor on any signal.
    """

    stream: ClassVar[int]

    def reset(self, runs: int, seed: int = 0) -> None:
        """Restart the random streams; run i draws from the stream of ``seed + i``."""
        seeds = range(seed, seed + runs)
        self._generators = [np.random.default_rng([seed, self.stream]) for seed in seeds]
        self._drawn: Array | None = None
        self._used = 0

    def draw(self, sensors: int, runs: int) -> Array:
        """Return the numbers (sensors, N) of the next step."""
        if len(self._generators) != runs:
            self.reset(runs)
        if self._drawn is None or self._used == _BLOCK:
            drawn = [generator.random((_BLOCK, sensors)) for generator in self._generators]
            self._drawn, self._used = np.stack(drawn, axis=-1), 0
        self._used += 1
        return self._drawn[self._used - 1]


def not_negative_parameter(name: str, value: Any) -> None:
    """Check that a parameter is one number >= 0 or a sequence of such numbers."""
    validation.not_negative(name, value, validation.parameter_shape(value))


def each_number(name: str, value: Any, **limits: float) -> None:
    """Check one number or a sequence of numbers by :func:`validation.number`."""
    for entry in np.atleast_1d(np.asarray(value, dtype=object)):
        validation.number(name, entry, **limits)


def shape_of(signals: Signals) -> tuple[int, int]:
    """Return the number of sensors and of runs."""
    return len(signals["token_cost"]), len(signals["step"])


def surprise(signals: Signals, whitened: bool = False) -> Array:
    """Return |ε|² (sensors, N) of the innovations ε, ``whitened`` by predicted deviations."""
    innovation = signals["innovation"]
    if whitened:
        innovation = innovation / signals["innovation_deviation"]
    return linalg.dot(innovation, innovation)


def strongest(score: Array, requests: Requests, at_most: int | None, age: Array) -> Requests:
    """Return the ``at_most`` requests (sensors, N) with the highest scores in each run.

    Equal scores go to the sensor with the longest silence, then to the first sensor.

    Args:
        score: score of each sensor (sensors, N).
        requests: requests of each sensor (sensors, N).
        at_most: largest number of requests in a run; None for no limit.
        age: steps since the last delivery (sensors, N).
    """
    if at_most is None or at_most >= len(score):
        return requests
    xp = namespace(score, requests)
    ranked = xp.where(requests, score, -np.inf)
    order = xp.lexsort((-age, -ranked), axis=0)
    return requests & (xp.argsort(order, axis=0) < at_most)
