"""What the environments' options have in common: network, episode, reward, reports."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import validation
from fusion_gym.core.reward import Price, Reward
from fusion_gym.core.system import System
from fusion_gym.core.task import Task
from fusion_gym.core.token_bucket import TokenBucket
from fusion_gym.validation import ConfigurationError


@dataclass(frozen=True)
class CommonOptions:
    """The options that every environment has; each gives them its own defaults.

    Network, access and token bucket; episode, observation, action and reward.
    """

    access: str = "any"
    tokens: str = "limited"
    token_rate: float = 5.0
    token_capacity: float = 30.0
    initial_tokens: float = 10.0
    token_cost: ArrayLike = 3.0
    sharing: str = "rotating"
    horizon: int = 100
    information: str = "sensors"
    action: str = "binary"
    error: str = "squared"
    error_weight: float = 1.0
    cost_weight: float | str = 0.01
    price_range: ArrayLike | None = None
    state_weights: ArrayLike | None = None


Options = TypeVar("Options", bound=CommonOptions)


def choose(kind: type[Options], env_id: str, given: dict[str, Any]) -> tuple[Options, int | None]:
    """The options as given, and ``max_episode_steps``, which every environment takes as well.

    Raises:
        ConfigurationError: an unknown option.
    """
    limit = given.pop("max_episode_steps", None)
    known = [field.name for field in fields(kind)]
    validation.keys(f"option of {env_id}", given, known)
    if limit is not None:
        limit = validation.integer("max_episode_steps", limit, at_least=1)
    return kind(**given), limit


def make_bucket(chosen: CommonOptions, sensors: int) -> TokenBucket:
    """The token bucket of the options.

    Raises:
        ConfigurationError: a value that is not allowed.
    """
    unlimited = validation.choice("tokens", chosen.tokens, ("limited", "unlimited"))
    return TokenBucket.create(
        rate=chosen.token_rate,
        capacity=chosen.token_capacity,
        initial=chosen.initial_tokens,
        cost=chosen.token_cost,
        sensors=sensors,
        sharing=chosen.sharing,
        unlimited=unlimited == "unlimited",
    )


def finish(
    chosen: CommonOptions,
    system: System[Any],
    limit: int | None,
    weights: ArrayLike | None,
    **task: Any,
) -> Task:
    """The task of a system with the options' network, reward and episode.

    ``weights`` (n,) are the state weights if the options give none; ``limit`` shortens the episode
    without changing any scale.

    Raises:
        ConfigurationError: a value that is not allowed.
    """
    reward = Reward.create(
        chosen.error,
        chosen.error_weight,
        Price.create(chosen.cost_weight, chosen.price_range),
        weights if chosen.state_weights is None else chosen.state_weights,
        system.open_loop(chosen.horizon),
    )
    return Task(
        system=system,
        bucket=make_bucket(chosen, system.sensor_count),
        reward=reward,
        horizon=chosen.horizon if limit is None else min(chosen.horizon, limit),
        information=chosen.information,
        action=chosen.action,
        access=chosen.access,
        settings=plain(asdict(chosen)),
        **task,
    )


def plain(value: Any) -> Any:
    """Settings as plain lists, numbers and strings, ready for JSON."""
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value


def arrival_order(value: ArrayLike | None, sensors: int) -> tuple[int, ...] | None:
    """The option ``order``: a permutation of the sensors 0 to l - 1, or ``None``.

    Raises:
        ConfigurationError: not a permutation.
    """
    if value is None:
        return None
    given = validation.array("order", value, (sensors,))
    if sorted(given.tolist()) != list(range(sensors)):
        raise ConfigurationError(
            f"order = {value!r} is not allowed: it must hold each of the sensors 0 to "
            f"{sensors - 1} once"
        )
    return tuple(int(sensor) for sensor in given)
