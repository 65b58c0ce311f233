"""A task: plant, estimator, network, reward and the options of all parts."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import declaration, validation
from fusion_gym.arrays import Array
from fusion_gym.core.action import (
    ACTIONS,
    SCORES,
    Action,
    ActionOptions,
    Sets,
    Single,
    Threshold,
)
from fusion_gym.core.control import Controller
from fusion_gym.core.estimator import Estimator
from fusion_gym.core.knowledge import (
    INFORMATION_MODES,
    Knowledge,
    ObservationOptions,
    covers,
    least_covering,
)
from fusion_gym.core.network import Network, NetworkOptions, warn_of_uneven_grants
from fusion_gym.core.noise import NoiseSource
from fusion_gym.core.plant import Nature, Plant, TruthOptions, admit
from fusion_gym.core.reward import Reward, RewardOptions, reward_weights
from fusion_gym.declaration import NumpyOnly, OptionGroup, marked, plain_options
from fusion_gym.entries import Arguments, Options
from fusion_gym.errors import ConfigurationError, forbidden, refusal
from fusion_gym.fusion.table import Structure

Broadcast = Literal["none", "estimate", "packets"]


@dataclass(frozen=True)
class CommunicationOptions(OptionGroup):
    """The options of packets, broadcasts and memory."""

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


@dataclass(frozen=True)
class CommonOptions(
    TruthOptions,
    RewardOptions,
    ActionOptions,
    ObservationOptions,
    CommunicationOptions,
    NetworkOptions,
):
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

    def __post_init__(self) -> None:
        if str(self.information) == "local":
            calls = "fusion_gym.parallel_env(id) and make_sb3_vec_env(id, n, local=True)"
            allowed = f"'sensors' or 'centre'; for decentralised sensors use {calls}"
            raise refusal("information", "local", allowed)
        super().__post_init__()

    def nominal(self) -> Self:
        """Return the options that scale the reward: plant, sensors and network."""
        scaling = declaration.marked(CommonOptions, declaration.Scaling)
        common = (item.name for item in fields(CommonOptions) if item.name not in scaling)
        plain = {name: getattr(type(self), name) for name in common}
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
        state_weights: Weights (n,) or (n, n) of the errors in the reward if the options have none;
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
        controller: Controller that closes the loop; its ``error_weights`` go before
            ``state_weights``.
        picture: Function from the plant's state and the number of a run to the plant's own picture
            (height, width, 3) for films, or to ``None``.

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
    controller: Controller | None = None
    picture: Callable[[Any, int], Any] | None = None


# Additional signals that need the sensors' measurements.
SENSORS_ONLY = (
    "estimate", "beliefs", "belief_difference", "transmission_value", "own_beliefs",
    "own_difference", "own_value",
)  # fmt: skip
ONE_STEP = "the value of a packet counts only an arrival in this step"  # excludes a delay
_MOST_DISCRETE = 16  # sensors with a discrete action of 2^sensors values


@dataclass(frozen=True)
class Task(Scenario):
    """The definition of an environment, independent of the number of runs.

    It is a scenario whose options have numbers instead of ``"auto"``. Its ``state_weights`` are the
    weights of the reward, and its ``memory_estimator`` is ``None`` without memory.

    Args:
        nominal_error: Mean squared errors (n,) that scale belief entries
            (:mod:`fusion_gym.core.scale`); ``None`` uses the errors without transmissions.
        limit: Steps to truncation, if fewer than the option ``horizon``, which the scales follow.

    Raises:
        ConfigurationError: Options or parts exclude each other.

    Example:
        >>> import fusion_gym
        >>> task = fusion_gym.make_task("fusion_gym/TobitOscillator-v1", horizon=50)
        >>> task.sensors, task.horizon, task.options.information
        (3, 50, 'sensors')
    """

    nominal_error: Array | None = None
    limit: int | None = None

    def __post_init__(self) -> None:
        for name, applies, *texts in EXCLUSIONS:
            if applies(self):
                where, reason = (text.format(task=self) for text in texts)
                raise forbidden(name, getattr(self.options, name), reason, where)

    @classmethod
    def create(
        cls, scenario: Scenario, limit: int | None = None, nominal_error: Array | None = None
    ) -> Task:
        """Return the task of a scenario.

        Args:
            scenario: Scenario whose options have numbers instead of ``"auto"``
                (:func:`fusion_gym.core.scale.resolve`).
            limit: Steps to truncation.
            nominal_error: Mean squared errors (n,) that scale belief entries.

        Raises:
            ConfigurationError: A value is not allowed.
        """
        options, plant, estimator = scenario.options, scenario.plant, scenario.estimator
        for name, part, kind in (("plant", plant, Plant), ("estimator", estimator, Estimator)):
            if not isinstance(part, kind):
                allowed = f"an instance of {kind.__module__}.{kind.__name__}"
                raise refusal(name, part, allowed)
        usual, controller = scenario.state_weights, scenario.controller
        if controller is not None:
            _check_inputs(plant.sense, estimator.predict)
            usual = usual if controller.error_weights is None else controller.error_weights
        if plant.nature != (nature := Nature.create(options)):
            nature.refuse("here", f"the truth of {type(plant).__name__} is its model")
        horizon = validation.horizon(options.horizon)
        weights = reward_weights(options, usual, admit(plant, horizon))
        memory = scenario.memory_estimator
        if options.memory_filter is not None and options.memory and memory is None:
            allowed = "None here, because this system has one filter"
            raise refusal("memory_filter", options.memory_filter, allowed)
        if memory is None and not scenario.nodes_have_memory:
            memory = estimator
        memory = memory if options.memory else None
        parts = vars(scenario) | {"state_weights": weights, "memory_estimator": memory}
        task = cls(**parts, nominal_error=nominal_error, limit=limit)
        task.reward  # noqa: B018  which checks it
        warn_of_uneven_grants(task.network)
        return task

    def with_options(self, **options: Any) -> Self:
        """Return the task with other options of network, reward, observation or action.

        Args:
            **options: Options, which plant and estimator do not read.

        Raises:
            ConfigurationError: A value is not allowed.
        """
        return replace(self, options=replace(self.options, **options))

    @functools.cached_property
    def network(self) -> Network:
        """Medium access, tokens, losses and delays."""
        return Network(self.options, self.sensors)

    @functools.cached_property
    def action(self) -> Action:
        """The scheduler's action."""
        options, single = self.options, self.options.access == "single"
        if options.action == "threshold":
            return Threshold(self.sensors, SCORES[options.score], self.error_scale, single)
        kind = Single if single else ACTIONS[options.action]
        return kind(self.sensors, options.channels)

    @functools.cached_property
    def reward(self) -> Reward:
        """The reward."""
        return Reward.create(self.options, np.asarray(self.state_weights), self.error)

    @property
    def horizon(self) -> int:
        """Steps of an episode."""
        horizon = self.options.horizon
        return horizon if self.limit is None else min(horizon, self.limit)

    @functools.cached_property
    def objective(self) -> str:
        """Meaning of the reward's error term: ``"estimation"`` or ``"control"``."""
        return self.options.objective or ("control" if self.controller else "estimation")

    @property
    def equivalent_error(self) -> bool:
        """Whether policies rank by the weighted error as they do by the objective.

        A controller's ``error_weights`` suppose its model and no weights in their place.
        """
        if self.objective != "control":
            return True
        controller: Any = self.controller
        own = self.options.state_weights is None and controller.error_weights is not None
        return own and "true_transition" not in self.plant.nature.departing

    @property
    def broadcast(self) -> str:
        """Broadcast to every node: ``"none"``, ``"estimate"`` or ``"packets"``."""
        return self.options.broadcast or ("estimate" if self.feedback else "none")

    @property
    def belief_features(self) -> tuple[str, ...]:
        """Observation entries of the beliefs, ``"difference"`` and ``"value"``."""
        return self.options.features(memory=self.options.memory, delayed=self.delayed)

    @property
    def settings(self) -> Options:
        """The options as plain lists, numbers and strings, for reports."""
        settings: Options = plain_options(asdict(self.options))
        return settings

    @functools.cached_property
    def delayed(self) -> bool:
        """Whether the network delays packets."""
        return self.network.longest_delay > 0

    @property
    def knowledge(self) -> Knowledge:
        """Knowledge class of a policy."""
        known = INFORMATION_MODES[self.options.information]
        return least_covering((known, "scheduler_memory")) if self.options.memory else known

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
        return float(self.reward.error_weight * self.reward.diagonal.mean())

    @functools.cached_property
    def relative_weights(self) -> Array:
        """The reward's weights, scaled to a mean of the diagonal of 1; 1 if all are zero."""
        mean = float(self.reward.diagonal.mean())
        weights = self.reward.state_weights
        return weights / mean if mean > 0.0 else np.ones_like(self.reward.diagonal)

    @property
    def hidden_signals(self) -> tuple[str, ...]:
        """Names of the signals that the information mode withholds."""
        signals = self.estimator.signals
        hidden = {s.name for s in signals if not covers(self.knowledge, s.knowledge)}
        hidden |= set() if covers(self.knowledge, "scheduler") else {*SENSORS_ONLY}
        if self.options.action == "threshold":  # the sensors compare their scores with it
            hidden -= {*SCORES[self.options.score].names}
        return tuple(sorted(hidden))

    def refuse_delay(self, reason: str, where: str = "") -> None:
        """Raise an error if the network delays packets.

        Args:
            reason: Reason of the refusal.
            where: Setting that excludes a delay.

        Raises:
            ConfigurationError: The network delays packets.
        """
        if self.delayed:
            raise forbidden("delay", self.options.delay, reason, where)

    def refuse_control(self, where: str) -> None:
        """Raise an error with the place if a controller closes the loop."""
        if self.controller is not None:
            raise ConfigurationError(f"a controller is not allowed {where}: it solves estimation")

    def refuse_numpy_only(self) -> None:
        """Refuse what NumPy alone runs: marked options, parts, and functions of the error.

        Raises:
            ConfigurationError: An option has such a value, or a part does not say that JAX traces
                it.
        """
        kind = type(self.options)
        for name, mark in marked(kind, NumpyOnly).items():
            value = plain_options(getattr(self.options, name))
            default = plain_options(getattr(kind, name))
            if value in mark.values if mark.values else value != default:
                raise refusal(name, value, "another value", "under JAX")
        every: Any = {name: getattr(self, name) for name in ("plant", "estimator", "controller")}
        for name, part in every.items():
            if part is not None and not part.traceable:
                allowed = "one that JAX traces (traceable = True)"
                raise refusal(name, type(part).__name__, allowed, "under JAX")
        if callable(self.reward.error):
            raise refusal("error", self.reward.error_kind, "a kind", "under JAX")


def _check_inputs(*methods: Callable[..., Any]) -> None:
    """Refuse a controller with methods that take no input."""
    for method in methods:
        if "control" not in inspect.signature(method).parameters:
            reason = f"{method.__qualname__} must take a further argument 'control'"
            raise ConfigurationError(f"a controller is not allowed here: {reason}")


def _unacknowledged(task: Task) -> bool:
    return task.network.acknowledgement < 1.0


def _loses(task: Task) -> bool:
    channel = task.network.channel
    return task.network.rule.contended or (channel is not None and channel.loses)


def _shared(task: Task) -> bool:
    return task.network.rule.contended or task.network.rule.by_channel


def _estimates(task: Task) -> bool:
    return task.options.packet == "estimate"


def _central(task: Task) -> bool:
    return task.options.information == "centre"


# Options that other options or parts exclude: the option, when, where, and the reason, in texts
# that may name the task's parts.
# fmt: off
EXCLUSIONS: tuple[tuple[str, Callable[[Task], Any], str, str], ...] = (
    ("information", lambda task: _central(task) and task.required_policy,
     "with the policy {task.required_policy!r}, which reads the new measurements",
     "it must be 'sensors'"),
    ("action", lambda task: type(task.action) is Sets and task.sensors > _MOST_DISCRETE,
     "with {task.sensors} sensors",
     f"it numbers all sets of requests, so it allows at most {_MOST_DISCRETE} sensors"),
    ("action",
     lambda task: task.options.action == "assignment" and not task.network.rule.by_channel,
     "with access={task.options.access!r}", "it needs access='assignment'"),
    ("score",
     lambda task: task.options.action == "threshold" and task.options.score == "value"
     and task.delayed, "with a delay", ONE_STEP),
    ("action", lambda task: task.options.action == "threshold" and task.network.rule.by_channel,
     "with access='assignment'", "a threshold names no channel"),
    ("memory", lambda task: _central(task) and task.options.memory,
     "with information='centre'", "it must be False, because the centre stores only deliveries"),
    ("memory_filter",
     lambda task: task.options.memory_filter is not None and not task.options.memory,
     "here", "it must be None unless memory=True"),
    ("belief_features", lambda task: _central(task) and task.belief_features,
     "with information='centre'", "it must be None or empty"),
    ("broadcast", lambda task: task.feedback and task.broadcast == "none", "here",
     "it must be 'estimate' or 'packets', because the nodes receive the centre's estimate"),
    ("packet", lambda task: _estimates(task) and not task.options.memory, "here",
     "it must be 'measurement', because an estimate needs memory=True"),
    ("packet", lambda task: _estimates(task) and task.no_estimates, "here",
     "it must be 'measurement', because {task.no_estimates}"),
    ("packet", lambda task: _estimates(task) and type(task.estimator).adopt is Estimator.adopt,
     "here", "it must be 'measurement', because this system's centre cannot continue from a "
     "delivered estimate"),
    ("delay", lambda task: task.delayed and _estimates(task), "with packet='estimate'",
     "a late estimate cannot join what arrived before it"),
    ("delay", lambda task: task.delayed and task.estimator.reads_silence, "with this filter",
     "a step without an arrival may be no silence"),
    ("delay", lambda task: task.delayed and "value" in task.belief_features,
     "with belief_features='value'", ONE_STEP),
    ("access", lambda task: _shared(task) and task.estimator.reads_silence, "here",
     "it must be without shared channels, because a collision or a loss there is no silence"),
    ("acknowledgements", lambda task: _unacknowledged(task) and not _loses(task), "here",
     "it must be 'perfect', because no packet is lost"),
    ("acknowledgements", lambda task: _unacknowledged(task) and task.broadcast != "none", "here",
     "it must be 'perfect', because broadcast={task.broadcast!r} acknowledges what arrives"),
    ("acknowledgements",
     lambda task: _unacknowledged(task)
     and (not task.estimator.independent_nodes or task.estimator.reads_silence), "here",
     "it must be 'perfect', because a sensor's innovation needs the packets of all sensors that "
     "arrived"),
    ("acknowledgements", lambda task: _unacknowledged(task) and task.controller, "here",
     "it must be 'perfect', because the input, which is broadcast, acknowledges what arrives"),
    ("objective", lambda task: task.objective == "control" and not task.controller, "here",
     "it must be 'estimation', because there is no controller"),
    ("error", lambda task: task.objective == "control" and task.reward.error != "squared",
     "with objective='control'", "it must be 'squared', because the controller has the cost"),
    ("terminal_weight",
     lambda task: getattr(task.options, "terminal_weight", None) is not None
     and not task.options.clock, "here",
     "it needs clock=True, because an agent values the steps beyond a truncated episode"),
)
# fmt: on
