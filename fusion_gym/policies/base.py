"""The one interface of every policy, and what the rules share."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.memory import Owner
from fusion_gym.core.signals import MEMORY_SIGNALS, PLANNING_SIGNALS
from fusion_gym.core.system import KNOWLEDGE, Knowledge, Signal, Signals, covers, least_covering
from fusion_gym.core.task import Task

Requests = NDArray[np.bool_]
PerSensor = float | tuple[float, ...]


class Policy(Protocol):
    """From signals to requests, for N runs at once.

    ``reset(runs, seed)`` comes before the first call; ``seed`` is for policies that draw. A call
    takes the signals of one step and returns requests (sensors, N) bool. A run begins a new
    episode wherever ``signals["start"]`` is true.

    A policy that looks at what is believed (:mod:`fusion_gym.core.signals`) has an attribute
    ``remember`` as well, ``"scheduler"`` or ``"own"``: whose beliefs. One that answers to the
    signals of the present step alone may say so by an attribute ``stateless``, true: it can then be
    asked in the middle of a simulated episode.
    """

    @property
    def knowledge(self) -> Knowledge:
        """The least class of :mod:`fusion_gym.core.system` that knows all that it looks at."""
        ...

    def reset(self, runs: int, seed: int = 0) -> None:
        """Forget everything."""
        ...

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N) for these signals."""
        ...


def owner_of(policy: Policy) -> Owner | None:
    """Whose beliefs a policy looks at; ``None`` for one that looks at none.

    Raises:
        ConfigurationError: an attribute ``remember`` that is neither.
    """
    result = getattr(policy, "remember", None)
    if result is None:
        return None
    validation.choice("remember", result, get_args(Owner))
    owner: Owner = result
    return owner


def refused_signals(policy: Policy, task: Task) -> dict[str, str]:
    """Return the signals outside a policy's declared knowledge, and why each is refused."""
    knower = getattr(policy, "knowledge", None) or KNOWLEDGE[-1]  # without one it reads all
    least = {signal.name: signal for signal in task.system.signals}
    if not task.memory and covers(knower, "own"):
        knower = least_covering((knower, "own_memory"))  # beliefs of the new measurements alone
    least |= {signal.name: signal for signal in (*MEMORY_SIGNALS, *PLANNING_SIGNALS)}
    node: Knowledge = "own" if covers(task.knowledge, "own") else task.knowledge
    least["observation"] = Signal("observation", node, "(N, entries)", "rows of every class")
    return {
        name: f"signal {name!r} belongs to the class {signal.knowledge!r}, and the policy "
        f"{type(policy).__name__} declares knowledge = {policy.knowledge!r}: declare a class that "
        "covers it"
        for name, signal in least.items()
        if not signal.known_to(knower)
    }


def is_stateless(policy: Policy) -> bool:
    """Whether a policy says that it keeps nothing from step to step and draws nothing."""
    return bool(getattr(policy, "stateless", False))


class Rule:
    """Base of the analytic policies: a dataclass of parameters, checked before anything runs."""

    @property
    def knowledge(self) -> Knowledge:
        """The least class that knows all that it looks at; every rule declares its own."""
        raise TypeError(f"{type(self).__name__} does not say who knows what it looks at")

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            if check := field.metadata.get("check"):
                check(field.name, getattr(self, field.name))
        self.reset(0)

    @property
    def stateless(self) -> bool:
        """Whether it has nothing to forget: no :meth:`reset` of its own."""
        return type(self).reset is Rule.reset

    def column(self, name: str, sensors: int) -> Array:
        """The parameter of this name as (sensors, 1): one number for all sensors, or one for each.

        Raises:
            ConfigurationError: another number of entries.
        """
        return validation.spread(name, getattr(self, name), (sensors,))[:, None]

    def reset(self, runs: int, seed: int = 0) -> None:
        """Nothing to forget, unless a rule with variables of its own says otherwise."""

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N) for these signals."""
        raise TypeError(f"{type(self).__name__} does not say what it requests")


def parameter(default: Any, check: Callable[..., Any], **limits: float) -> Any:
    """A rule's parameter: its default, and ``check(name, value, **limits)`` for every value."""
    check = functools.partial(check, **limits)
    return dataclasses.field(default=default, metadata={"check": check})


def not_negative_parameter(name: str, value: Any) -> None:
    """One number >= 0 or a sequence of them.

    Raises:
        ConfigurationError: anything else.
    """
    validation.not_negative(name, value, validation.one_or_each(value))


def each_number(name: str, value: Any, **limits: float) -> None:
    """One number within :func:`validation.number`'s limits or a sequence of them.

    Raises:
        ConfigurationError: anything else.
    """
    for entry in np.atleast_1d(np.asarray(value, dtype=object)):
        validation.number(name, entry, **limits)


def check_at_most(name: str, value: int | None) -> None:
    """How many sensors may be requested in a step: a whole number >= 1, or None for all.

    Raises:
        ConfigurationError: anything else.
    """
    if value is not None:
        validation.integer(name, value, at_least=1, at_most=validation.MOST_SENSORS)


def shape_of(signals: Signals) -> tuple[int, int]:
    """Number of sensors and of runs."""
    return len(signals["token_cost"]), len(signals["tokens"])


def surprise(signals: Signals, whitened: bool = False) -> Array:
    """|ε|² (sensors, N) of the innovations ε, ``whitened``: in predicted standard deviations."""
    innovation = signals["innovation"]
    if whitened:
        innovation = innovation / signals["innovation_deviation"]
    return linalg.dot(innovation, innovation)


def strongest(score: Array, requests: Requests, at_most: int | None, age: Array) -> Requests:
    """Of the ``requests`` (sensors, N) those ``at_most`` with the highest score in each run.

    Equal scores go to the sensor that was silent for longer, then to the first.
    """
    sensors = len(score)
    if at_most is None or at_most >= sensors:
        return requests
    ranked = np.where(requests, score, -np.inf)
    order = np.lexsort((-age, -ranked), axis=0)
    selected = np.zeros_like(requests)
    np.put_along_axis(selected, order[:at_most], True, axis=0)
    return selected & requests
