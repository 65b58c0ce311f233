"""What the environments' options have in common, and what an environment makes of them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr

from fusion_gym import declaration, validation
from fusion_gym.arrays import Array
from fusion_gym.core.system import System
from fusion_gym.errors import ConfigurationError, refusal
from fusion_gym.importing import name_of

AccessRule = Literal["any", "single", "round_robin", "random"]
Tokens = Literal["limited", "unlimited"]
SharingRule = Literal["equal", "fixed", "rotating"]
ErrorKind = Literal["squared", "trace", "maximum"]
Broadcast = Literal["none", "estimate", "packets"]
Feature = Literal["difference", "value"]
Action = Literal["binary", "discrete"]


@dataclass(frozen=True)
class CommonOptions:
    """The options that every environment has; each gives them its own defaults.

    A field is the declaration of an option: type, default, and the docstring below it. Validation,
    ``help``, the specification and the tables of the documentation read it. A value that a type
    ``Literal`` or ``bool`` does not have is refused when the object is made.
    """

    access: AccessRule = "any"
    """Rule of medium access. ``"any"`` admits all requests, ``"single"`` grants one request a step.
    ``"round_robin"`` admits one sensor a step in turn, ``"random"`` one at random. With
    ``"single"`` the action is ``Discrete(sensors + 1)``: 0 for nobody, m for sensor m - 1."""
    tokens: Tokens = "limited"
    """``"limited"`` applies the token bucket. ``"unlimited"`` grants every request and still counts
    the tokens spent."""
    token_rate: float = 5.0
    """Tokens g that the bucket gains per step (tobit_token_bucket, equation (17))."""
    token_capacity: float = 30.0
    """Largest number b of tokens in the bucket (tobit_token_bucket, equation (17))."""
    initial_tokens: float = 10.0
    """Tokens ξ₀ at the start of an episode."""
    token_cost: ArrayLike = 3.0
    """Tokens c that a transmission costs: one number, or one per sensor."""
    sharing: SharingRule = "rotating"
    """How simultaneous requests share the tokens. ``"equal"`` gives each sensor the same share: ξ/l
    ≥ c (tobit_token_bucket, equations (16) and (18)). ``"fixed"`` grants in the order of the
    sensors while tokens last. ``"rotating"`` starts that order one sensor later in each step."""
    packet: Literal["measurement", "estimate"] = "measurement"
    """Content of a packet: the sensor's measurement as in the paper, or the centralised scheduler's
    estimate with its covariance. ``"estimate"`` needs ``memory=True``."""
    broadcast: Broadcast | None = None
    """What every node receives besides tokens and price: nothing, the fusion centre's prediction
    with its covariance, or every delivered packet. By default as in the paper."""
    memory: bool = False
    """Whether measurements that were not sent are remembered, by the centralised scheduler or by
    each sensor."""
    memory_filter: str | None = None
    """Filter of the memory, a value of the option ``filter``. By default the fusion centre's, or a
    better one where that filter minimises a bound."""
    belief_features: Sequence[Feature] | bool | None = None
    """What the observation shows of the memory's estimate: its difference from the fusion centre's
    estimate, and the value of a transmission. ``True`` stands for both, the default with memory."""
    horizon: int = 100
    """Steps of an episode. The horizon also sets the open-loop level that scales reward and
    observation."""
    clock: bool = False
    """Whether the observation shows the steps left; the end of an episode is then a termination."""
    information: Literal["sensors", "centre"] = "sensors"
    """What the observation shows: the new measurements of all sensors, or only what the fusion
    centre knows before anything is sent."""
    own_number: bool = True
    """Whether a decentralised sensor observes its own number. Without it, sensors of one kind learn
    together."""
    action: Action = "binary"
    """Action space: one bit per sensor, or the bits as one number with sensor 0 the lowest."""
    reward: Literal["scalar", "vector"] = "scalar"
    """``"scalar"`` pays the sum of the reward's two terms, ``"vector"`` both terms."""
    error: ErrorKind | str | Callable[[Array, Array], Any] = "squared"
    """Error term of the reward: the squared errors, the diagonal of the claimed covariance (which a
    policy may be able to game), or the largest weighted squared error. Or a function of errors and
    covariances, or its ``"module:name"``."""
    error_weight: float = 1.0
    """Weight of the reward's error term."""
    cost_weight: float | Literal["random"] = 0.01
    """Price of a token in the reward. ``"random"`` draws it from ``price_range`` for each episode,
    evenly in its logarithm."""
    price_range: ArrayLike | None = None
    """Pair (low, high) of prices. With it the observation shows the price."""
    state_weights: ArrayLike | None = None
    """Weights of the states' squared errors in the reward. By default never transmitting costs
    about 1 a step."""
    true_process_noise: ArrayLike = 1.0
    """Factor of the true deviation of the process noise. The filters assume 1. A pair (low, high)
    is drawn from for each episode."""
    true_measurement_noise: ArrayLike = 1.0
    """Factor of the true deviation of the measurement noise. The filters assume 1. A pair
    (low, high) is drawn from for each episode."""
    true_threshold_shift: ArrayLike = 0.0
    """Shift of the true limits at which sensors are censored. The filters assume 0. A pair
    (low, high) is drawn from for each episode."""
    true_transition: ArrayLike = 1.0
    """Factor c of the true motion, from x to x + c (f(x) - x). The filters assume f(x). A pair
    (low, high) is drawn from for each episode."""

    def __post_init__(self) -> None:
        if str(self.information) == "local":
            calls = "fusion_gym.parallel_env(id) and make_sb3_vec_env(id, n, local=True)"
            allowed = f"'sensors' or 'centre'; decentralised sensors are {calls}"
            raise refusal("information", "local", allowed)
        declaration.check(self)


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
