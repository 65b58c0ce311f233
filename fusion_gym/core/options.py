"""What the environments' options have in common, and what an environment makes of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym.arrays import Array
from fusion_gym.core.system import System
from fusion_gym.importing import name_of


@dataclass(frozen=True)
class CommonOptions:
    """The options that every environment has; each gives them its own defaults.

    Network, access and token bucket; what a packet holds and who hears what; memory; episode,
    observation, action and reward; how far the truth departs from what everybody assumes.
    """

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
