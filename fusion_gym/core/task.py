"""A task: plant, estimator, network, the knowledge of a policy, and the reward."""

from __future__ import annotations

import functools
import warnings
from dataclasses import asdict, dataclass, field
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.access import ACCESS
from fusion_gym.core.admission import admit
from fusion_gym.core.channel import Channel
from fusion_gym.core.communication import communication
from fusion_gym.core.estimator import Estimator
from fusion_gym.core.knowledge import Knowledge, covers, least_covering
from fusion_gym.core.nature import Nature
from fusion_gym.core.network import Network
from fusion_gym.core.noise import NoiseSource
from fusion_gym.core.options import Action, Backend, CommonOptions, Scenario, plain_options
from fusion_gym.core.plant import Plant
from fusion_gym.core.reward import Price, Reward
from fusion_gym.core.token_bucket import TokenBucket
from fusion_gym.entries import Arguments, Options
from fusion_gym.errors import forbidden

# Knowledge class of each information mode.
INFORMATION_MODES: dict[str, Knowledge] = {"sensors": "scheduler", "centre": "centre"}
ACTION_KINDS: tuple[str, ...] = get_args(Action)
BACKENDS: tuple[str, ...] = get_args(Backend)
# Additional signals that need the sensors' measurements.
SENSORS_ONLY = (
    "estimate", "beliefs", "belief_difference", "transmission_value", "own_beliefs",
    "own_difference", "own_value",
)  # fmt: skip
# Channels of each option, and the defaults of each channel.
_CHANNELS = {
    "drop_probability": ("independent", "gilbert_elliott"),
    "channel_transition": ("gilbert_elliott",),
    "initial_channel": ("gilbert_elliott",),
    "true_drop_probability": ("independent",),
}
_DROP: dict[str, ArrayLike] = {"independent": 0.2, "gilbert_elliott": (0.7, 0.2)}
_TRANSITION: ArrayLike = ((0.7, 0.3), (0.1, 0.9))
_LONGEST = 100  # steps of a delay
ONE_STEP = "the value of a packet counts only an arrival in this step"  # excludes a delay
_MOST_DISCRETE = 16  # sensors with a discrete action of 2^sensors values
_MOST_CHANNELS = 64  # of an assignment to fewer sensors


@dataclass(frozen=True)
class Task:
    """The definition of an environment, independent of the number of runs.

    Args:
        plant: The truth and its sensors.
        estimator: The local filters and the fusion centre.
        network: Medium access, tokens, losses and delays.
        reward: The reward.
        horizon: Steps of an episode.
        information: Content of the observation: ``"sensors"`` (all new measurements) or
            ``"centre"`` (the fusion centre's knowledge before any transmission).
        action: ``"binary"`` or ``"multidiscrete"`` (one bit u_m per sensor), or ``"discrete"`` (the
            number Σ u_m 2^m). With access ``"single"`` it is 0 for no request, m + 1 for sensor m.
            ``"assignment"`` is that number for each channel of the access ``"assignment"``.
        packet: Content of a packet: ``"measurement"`` or ``"estimate"``.
        broadcast: ``"none"``, ``"estimate"`` or ``"packets"`` (:mod:`fusion_gym.core.memory`).
        memory: Whether the scheduler or each local sensor has memory.
        memory_estimator: Estimator of the memory.
        belief_features: Observation entries of the beliefs, ``"difference"`` and ``"value"``.
        feedback: Whether the nodes receive the centre's estimate.
        clock: Whether the observation shows the steps left, so that an episode ends by termination.
        own_number: Whether a local sensor observes its own number.
        vector_reward: Whether the environments return the two terms of the reward.
        backend: ``"numpy"``, or ``"compiled"`` for steps that LLVM compiles.
        nominal_error: Mean squared errors (n,) that scale belief entries
            (:mod:`fusion_gym.core.scale`); ``None`` uses the errors without transmissions.
        settings: The user's options, for reports.
        policy_defaults: The scenario's parameters of named policies.
        required_policy: The only policy that may run, or ``None``.
        noise: Source of the plant's noise, such as windows of a recording; ``None`` draws
            standard normals.

    Raises:
        ConfigurationError: A mode is unknown, the horizon is below 1, or the parts do not fit.

    Example:
        >>> import fusion_gym
        >>> task = fusion_gym.make_task("fusion_gym/TobitOscillator-v1", horizon=50)
        >>> task.sensors, task.horizon, task.information
        (3, 50, 'sensors')
    """

    plant: Plant[Any]
    estimator: Estimator[Any]
    network: Network
    reward: Reward
    horizon: int
    information: str = "sensors"
    action: str = "binary"
    packet: str = "measurement"
    broadcast: str = "none"
    memory: bool = False
    memory_estimator: Estimator[Any] | None = None
    belief_features: tuple[str, ...] = ()
    feedback: bool = False
    clock: bool = False
    own_number: bool = True
    vector_reward: bool = False
    backend: str = "numpy"
    nominal_error: Array | None = None
    settings: Options = field(default_factory=dict)
    policy_defaults: dict[str, Arguments] = field(default_factory=dict)
    required_policy: str | None = None
    noise: NoiseSource | None = None

    def __post_init__(self) -> None:
        validation.horizon(self.horizon)
        validation.choice("information", self.information, INFORMATION_MODES)
        validation.choice("action", self.action, ACTION_KINDS)
        validation.choice("backend", self.backend, BACKENDS)
        if self.network.sensors != self.plant.sensor_count:
            raise validation.ConfigurationError(
                f"token_cost for {self.network.sensors} sensors is not allowed: the plant has "
                f"{self.plant.sensor_count}"
            )
        if self.required_policy is not None and self.information == "centre":
            why = f"with the policy {self.required_policy!r}, which reads the new measurements"
            raise validation.refusal("information", "centre", "'sensors'", why)
        many = self.network.access != "single" and self.sensors > _MOST_DISCRETE
        if self.action == "discrete" and many:
            raise validation.ConfigurationError(
                f"action = 'discrete' is not allowed with {self.sensors} sensors: it numbers all "
                f"sets of requests, so it allows at most {_MOST_DISCRETE} sensors"
            )
        if self.action == "assignment" and not self.network.rule.by_channel:
            where = f"with access={self.network.access!r}"
            raise forbidden("action", self.action, "it needs access='assignment'", where)
        if self.packet == "estimate":
            reason = "a late estimate cannot join what arrived before it"
            self.refuse_delay(reason, "with packet='estimate'")
        if self.estimator.reads_silence:
            self.refuse_delay("a step without an arrival may be no silence", "with this filter")
        if "value" in self.belief_features:
            self.refuse_delay(ONE_STEP, "with belief_features='value'")
        states = len(self.plant.state_names)
        if self.reward.state_weights.shape != (states, 1):
            raise validation.ConfigurationError(
                f"state_weights of shape {self.reward.state_weights.shape} are not allowed: the "
                f"plant has {states} states, so its shape must be ({states}, 1)"
            )
        shared = self.network.rule.contended or self.network.rule.by_channel
        if shared and self.estimator.reads_silence:
            allowed = "without shared channels, because a collision or a loss there is no silence"
            raise validation.refusal("access", self.network.access, allowed, "here")
        if self.network.acknowledgement < 1.0:
            self._check_acknowledgements()

    @classmethod
    def create(
        cls, scenario: Scenario, limit: int | None = None, nominal_error: Array | None = None
    ) -> Task:
        """Return the task of a scenario.

        Args:
            scenario: Scenario whose options have numbers instead of ``"auto"``
                (:func:`fusion_gym.core.scale.resolve`).
            limit: Steps to truncation; the scales still follow the horizon.
            nominal_error: Mean squared errors (n,) that scale belief entries.

        Raises:
            ConfigurationError: A value is not allowed.
        """
        options, plant = scenario.options, scenario.plant
        parts = (("plant", plant, Plant), ("estimator", scenario.estimator, Estimator))
        for name, part, kind in parts:
            if not isinstance(part, kind):
                allowed = f"an instance of {kind.__module__}.{kind.__name__}"
                raise validation.refusal(name, part, allowed)
        if plant.nature != (nature := Nature.create(options)):
            nature.refuse("here", f"the truth of {type(plant).__name__} is its model")
        horizon = validation.horizon(options.horizon)
        weights, open_loop = options.state_weights, admit(plant, horizon)
        weights = scenario.state_weights if weights is None else weights
        if options.reward_scale is not None:
            factor = validation.number("reward_scale", options.reward_scale, above=0.0)
            ratios = np.ones(()) if weights is None else weights
            weights = factor * validation.not_negative("state_weights", ratios, open_loop.shape)
        reward = Reward.create(
            options.error if scenario.error is None else scenario.error,
            options.error_weight,
            Price.create(options.cost_weight, options.price_range),
            weights,
            open_loop,
        )
        network = make_network(options, plant.sensor_count)
        how = communication(scenario, len(network.delay) > 1)
        return cls(
            plant=plant,
            estimator=scenario.estimator,
            network=network,
            reward=reward,
            horizon=horizon if limit is None else min(horizon, limit),
            information=options.information,
            action=options.action,
            packet=options.packet,
            broadcast=how.broadcast,
            memory=options.memory,
            memory_estimator=how.memory_estimator,
            belief_features=how.features,
            feedback=scenario.feedback,
            clock=options.clock,
            own_number=options.own_number,
            vector_reward=options.reward == "vector",
            backend=options.backend,
            nominal_error=nominal_error,
            settings=plain_options(asdict(options)),
            policy_defaults=scenario.policy_defaults,
            required_policy=scenario.required_policy,
            noise=scenario.noise,
        )

    @property
    def knowledge(self) -> Knowledge:
        """Knowledge class of a policy."""
        known = INFORMATION_MODES[self.information]
        return least_covering((known, "scheduler_memory")) if self.memory else known

    @property
    def sensors(self) -> int:
        """Number of sensors."""
        return self.plant.sensor_count

    @functools.cached_property
    def open_loop(self) -> Array:
        """Mean error variances (n, 1) without any delivery."""
        return self.plant.open_loop(self.horizon)[:, None]

    @functools.cached_property
    def divergence_level(self) -> Array:
        """Squared errors (n, 1) beyond which a run counts as diverged: 100 times open loop."""
        return 100.0 * self.open_loop

    @functools.cached_property
    def error_scale(self) -> float:
        """Weight of a squared error in the reward, averaged over the states."""
        return float(self.reward.error_weight * self.reward.state_weights.mean())

    @functools.cached_property
    def relative_weights(self) -> Array:
        """The reward's weights of the states (n, 1), scaled to a mean of 1; 1 if all are zero."""
        weights = self.reward.state_weights
        mean = float(weights.mean())
        return weights / mean if mean > 0.0 else np.ones_like(weights)

    @property
    def hidden_signals(self) -> tuple[str, ...]:
        """Names of the signals that the information mode withholds."""
        signals = self.estimator.signals
        hidden = (s.name for s in signals if not covers(self.knowledge, s.knowledge))
        return (*hidden, *(() if covers(self.knowledge, "scheduler") else SENSORS_ONLY))

    def _check_acknowledgements(self) -> None:
        """Refuse missing acknowledgements where the sensors learn of arrivals anyway."""
        estimator, channel, why = self.estimator, self.network.channel, None
        if not (self.network.rule.contended or (channel is not None and channel.loses)):
            why = "no packet is lost"
        elif self.broadcast != "none":
            why = f"broadcast={self.broadcast!r} acknowledges what arrives"
        elif not estimator.independent_nodes or estimator.reads_silence:
            why = "a sensor's innovation needs the packets of all sensors that arrived"
        if why is not None:
            value = self.settings.get("acknowledgements")
            raise validation.refusal("acknowledgements", value, f"'perfect', because {why}", "here")

    def refuse_delay(self, reason: str, where: str = "") -> None:
        """Raise an error if the network delays packets.

        Args:
            reason: Reason of the refusal.
            where: Setting that excludes a delay.

        Raises:
            ConfigurationError: The network delays packets.
        """
        if len(law := self.network.delay) > 1:
            raise forbidden("delay", self.settings.get("delay") or law, reason, where)

    def refuse_jax(self) -> None:
        """Refuse options that do not run under JAX.

        Raises:
            ConfigurationError: An option has a value that NumPy alone runs.
        """
        kind, own = type(self.estimator).__name__, (self.plant, self.estimator)
        fields = [part.numpy_only for part in own if part.numpy_only is not None]
        fields += self.plant.nature.departing
        fields += ["acknowledgements"] if self.network.acknowledgement < 1.0 else []
        fields += ["delay"] if len(self.network.delay) > 1 else []
        fields += ["error"] if callable(self.reward.error) else []
        if "system" in fields:
            raise validation.refusal("system", kind, "an estimator that JAX runs", "under JAX")
        if fields:
            value = self.settings.get(fields[0])
            value = self.reward.error_kind if fields[0] == "error" else value
            raise validation.refusal(fields[0], value, "the default", "under JAX")


def make_bucket(options: CommonOptions, sensors: int) -> TokenBucket:
    """Return the token bucket of the options, with a warning if it favours some sensors."""
    bucket = TokenBucket.create(
        rate=options.token_rate,
        capacity=options.token_capacity,
        initial=options.initial_tokens,
        cost=options.token_cost,
        sensors=sensors,
        sharing=options.sharing if options.budget == "shared" else "equal",
        unlimited=options.tokens == "unlimited",
        budget=options.budget,
        harvest=options.harvest,
    )
    whole = float(bucket.cost.sum())
    if not bucket.unlimited and not bucket.per_sensor and bucket.capacity < whole:
        warnings.warn(
            f"token_capacity = {bucket.capacity:g} is below {whole:g}, the cost of one packet of "
            f"each of the {sensors} sensors: they cannot all transmit in one step",
            stacklevel=2,
        )
    if options.access == "round_robin" and bucket.resonates:
        warnings.warn(
            f"token_rate = {bucket.rate:g} and token_cost = {bucket.cost.max():g} with "
            f"access='round_robin' favour some of the {sensors} sensors if all request; "
            "access='any' with sharing='turns' does not",
            stacklevel=2,
        )
    if options.access in ("round_robin", "random") and bucket.favours_cheaper:
        warnings.warn(
            f"token_rate = {bucket.rate:g} is below token_cost, up to {bucket.cost.max():g}, with "
            f"access={options.access!r}: a sensor without enough tokens loses its turn, so dearer "
            "sensors get fewer grants; access='any' with sharing='turns' is even",
            stacklevel=2,
        )
    return bucket


def make_network(options: CommonOptions, sensors: int) -> Network:
    """Return the network of the options."""
    rule = ACCESS[options.access]
    for name, used, by in (
        ("slots", rule.limited and not rule.by_channel and options.access != "single", "access"),
        ("channels", rule.contended or rule.by_channel, "access"),
        ("discrepancy", rule.by_discrepancy, "access"),
        ("discrepancy_weights", rule.by_discrepancy, "access"),
        ("sharing", options.budget == "shared", "budget"),
    ):
        value, default = getattr(options, name), getattr(type(options), name)
        if not used and plain_options(value) != default:
            raise forbidden(name, value, "it has no use", f"with {by}={getattr(options, by)!r}")
    for name in ("slots", "channels"):
        most = max(sensors, _MOST_CHANNELS) if rule.by_channel else sensors
        validation.integer(name, getattr(options, name), at_least=1, at_most=most)
    weights = validation.positive("discrepancy_weights", options.discrepancy_weights, (sensors,))
    return Network(
        make_bucket(options, sensors),
        options.access,
        make_channel(options, sensors),
        make_delay(options),
        acknowledgement=make_acknowledgement(options.acknowledgements),
        slots=options.channels if rule.by_channel else options.slots,
        channels=options.channels,
        discrepancy=options.discrepancy,
        weights=weights[:, None],
    )


def make_acknowledgement(value: str | float | None) -> float:
    """Return the probability that the sender of a packet learns whether it arrives."""
    allowed = "'perfect', 'none' or a number from 0 to 1"
    if value is None or isinstance(value, str):
        if (value or "none") not in (words := {"perfect": 1.0, "none": 0.0}):
            raise validation.refusal("acknowledgements", value, allowed)
        return words[value or "none"]
    return validation.number("acknowledgements", value, at_least=0.0, at_most=1.0)


def make_channel(options: CommonOptions, sensors: int) -> Channel | None:
    """Return the channel of the options; ``None`` loses nothing."""
    kind = options.channel
    for name, kinds in _CHANNELS.items():
        value = getattr(options, name)
        given = value is not None and not (isinstance(value, str) and value == "stationary")
        if given and kind not in kinds:
            reason = f"it belongs to {' and '.join(map(repr, kinds))}"
            raise forbidden(name, value, reason, f"with channel={kind!r}")
    if kind == "perfect":
        return None
    drop = _DROP[kind] if options.drop_probability is None else options.drop_probability
    if ACCESS[options.access].by_channel:
        shape, sensors = (sensors, options.channels), sensors * options.channels
        if kind == "independent":  # of one link for each pair
            drop = validation.spread("drop_probability", validation.by_row(drop, shape), shape)
            drop = drop.ravel()
    if kind == "independent":
        return Channel.independent(drop, sensors, options.true_drop_probability)
    matrix = _TRANSITION if options.channel_transition is None else options.channel_transition
    return Channel.gilbert_elliott(matrix, drop, sensors, options.initial_channel)


def make_delay(options: CommonOptions) -> tuple[float, ...]:
    """Return the probabilities of a delay of 0, 1, … steps."""
    value: Any = options.delay
    pair = isinstance(value, (list, tuple)) or getattr(value, "ndim", 0) > 0
    ends = value if pair else (value, value)
    if len(ends) == 2:
        least, most = (
            validation.integer("delay", end, at_least=0, at_most=_LONGEST) for end in ends
        )
        if least < most or not pair:
            count = most + 1 - least
            return (0.0,) * least + (1.0 / count,) * count
    allowed = "a whole number, or a pair (least, most), least < most"
    raise validation.refusal("delay", value, allowed)
