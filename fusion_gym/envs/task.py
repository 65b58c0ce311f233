"""A task: a system, its network, what a policy may know, and what the answer is worth."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.envs.price import Price
from fusion_gym.network import ACCESS_RULES, TokenBucket
from fusion_gym.systems import Feature, System
from fusion_gym.validation import Array

INFORMATION_MODES = ("sensors", "centre")
ACTION_KINDS = ("binary", "discrete")
ERROR_KINDS = ("squared", "trace")
_NOTHING = np.empty((0, 1))


@dataclass(frozen=True)
class Reward:
    """reward = -(error_weight · Σᵢ wᵢ error_i + price · tokens spent).

    ``error="squared"`` takes the squared error of the fused estimate, ``"trace"`` the diagonal of
    its covariance as the filter claims it (which a policy can game, see the documentation).
    ``state_weights`` w has shape (n, 1).
    """

    error: str
    error_weight: float
    price: Price
    state_weights: Array

    @classmethod
    def create(
        cls,
        error: str,
        error_weight: float,
        price: Price,
        state_weights: ArrayLike | None,
        open_loop: Array,
    ) -> Reward:
        """Check the weights; ``None`` weighs all states alike so that open loop costs 1.

        ``open_loop`` (n,) is the mean error variance of each state without any transmission.

        Raises:
            ConfigurationError: an unknown kind, a negative weight, or a wrong shape.
        """
        weights = (
            np.full(open_loop.shape, 1.0 / open_loop.sum())
            if state_weights is None
            else validation.not_negative("state_weights", state_weights, open_loop.shape)
        )
        return cls(
            error=validation.choice("error", error, ERROR_KINDS),
            error_weight=validation.number("error_weight", error_weight, at_least=0.0),
            price=price,
            state_weights=weights[:, None],
        )

    def terms(
        self, squared_error: Array, covariance: Array, spent: Array, price: Array
    ) -> tuple[Array, Array]:
        """The two terms of the reward (N,), both <= 0: error and cost.

        From squared errors (n, N), the fused covariance (n, n, N), tokens spent (N,) and the
        price of a token (N,).
        """
        error = squared_error if self.error == "squared" else linalg.diagonal(covariance)
        return -self.error_weight * (self.state_weights * error).sum(0), -price * spent


@dataclass(frozen=True)
class Task:
    """Everything that an environment needs to know, independent of the number of runs.

    ``information`` is ``"sensors"`` (a coordinator that sees every sensor's new measurement) or
    ``"centre"`` (only what the fusion centre knows before anything is sent). ``action`` is
    ``"binary"`` (one bit a sensor) or ``"discrete"`` (the bits as one number, sensor 0 the lowest).
    ``access`` is a rule of :func:`fusion_gym.network.access_mask`; with ``"single"`` the action is
    0 for nobody or the number of the sensor, counted from 1.
    ``settings`` is what a user chose, for reports; ``policy_defaults`` the scenario's own
    parameters of named policies.

    Raises:
        ConfigurationError: an unknown mode, a horizon below 1, or parts that do not fit together.
    """

    system: System[Any]
    bucket: TokenBucket
    reward: Reward
    horizon: int
    information: str = "sensors"
    action: str = "binary"
    access: str = "any"
    settings: dict[str, Any] = field(default_factory=dict)
    policy_defaults: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        validation.integer("horizon", self.horizon, at_least=1)
        if self.information == "local":
            raise validation.ConfigurationError(
                "information = 'local' is not allowed here: it must be one of "
                f"{', '.join(map(repr, INFORMATION_MODES))}; sensors that decide by themselves are "
                "fusion_gym.parallel_env(id) and make_sb3_vec_env(id, n, local=True)"
            )
        validation.choice("information", self.information, INFORMATION_MODES)
        validation.choice("action", self.action, ACTION_KINDS)
        validation.choice("access", self.access, ACCESS_RULES)
        if len(self.bucket.cost) != self.system.sensor_count:
            raise validation.ConfigurationError(
                f"token_cost for {len(self.bucket.cost)} sensors is not allowed: the system has "
                f"{self.system.sensor_count}"
            )
        states = len(self.system.state_names)
        if self.reward.state_weights.shape != (states, 1):
            raise validation.ConfigurationError(
                f"state_weights of shape {self.reward.state_weights.shape} are not allowed: the "
                f"system has {states} states, so it must be ({states}, 1)"
            )

    @property
    def sensors(self) -> int:
        """Number of sensors."""
        return self.system.sensor_count

    @functools.cached_property
    def divergence_level(self) -> Array:
        """Squared errors (n, 1) beyond which a run counts as diverged: 100 times open loop."""
        return 100.0 * self.system.open_loop(self.horizon)[:, None]

    @property
    def hidden_signals(self) -> tuple[str, ...]:
        """Names of the system's signals that the information mode withholds."""
        if self.information == "sensors":
            return ()
        hidden = (s.name for s in self.system.signals if s.knowledge == "sensor")
        return ("state", *hidden)


class ObservationLayout:
    """Which entries an agent's observation has, by name, and how it is filled.

    ``entries`` are its features, ``names`` has one name an entry, ``low`` and ``high`` (entries,)
    float32 are its bounds.
    """

    def __init__(self, task: Task) -> None:
        admitted = tuple(
            Feature(f"admitted[{sensor}]", "centre", 0.0, 1.0, sensor=sensor)
            for sensor in range(task.sensors if task.access in ("round_robin", "random") else 0)
        )
        self._price = task.reward.price if task.reward.price.span is not None else None
        price = (
            () if self._price is None else (Feature("price", "centre", 0.0, 1.0, broadcast=True),)
        )
        tokens = (Feature("tokens", "centre", 0.0, 1.0, broadcast=True),)
        blocks = (*task.system.features, tokens, admitted, price)
        self._kept = [
            number
            for number, block in enumerate(blocks)
            if block and (task.information == "sensors" or block[0].knowledge == "centre")
        ]
        entries = [entry for number in self._kept for entry in blocks[number]]
        self.entries = tuple(entries)
        self.names = tuple(entry.name for entry in entries)
        self.low = np.array([entry.low for entry in entries], dtype=np.float32)
        self.high = np.array([entry.high for entry in entries], dtype=np.float32)
        self._shows_admitted = bool(admitted)
        self._capacity = task.bucket.capacity
        self._system = task.system

    def encode(
        self, state: Any, tokens: Array, admitted: Callable[[], NDArray[np.bool_]], price: Array
    ) -> np.ndarray[Any, np.dtype[np.float32]]:
        """Observations (N, entries) float32, clipped to their bounds.

        ``tokens`` (N,) and ``admitted()`` (sensors, N) are the network's, ``price`` (N,) is that
        of a token.
        """
        blocks = [*self._system.observe(state), tokens[None] / self._capacity]
        blocks.append(admitted().astype(np.float64) if self._shows_admitted else _NOTHING)
        if self._price is not None:
            blocks.append(self._price.encode(price)[None])
        rows = np.concatenate([blocks[number] for number in self._kept])
        result = np.ascontiguousarray(rows.T, dtype=np.float32)
        np.maximum(result, self.low, out=result)
        return np.minimum(result, self.high, out=result)
