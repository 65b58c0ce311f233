"""What the environments' options have in common, and what an environment makes of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import declaration
from fusion_gym.arrays import Array
from fusion_gym.core.system import System
from fusion_gym.errors import refusal
from fusion_gym.fusion.table import Structure
from fusion_gym.importing import name_of

AccessRule = Literal["any", "single", "round_robin", "random"]
Tokens = Literal["limited", "unlimited"]
SharingRule = Literal["equal", "fixed", "rotating", "turns"]
ErrorKind = Literal["squared", "trace", "maximum"]
Broadcast = Literal["none", "estimate", "packets"]
Feature = Literal["difference", "value"]
Action = Literal["binary", "discrete"]
# What the scale of the reward depends on, beside plant and sensors.
_SCALING = (
    "access", "tokens", "token_rate", "token_capacity", "initial_tokens", "token_cost", "sharing",
    "horizon",
)  # fmt: skip


@dataclass(frozen=True)
class CommonOptions:
    """The options that every environment has; each gives them its own defaults.

    A field is the declaration of an option: type, default, and the docstring below it. Validation,
    ``help``, the specification and the tables of the documentation read it. A value that a type
    ``Literal`` or ``bool`` does not have is refused when the object is made.
    ``filters`` are the classes behind the values of an option ``filter``, whose docstrings declare
    them; ``structure`` decides which fusion rules an option ``fusion`` takes.
    """

    filters: ClassVar[Mapping[str, type]] = {}
    structure: ClassVar[Structure | None] = None

    access: AccessRule = "any"
    """Rule of medium access. ``"any"`` admits all requests, ``"single"`` the first in the queue.
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
    sharing: SharingRule = "turns"
    """How simultaneous requests share the tokens. ``"equal"`` gives each sensor the same share: ξ/l
    ≥ c (tobit_token_bucket, equations (16) and (18)). ``"fixed"`` grants in the order of the
    sensors while tokens last. ``"rotating"`` starts that order one sensor later in each step.
    ``"turns"`` grants in the order of a queue: a sensor that is granted goes to its end, and a head
    that the tokens do not pay for blocks those behind it."""
    packet: Literal["measurement", "estimate"] = "measurement"
    """Content of a packet. ``"measurement"`` is what the sensor measured or its node estimated.
    ``"estimate"`` is the centralised scheduler's estimate with its covariance, with ``memory=True``
    alone."""
    broadcast: Broadcast | None = None
    """What every node receives besides tokens and price: nothing, the fusion centre's prediction
    with its covariance, or every delivered packet. By default ``"estimate"`` where the centre feeds
    its estimate back, and otherwise ``"none"``."""
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
    cost_weight: float | Literal["random"] = 0.5
    """Price of a token in the reward. ``"random"`` draws it from ``price_range`` for each episode,
    evenly in its logarithm."""
    price_range: ArrayLike | Literal["auto"] | None = None
    """Pair (low, high) of prices. With it the observation shows the price. ``"auto"`` simulates
    rules: it takes the prices at which the best value of information with memory sends 60 and 12 %
    of what the bucket sustains, but at least two packets of each sensor in an episode."""
    state_weights: ArrayLike | None = None
    """Weights of the states' squared errors in the reward. By default the environment's own,
    which ``help`` shows."""
    reward_scale: float | Literal["auto"] | None = "auto"
    """Factor of the state weights. ``"auto"`` simulates a moderate policy and takes the factor with
    which its error costs 1 a step; given ``state_weights`` then stay as they are. That policy
    requests at an even pace: half of what the bucket sustains, or a quarter of all packets where
    tokens are unlimited. The entries of ``belief_features`` scale by its errors as well. With
    ``None`` the error without transmissions takes its place."""
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

    def nominal(self) -> Self:
        """Return the options whose simulation scales the reward: plant, sensors and network."""
        common = (item for item in fields(CommonOptions) if item.name not in _SCALING)
        plain = {item.name: getattr(type(self), item.name) for item in common}
        plain["reward_scale"] = None if self.reward_scale is None else 1.0
        return replace(self, **plain)


@dataclass(frozen=True)
class PaperOptions(CommonOptions):
    """Options of an environment whose reward scales by the error without transmissions."""

    reward_scale: float | Literal["auto"] | None = None
    cost_weight: float | Literal["random"] = 0.01


@dataclass(frozen=True)
class Scenario:
    """What an environment makes of its options: all that is its own of a task.

    ``state_weights`` (n,) weigh the squared errors in the reward if the options give none; ``None``
    weighs all states alike. ``reward_scale`` multiplies them. ``policy_defaults`` are the
    scenario's own parameters of named policies.

    ``feedback`` says that every node receives the centre's estimate by construction.
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


def plain_options(value: Any) -> Any:
    """Settings as plain lists, numbers and strings, ready for JSON."""
    if isinstance(value, dict):
        return {key: plain_options(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_options(entry) for entry in value]
    if callable(value):
        return name_of(value)
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
