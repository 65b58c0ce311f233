"""What the environments' options have in common, and what an environment makes of them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.system import System
from fusion_gym.errors import ConfigurationError, refusal
from fusion_gym.fusion.table import Structure
from fusion_gym.importing import name_of


@dataclass(frozen=True)
class CommonOptions:
    """The options that every environment has; each gives them its own defaults.

    Network, access and token bucket; what a packet holds and who hears what; memory; episode,
    observation, action and reward; how far the truth departs from what everybody assumes.
    ``filters`` are the classes behind the values of an option ``filter``, whose docstrings declare
    them; ``structure`` decides which fusion rules an option ``fusion`` takes.
    """

    filters: ClassVar[Mapping[str, type]] = {}
    structure: ClassVar[Structure | None] = None

    access: str = "any"
    tokens: str = "limited"
    token_rate: float = 5.0
    token_capacity: float = 30.0
    initial_tokens: float = 10.0
    token_cost: ArrayLike = 3.0
    sharing: str = "rotating"
    packet: str = "measurement"
    broadcast: str | None = None
    memory: bool = False
    memory_filter: str | None = None
    belief_features: Sequence[str] | bool | None = None
    horizon: int = 100
    clock: bool = False
    information: str = "sensors"
    own_number: bool = True
    action: str = "binary"
    reward: str = "scalar"
    error: str | Callable[[Array, Array], Any] = "squared"
    error_weight: float = 1.0
    cost_weight: float | str = 0.01
    price_range: ArrayLike | None = None
    state_weights: ArrayLike | None = None
    true_process_noise: ArrayLike = 1.0
    true_measurement_noise: ArrayLike = 1.0
    true_threshold_shift: ArrayLike = 0.0
    true_transition: ArrayLike = 1.0


# The rows of a departure, by the options that they come from, with what an environment must have.
DEPARTURES = {
    "true_process_noise": "the plant has no process noise",
    "true_measurement_noise": "the sensors measure without noise",
    "true_threshold_shift": "no sensor is censored",
    "true_transition": "the plant stays where noise and input put it",
}
_SHIFT = "true_threshold_shift"
_MODEL = (1.0, 1.0, 0.0, 1.0)  # no departure at all
_FACTORS = (1e-3, 1e3)
_LARGEST_GROWTH = 1e24  # of the plant's second moment over an episode


@dataclass(frozen=True)
class Nature:
    """By how much the truth departs from the model that filters and policies assume.

    A departure (4, N) is what N runs have of it: the factors on the deviations of process and of
    measurement noise, what is added to the limits of the sensors, and the factor c of the motion,
    which takes the plant from x to x + c (f(x) - x) where the model says f(x). ``None`` stands for
    none. Each episode draws its own between ``low`` and ``high`` (4,), factors evenly in the
    logarithm, the shift evenly; where both are equal nothing is drawn.
    """

    low: tuple[float, ...] = _MODEL
    high: tuple[float, ...] = _MODEL

    @classmethod
    def create(cls, chosen: CommonOptions, absent: Collection[str] = ()) -> Nature:
        """Of the options; ``absent`` are those of them that can change nothing here.

        Raises:
            ConfigurationError: neither a number nor a pair (low, high) that rises, a factor outside
                0.001 to 1000, or an option that can change nothing and is asked to.
        """
        pairs = [_span(name, getattr(chosen, name)) for name in DEPARTURES]
        nature = cls(*(tuple(ends) for ends in zip(*pairs, strict=True)))
        for name in nature.departing:
            if name in absent:
                model = _MODEL[list(DEPARTURES).index(name)]
                raise refusal(
                    name, getattr(chosen, name), f"{model:g} here, for {DEPARTURES[name]}"
                )
        return nature

    @property
    def departing(self) -> tuple[str, ...]:
        """The options in which the truth is not the model."""
        ends = zip(DEPARTURES, self.low, self.high, _MODEL, strict=True)
        return tuple(name for name, low, high, model in ends if not low == high == model)

    @property
    def channels(self) -> int:
        """Standard normals at the end of a start's: one for each option that is drawn."""
        return sum(low < high for low, high in zip(self.low, self.high, strict=True))

    def begin(self, noise: Array) -> tuple[Array, Array | None]:
        """A start's own normals, and the departure (4, N) that the :attr:`channels` last draw."""
        if not self.departing:
            return noise, None
        own, last = np.split(noise, (len(noise) - self.channels,))
        uniform = iter(ndtr(last))
        departure = np.empty((len(self.low), noise.shape[-1]))
        for row, (name, low, high) in enumerate(zip(DEPARTURES, self.low, self.high, strict=True)):
            if low == high:
                departure[row] = low
            elif name == _SHIFT:
                departure[row] = low + (high - low) * next(uniform)
            else:
                departure[row] = low * (high / low) ** next(uniform)
        return own, departure

    def check_growth(self, radius: Callable[[float], float], horizon: int) -> None:
        """Whether the plant stays within bounds, of a spectral radius that follows from c.

        Raises:
            ConfigurationError: it does not.
        """
        ends = {self.low[-1], self.high[-1]} - {_MODEL[-1]}
        largest = max((radius(end) for end in ends), default=0.0)
        if 2.0 * horizon * np.log10(max(largest, 1.0)) > np.log10(_LARGEST_GROWTH):
            raise ConfigurationError(
                f"true_transition = {self._given('true_transition')} is not allowed with horizon = "
                f"{horizon}: the true plant's spectral radius would be {largest:.4g}, and its "
                f"square may grow by {_LARGEST_GROWTH:g} at most in an episode"
            )

    def refuse(self, where: str, why: str = "that holds where the truth is as assumed") -> None:
        """Refuse any departure.

        Raises:
            ConfigurationError: the truth departs from the model; says where and why it must not.
        """
        for name in self.departing:
            raise ConfigurationError(
                f"{name} = {self._given(name)} is not allowed {where}: it must be "
                f"{_MODEL[list(DEPARTURES).index(name)]:g}, for {why}"
            )

    def _given(self, name: str) -> str:
        row = list(DEPARTURES).index(name)
        low, high = self.low[row], self.high[row]
        return f"{low:g}" if low == high else f"[{low:g}, {high:g}]"


AS_ASSUMED = Nature()


def nature_of(system: System[Any]) -> Nature:
    """How the truth of a system departs from its model; one without ``nature`` has no departure."""
    found: Nature = getattr(system, "nature", AS_ASSUMED)
    return found


def _span(name: str, value: Any) -> tuple[float, float]:
    """Both ends of what an option draws from, equal for a number."""
    low, high = validation.spread(name, value, (2,)).tolist()
    least, most = (-np.inf, np.inf) if name == _SHIFT else _FACTORS
    if not (least <= low and high <= most and (np.ndim(value) == 0 or low < high)):
        limits = "" if name == _SHIFT else f" from {least:g} to {most:g}"
        raise refusal(name, value, f"a number{limits}, or a pair of such (low, high), low < high")
    return low, high


def true_noise(departure: Array | None, process: Array, measurement: Array) -> tuple[Array, Array]:
    """Noises (…, N) of process and measurement as they really are, of those of the model."""
    if departure is None:
        return process, measurement
    return departure[0] * process, departure[1] * measurement


def true_motion(departure: Array | None, state: Array, moved: Array) -> Array:
    """Where x (n, N) really goes, x + c (f(x) - x), where the model has it ``moved`` to f(x)."""
    return moved if departure is None else moved + (departure[3] - 1.0) * (moved - state)


def true_limits(departure: Array | None, limit: Array) -> Array:
    """The limits (…, 1) of the model's sensors as they really are, (…, N)."""
    return limit if departure is None else limit + departure[2]


@dataclass(frozen=True)
class Scenario:
    """What an environment makes of its options: all that is its own of a task.

    ``state_weights`` (n,) weigh the squared errors in the reward if the options give none; ``None``
    weighs all states alike, so that open loop costs one a step. ``policy_defaults`` are the
    scenario's own parameters of named policies.

    ``feedback`` says that every node hears the centre's estimate by construction.
    ``memory_system`` is the system, on the same noise, whose filter remembers what was not sent;
    ``None`` is the system itself, and with ``nodes_remember`` there is no need of it: every node's
    packet holds all that the node has ever measured. ``no_estimates`` is why a packet cannot hold
    an estimate, where it cannot.
    """

    options: CommonOptions
    system: System[Any]
    state_weights: ArrayLike | None = None
    policy_defaults: dict[str, dict[str, Any]] = field(default_factory=dict)
    feedback: bool = False
    memory_system: System[Any] | None = None
    nodes_remember: bool = False
    no_estimates: str | None = None


def plain(value: Any) -> Any:
    """Settings as plain lists, numbers and strings, ready for JSON."""
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if callable(value):
        return name_of(value)
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
