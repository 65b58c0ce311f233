"""The options that all environments share, and the scenario that an environment builds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import declaration, validation
from fusion_gym.arrays import Array
from fusion_gym.core.access import ACCESS
from fusion_gym.core.channel import InitialState
from fusion_gym.core.estimator import Estimator
from fusion_gym.core.noise import NoiseSource
from fusion_gym.core.plant import Plant
from fusion_gym.entries import Arguments
from fusion_gym.errors import refusal
from fusion_gym.fusion.table import Structure
from fusion_gym.importing import name_of

AccessRule = Annotated[str, ACCESS]
Tokens = Literal["limited", "unlimited"]
SharingRule = Literal["equal", "fixed", "turns"]
Budget = Literal["shared", "sensor"]
Harvest = Literal["constant", "bernoulli"]
ErrorKind = Literal["squared", "trace", "maximum"]
Broadcast = Literal["none", "estimate", "packets"]
Feature = Literal["difference", "value"]
Action = Literal["binary", "multidiscrete", "discrete", "assignment"]
Backend = Literal["numpy", "compiled"]
# Options that affect the scale of the reward, besides plant and sensors.
_SCALING = (
    "access", "slots", "discrepancy", "discrepancy_weights", "channels", "tokens", "token_rate",
    "token_capacity", "initial_tokens", "token_cost", "sharing", "budget", "harvest", "horizon",
    "channel", "drop_probability", "channel_transition", "initial_channel", "delay",
)  # fmt: skip


@dataclass(frozen=True)
class CommonOptions:
    """Declare the options of every environment; each environment sets its own defaults.

    A field declares an option by its type, its default and the docstring below it. Validation,
    ``help``, the specification and the documentation read this declaration. A value outside a
    ``Literal`` or ``bool`` type raises an error at construction.

    Attributes:
        filters: Class of each value of an option ``filter``; its docstring declares the value.
        structure: Correlation structure, which decides the values of an option ``fusion``.

    Raises:
        ConfigurationError: A value is not allowed.

    Example:
        >>> from fusion_gym.systems.tobit.oscillator import TobitOscillatorOptions
        >>> options = TobitOscillatorOptions(horizon=50, access="single")
        >>> options.horizon, options.access, options.information
        (50, 'single', 'sensors')
    """

    filters: ClassVar[Mapping[str, type]] = {}
    structure: ClassVar[Structure | None] = None

    access: AccessRule = "any"
    """Rule of medium access. ``"any"`` admits all requests, ``"single"`` the first in the queue.
    ``"round_robin"`` admits one sensor per step in turn, ``"random"`` one at random. ``"slots"``
    grants the first ``slots`` requests in the queue, ``"try_once_discard"`` those with the largest
    discrepancies. With ``"collision"`` every request goes to one of ``channels`` at random, and two
    on one are lost and paid for. ``"assignment"`` grants at most ``channels`` requests, each on a
    channel of its own, by default the free one of the highest probability of arrival in the order
    of the queue. With ``"single"`` the action space is ``Discrete(sensors + 1)``: 0
    is no request, m + 1 is sensor m."""
    slots: int = 1
    """Most grants in a step with ``access="slots"`` or ``"try_once_discard"``."""
    discrepancy: Literal["innovation", "held"] = "innovation"
    """Discrepancy of ``"try_once_discard"``: of the new measurement against its expectation
    (``"innovation"``) or the last delivered one (``"held"``)."""
    discrepancy_weights: ArrayLike = 1.0
    """Weights of the squared discrepancies: one number, or one per sensor."""
    channels: int = 1
    """Channels of ``access="collision"`` or ``"assignment"``."""
    tokens: Tokens = "limited"
    """``"limited"`` applies the token bucket. ``"unlimited"`` grants every request and counts the
    tokens spent."""
    budget: Budget = "shared"
    """``"shared"`` is one bucket for all sensors. With ``"sensor"`` each sensor has a bucket of its
    own, such as a battery; ``token_rate``, ``token_capacity`` and ``initial_tokens`` are then one
    number, or one per sensor."""
    harvest: Harvest = "constant"
    """Tokens that a bucket gains per step: ``token_rate`` (``"constant"``), or with
    ``budget="sensor"`` one token with the probability ``token_rate`` (``"bernoulli"``)."""
    token_rate: ArrayLike = 5.0
    """Tokens g that the bucket gains per step (tobit_token_bucket, equation (17))."""
    token_capacity: ArrayLike = 30.0
    """Largest number b of tokens in the bucket (tobit_token_bucket, equation (17))."""
    initial_tokens: ArrayLike = 10.0
    """Tokens ξ₀ at the start of an episode."""
    token_cost: ArrayLike = 3.0
    """Tokens c that a transmission costs: one number, or one per sensor."""
    sharing: SharingRule = "turns"
    """Rule by which simultaneous requests share the tokens. ``"equal"`` grants if ξ/l ≥ c for l
    sensors (tobit_token_bucket, equations (16) and (18)). ``"fixed"`` grants in the order of the
    sensors while tokens last. ``"turns"`` grants in the order of a queue: a granted sensor goes to
    its end, and a head that the tokens do not pay for blocks the sensors behind it."""
    channel: Literal["perfect", "independent", "gilbert_elliott"] = "perfect"
    """Model of losses. ``"independent"`` loses every packet with one probability,
    ``"gilbert_elliott"`` with a probability for each channel state. The network feeds the last
    channel states back."""
    drop_probability: ArrayLike | None = None
    """Probability of a loss. Independent: one number, or one per sensor, by default 0.2; with
    ``access="assignment"`` also a matrix (sensors, channels). Gilbert-Elliott: the pair (bad,
    good), by default (0.7, 0.2)."""
    channel_transition: ArrayLike | None = None
    """Probabilities from the last state (row; bad, good) to the next of a Gilbert-Elliott channel.
    By default ((0.7, 0.3), (0.1, 0.9))."""
    initial_channel: InitialState = "stationary"
    """State of a Gilbert-Elliott channel at time 0; ``"stationary"`` draws it from the stationary
    law."""
    acknowledgements: Literal["perfect", "none"] | float | None = "perfect"
    """Whether a sensor learns that a packet arrives or is lost: always (``"perfect"``), never
    (``"none"``), or with a probability. Otherwise it supposes an arrival: its ``held`` and ``age``
    are of its last packet. The scheduler always knows."""
    delay: ArrayLike = 0
    """Steps from a transmission to its arrival, at most 100: a whole number, or a pair (least,
    most) from which each packet draws uniformly. The fusion centre repeats its updates from the
    time of a late packet on."""
    packet: Literal["measurement", "estimate"] = "measurement"
    """Content of a packet. ``"measurement"`` is the sensor's measurement or its node's estimate.
    ``"estimate"`` is the centralised scheduler's estimate with its covariance and needs
    ``memory=True``."""
    broadcast: Broadcast | None = None
    """Broadcast to every node besides tokens and price: ``"none"``, ``"estimate"`` (the fusion
    centre's prediction with its covariance) or ``"packets"`` (every delivered packet). The default
    is ``"estimate"`` where the centre feeds its estimate back, and otherwise ``"none"``."""
    memory: bool = False
    """Whether the centralised scheduler, or each local sensor, filters the measurements that were
    not sent."""
    memory_filter: str | None = None
    """Filter of the memory, a value of the option ``filter``. The default is the fusion centre's
    filter, or a better one where that filter minimises a bound."""
    belief_features: Sequence[Feature] | bool | None = None
    """Observation entries of the memory's estimate: ``"difference"`` from the fusion centre's
    estimate and ``"value"`` of a transmission. ``True`` is both, the default with memory. A delay
    excludes the value."""
    horizon: int = 100
    """Steps of an episode. The open-loop error over the horizon scales reward and observation."""
    clock: bool = False
    """Whether the observation shows the steps left; the end of an episode is then a termination."""
    information: Literal["sensors", "centre"] = "sensors"
    """Content of the observation: the new measurements of all sensors (``"sensors"``), or only the
    fusion centre's knowledge before any transmission (``"centre"``)."""
    own_number: bool = True
    """Whether a local sensor observes its own number. ``False`` makes sensors of one kind
    indistinguishable to a shared policy."""
    action: Action = "binary"
    """Action space: one bit u_m per sensor, as ``MultiBinary`` (``"binary"``) or as
    ``MultiDiscrete`` (``"multidiscrete"``), or the number Σ u_m 2^m (``"discrete"``).
    ``"assignment"``, with that access, is ``MultiDiscrete([sensors + 1] * channels)``: each channel
    has 0 for nobody or m + 1 for sensor m, and a sensor on several uses the first."""
    backend: Backend = "numpy"
    """Code that computes the steps. ``"compiled"``, the fastest, needs the extra ``compiled``: LLVM
    compiles the step once, in at most six seconds."""
    reward: Literal["scalar", "vector"] = "scalar"
    """``"scalar"`` returns the sum of the reward's two terms, ``"vector"`` both terms."""
    error: ErrorKind | str | Callable[[Array, Array], Any] = "squared"
    """Error term of the reward: ``"squared"`` is Σ w_i e_i², ``"trace"`` is Σ w_i P_ii of the
    claimed covariance P (which a policy can exploit), ``"maximum"`` is max w_i e_i². Otherwise a
    function of errors and covariances, or its ``"module:name"``."""
    error_weight: float = 1.0
    """Weight of the reward's error term."""
    cost_weight: float | Literal["random"] = 0.5
    """Price of a token in the reward. ``"random"`` draws it from ``price_range`` for each episode,
    uniformly in its logarithm."""
    price_range: ArrayLike | Literal["auto"] | None = None
    """Pair (low, high) of prices, which adds the price to the observation. ``"auto"`` simulates
    rules without a delay: it takes the prices at which the best value of information with memory
    sends 60 and 12 % of the sustained rate, but at least two packets per sensor and episode."""
    state_weights: ArrayLike | None = None
    """Weights of the states' squared errors in the reward. The default is the environment's own,
    which ``help`` shows. Explicit weights also weigh the trace that covariance intersection
    minimises, which is plain by default."""
    reward_scale: float | Literal["auto"] | None = "auto"
    """Factor of the state weights. ``"auto"`` simulates requests at an even pace and takes the
    factor with which their error costs 1 per step; explicit ``state_weights`` are not scaled. The
    pace is half of the sustained rate, or a quarter of all packets with unlimited tokens. These
    errors also scale the entries of ``belief_features``. ``None`` uses the error without
    transmissions."""
    true_process_noise: ArrayLike = 1.0
    """Factor of the true standard deviation of the process noise. The filters assume 1. A pair
    (low, high) is a range from which each episode draws."""
    true_measurement_noise: ArrayLike = 1.0
    """Factor of the true standard deviation of the measurement noise. The filters assume 1. A pair
    (low, high) is a range from which each episode draws."""
    true_threshold_shift: ArrayLike = 0.0
    """Shift of the true censoring limits of the sensors. The filters assume 0. A pair (low, high)
    is a range from which each episode draws."""
    true_drop_probability: ArrayLike | None = None
    """True probability of a loss of independent channels. Estimators and policies assume
    ``drop_probability``, the default. A pair (low, high) is a range from which each episode
    draws."""
    true_transition: ArrayLike = 1.0
    """Factor c of the true motion, from x to x + c (f(x) - x). The filters assume f(x). A pair
    (low, high) is a range from which each episode draws."""

    def __post_init__(self) -> None:
        if str(self.information) == "local":
            calls = "fusion_gym.parallel_env(id) and make_sb3_vec_env(id, n, local=True)"
            allowed = f"'sensors' or 'centre'; for decentralised sensors use {calls}"
            raise refusal("information", "local", allowed)
        declaration.check(self)

    def own_weights(self, states: int) -> Array | None:
        """Return the checked ``state_weights`` (n,), or ``None`` without them."""
        if self.state_weights is None:
            return None
        return validation.not_negative("state_weights", self.state_weights, (states,))

    def nominal(self) -> Self:
        """Return the options that scale the reward: plant, sensors and network."""
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
    """The parts and the defaults that an environment builds from its options.

    Args:
        options: The options.
        plant: The truth and its sensors.
        estimator: The local filters and the fusion centre.
        state_weights: Weights (n,) of the squared errors in the reward if the options have none;
            ``None`` weighs all states equally. ``reward_scale`` multiplies them.
        policy_defaults: Parameters of named policies in this scenario.
        feedback: Whether every node receives the centre's estimate by construction.
        memory_estimator: Estimator of the unsent measurements; ``None`` is ``estimator``.
        nodes_have_memory: Whether a packet holds all past measurements of its node, so that no
            ``memory_estimator`` is needed.
        no_estimates: Reason why a packet cannot hold an estimate, or ``None``.
        required_policy: The policy whose silence the filter reads, or ``None``.
        noise: Source of the plant's noise; ``None`` draws standard normals.
        error: Function of errors and covariances in place of the option ``error``.

    Example:
        >>> import fusion_gym
        >>> task = fusion_gym.make_task("fusion_gym/TobitOscillator-v1")
        >>> options = fusion_gym.CommonOptions()
        >>> scenario = fusion_gym.Scenario(options, task.plant, task.estimator)
        >>> scenario.feedback
        False
    """

    options: CommonOptions
    plant: Plant[Any]
    estimator: Estimator[Any]
    state_weights: ArrayLike | None = None
    policy_defaults: dict[str, Arguments] = field(default_factory=dict)
    feedback: bool = False
    memory_estimator: Estimator[Any] | None = None
    nodes_have_memory: bool = False
    no_estimates: str | None = None
    required_policy: str | None = None
    noise: NoiseSource | None = None
    error: Callable[[Array, Array], Any] | None = None


def plain_options(value: Any) -> Any:
    """Return settings as plain lists, numbers and strings, ready for JSON."""
    if isinstance(value, dict):
        return {key: plain_options(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_options(entry) for entry in value]
    if callable(value):
        return name_of(value)
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
