"""A task: plant, estimator, network, reward and the options of all parts."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, NamedTuple, Self

import numpy as np

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.action import ACTIONS, Action, Single
from fusion_gym.core.admission import admit
from fusion_gym.core.estimator import Estimator
from fusion_gym.core.knowledge import INFORMATION_MODES, Knowledge, covers, least_covering
from fusion_gym.core.nature import Nature
from fusion_gym.core.network import Network, warn_of_uneven_grants
from fusion_gym.core.options import CommonOptions, Scenario
from fusion_gym.core.plant import Plant
from fusion_gym.core.reward import Reward, reward_weights
from fusion_gym.declaration import NumpyOnly, marked, plain_options
from fusion_gym.entries import Options
from fusion_gym.errors import forbidden, refusal

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

    It is a scenario whose options have numbers instead of ``"auto"``. Its ``state_weights`` (n,)
    are the weights of the reward, and its ``memory_estimator`` is ``None`` without memory.

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
            if applies(self, self.options):
                reason, where = (text.format(task=self) for text in texts)
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
        parts = (("plant", plant, Plant), ("estimator", estimator, Estimator))
        for name, part, kind in parts:
            if not isinstance(part, kind):
                allowed = f"an instance of {kind.__module__}.{kind.__name__}"
                raise refusal(name, part, allowed)
        if plant.nature != (nature := Nature.create(options)):
            nature.refuse("here", f"the truth of {type(plant).__name__} is its model")
        horizon = validation.horizon(options.horizon)
        weights = reward_weights(options, scenario.state_weights, admit(plant, horizon))
        memory = None
        if options.memory:
            known = None if scenario.nodes_have_memory else estimator
            memory = scenario.memory_estimator or known
        network = Network(options, plant.sensor_count)
        warn_of_uneven_grants(network)
        if options.memory_filter is not None and options.memory and not scenario.memory_estimator:
            allowed = "None here, because this system has one filter"
            raise refusal("memory_filter", options.memory_filter, allowed)
        values: Options = {name.name: getattr(scenario, name.name) for name in fields(scenario)}
        values |= {"state_weights": weights, "memory_estimator": memory}
        task = cls(**values, nominal_error=nominal_error, limit=limit)
        task.reward  # noqa: B018  which checks it
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
        kind = Single if self.options.access == "single" else ACTIONS[self.options.action]
        return kind(self.sensors, self.options.channels)

    @functools.cached_property
    def reward(self) -> Reward:
        """The reward."""
        return Reward.create(self.options, np.asarray(self.state_weights), self.error)

    @property
    def horizon(self) -> int:
        """Steps of an episode."""
        horizon = self.options.horizon
        return horizon if self.limit is None else min(horizon, self.limit)

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

    @property
    def delayed(self) -> bool:
        """Whether the network delays packets."""
        return len(self.network.delay) > 1

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
        for name, part in (("plant", self.plant), ("estimator", self.estimator)):
            if not part.traceable:
                allowed = "one that JAX traces (traceable = True)"
                raise refusal(name, type(part).__name__, allowed, "under JAX")
        if callable(self.reward.error):
            raise refusal("error", self.reward.error_kind, "a kind", "under JAX")


class Exclusion(NamedTuple):
    """An option whose value other options or parts exclude; the texts may name the task's parts."""

    option: str
    applies: Callable[[Task, CommonOptions], bool]
    reason: str
    where: str = "here"


def _loses(task: Task) -> bool:
    channel = task.network.channel
    return task.network.rule.contended or (channel is not None and channel.loses)


EXCLUSIONS = (
    Exclusion(
        "information",
        lambda task, options: bool(task.required_policy) and options.information == "centre",
        "it must be 'sensors'",
        "with the policy {task.required_policy!r}, which reads the new measurements",
    ),
    Exclusion(
        "action",
        lambda task, options: (
            options.action == "discrete"
            and options.access != "single"
            and task.sensors > _MOST_DISCRETE
        ),
        f"it numbers all sets of requests, so it allows at most {_MOST_DISCRETE} sensors",
        "with {task.sensors} sensors",
    ),
    Exclusion(
        "action",
        lambda task, options: options.action == "assignment" and not task.network.rule.by_channel,
        "it needs access='assignment'",
        "with access={task.options.access!r}",
    ),
    Exclusion(
        "memory",
        lambda task, options: options.memory and options.information == "centre",
        "it must be False, because the centre stores only deliveries",
        "with information='centre'",
    ),
    Exclusion(
        "memory_filter",
        lambda task, options: options.memory_filter is not None and not options.memory,
        "it must be None unless memory=True",
    ),
    Exclusion(
        "belief_features",
        lambda task, options: bool(task.belief_features) and options.information == "centre",
        "it must be None or empty",
        "with information='centre'",
    ),
    Exclusion(
        "broadcast",
        lambda task, options: task.broadcast == "none" and task.feedback,
        "it must be 'estimate' or 'packets', because the nodes receive the centre's estimate",
    ),
    Exclusion(
        "packet",
        lambda task, options: options.packet == "estimate" and not options.memory,
        "it must be 'measurement', because an estimate needs memory=True",
    ),
    Exclusion(
        "packet",
        lambda task, options: options.packet == "estimate" and task.no_estimates is not None,
        "it must be 'measurement', because {task.no_estimates}",
    ),
    Exclusion(
        "packet",
        lambda task, options: (
            options.packet == "estimate" and type(task.estimator).adopt is Estimator.adopt
        ),
        "it must be 'measurement', because this system's centre cannot continue from a delivered "
        "estimate",
    ),
    Exclusion(
        "delay",
        lambda task, options: task.delayed and options.packet == "estimate",
        "a late estimate cannot join what arrived before it",
        "with packet='estimate'",
    ),
    Exclusion(
        "delay",
        lambda task, options: task.delayed and task.estimator.reads_silence,
        "a step without an arrival may be no silence",
        "with this filter",
    ),
    Exclusion(
        "delay",
        lambda task, options: task.delayed and "value" in task.belief_features,
        ONE_STEP,
        "with belief_features='value'",
    ),
    Exclusion(
        "access",
        lambda task, options: (
            (task.network.rule.contended or task.network.rule.by_channel)
            and task.estimator.reads_silence
        ),
        "it must be without shared channels, because a collision or a loss there is no silence",
    ),
    Exclusion(
        "acknowledgements",
        lambda task, options: task.network.acknowledgement < 1.0 and not _loses(task),
        "it must be 'perfect', because no packet is lost",
    ),
    Exclusion(
        "acknowledgements",
        lambda task, options: task.network.acknowledgement < 1.0 and task.broadcast != "none",
        "it must be 'perfect', because broadcast={task.broadcast!r} acknowledges what arrives",
    ),
    Exclusion(
        "acknowledgements",
        lambda task, options: (
            task.network.acknowledgement < 1.0
            and (not task.estimator.independent_nodes or task.estimator.reads_silence)
        ),
        "it must be 'perfect', because a sensor's innovation needs the packets of all sensors that "
        "arrived",
    ),
)
