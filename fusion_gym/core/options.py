"""The options that all environments share, and the scenario that an environment builds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Literal, Self

from numpy.typing import ArrayLike

from fusion_gym import declaration
from fusion_gym.arrays import Array
from fusion_gym.core.action import ActionOptions
from fusion_gym.core.estimator import Estimator
from fusion_gym.core.knowledge import ObservationOptions
from fusion_gym.core.nature import TruthOptions
from fusion_gym.core.network import NetworkOptions
from fusion_gym.core.noise import NoiseSource
from fusion_gym.core.plant import Plant
from fusion_gym.core.reward import RewardOptions
from fusion_gym.declaration import OptionGroup
from fusion_gym.entries import Arguments
from fusion_gym.errors import refusal
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
