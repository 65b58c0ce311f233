"""Token bucket: the network's hard limit of the rate of transmissions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.declaration import OptionGroup, Scaling
from fusion_gym.errors import ConfigurationError, forbidden, refusal
from fusion_gym.namespace import namespace, ndtr, ranked_sum

Tokens = Literal["limited", "unlimited"]
SharingRule = Literal["equal", "fixed", "turns"]
Budget = Literal["shared", "sensor"]
Harvest = Literal["constant", "bernoulli"]
Queue = NDArray[np.int64]
_ROUNDING = 1e-9  # tokens: ten times 0.1 pays for a transmission that costs 1
_FEW = 16  # sensors up to which pairwise comparison is faster than sorting


class Grants(NamedTuple):
    """The network's response to the requests of a step.

    Attributes:
        granted: (sensors, N) bool.
        spent: Tokens spent (N,).
        tokens: Tokens after the step (N,), or (sensors, N) of each sensor's own bucket.
        queue: Place of each sensor in the queue (sensors, N), 0 for the sensor granted least
            recently.
    """

    granted: NDArray[np.bool_]
    spent: Array
    tokens: Array
    queue: Queue


@dataclass(frozen=True)
class BucketOptions(OptionGroup):
    """The options of the token bucket."""

    tokens: Annotated[Tokens, Scaling()] = "limited"
    """``"limited"`` applies the token bucket. ``"unlimited"`` grants every request and counts the
    tokens spent."""
    budget: Annotated[Budget, Scaling()] = "shared"
    """``"shared"`` is one bucket for all sensors. With ``"sensor"`` each sensor has a bucket of its
    own, such as a battery; ``token_rate``, ``token_capacity`` and ``initial_tokens`` are then one
    number, or one per sensor."""
    harvest: Annotated[Harvest, Scaling()] = "constant"
    """Tokens that a bucket gains per step: ``token_rate`` (``"constant"``), or with
    ``budget="sensor"`` one token with the probability ``token_rate`` (``"bernoulli"``)."""
    token_rate: Annotated[ArrayLike, Scaling()] = 5.0
    """Tokens g that the bucket gains per step (tobit_token_bucket, equation (17)). With
    ``budget="shared"`` a pair (low, high) is a range, from which each episode draws uniformly. The
    observation and the signal ``token_rate`` show the episode's rate."""
    token_capacity: Annotated[ArrayLike, Scaling()] = 30.0
    """Largest number b of tokens in the bucket (tobit_token_bucket, equation (17))."""
    initial_tokens: Annotated[ArrayLike, Scaling()] = 10.0
    """Tokens ξ₀ at the start of an episode."""
    token_cost: Annotated[ArrayLike, Scaling()] = 3.0
    """Tokens c that a transmission costs: one number, or one per sensor."""
    sharing: Annotated[SharingRule, Scaling()] = "turns"
    """Rule by which simultaneous requests share the tokens. ``"equal"`` grants if ξ/l ≥ c for l
    sensors (tobit_token_bucket, equations (16) and (18)). ``"fixed"`` grants in the order of the
    sensors while tokens last. ``"turns"`` grants in the order of a queue: a granted sensor goes to
    its end, and a request that the tokens do not pay for blocks the requests behind it."""


@dataclass(frozen=True)
class TokenBucket:
    """Tokens accrue at ``rate`` per step up to ``capacity``; a grant to sensor m costs c_m.

    Under every rule of ``sharing`` a granted sensor goes to the end of the queue, several in their
    order. Under ``"equal"`` each of the l sensors owns ξ/l of the tokens ξ before this step's
    spending, and a request is granted if ξ/l >= c_m (tobit_token_bucket, equations (16) and (18)).
    Under ``"turns"``, of two sensors with equal requests, neither gets more than one grant more
    than the other in any window. With a bucket for each sensor a request is granted if its tokens
    are at least c_m, and rate, capacity and initial tokens are (sensors, 1). Unlimited tokens stay
    full, and tokens spent are counted.

    Args:
        options: The options.
        sensors: Number of sensors.

    Raises:
        ConfigurationError: A number is not allowed, or the capacity is below the cost of a packet.

    Source: A. Nayyar, T. Basar, D. Teneketzis and V. V. Veeravalli, "Optimal strategies for
    communication and remote estimation with an energy harvesting sensor", IEEE Trans. Automatic
    Control 58, 2013, for ``budget="sensor"``.
    """

    options: BucketOptions
    sensors: int

    def __post_init__(self) -> None:
        options, costs, limit, start = self.options, self.cost, self.capacity, self.initial
        if self.draws_harvest and not self.per_sensor:
            where = f"with budget={options.budget!r}"
            raise refusal("harvest", options.harvest, "'constant'", where)
        if self.per_sensor and options.sharing != type(options).sharing:
            raise forbidden("sharing", options.sharing, "it has no use", "with budget='sensor'")
        if self.per_sensor and np.any(limit < costs) and not self.unlimited:
            allowed = "at least a sensor's token_cost"
            raise refusal("token_capacity", options.token_capacity, allowed)
        sensors, equal = self.sensors, self.sharing == "equal"
        needed = float(costs.max()) * (sensors if equal else 1)
        if not self.per_sensor and limit < needed * (1.0 - 1e-12) and not self.unlimited:
            reason = (
                f"at least {needed:g}: under sharing='equal' each of the {sensors} sensors owns "
                f"1/{sensors} of the bucket and a transmission costs up to {costs.max():g}"
                if equal
                else f"at least the cost of a transmission, {needed:g}"
            )
            raise ConfigurationError(
                f"token_capacity = {limit:g} is not allowed: with token_cost = "
                f"{validation.display(options.token_cost)} it must be {reason}"
            )
        if np.any(start > limit):
            each = self.per_sensor
            most = validation.display(options.token_capacity) if each else f"{limit:g}"
            reason = f"with token_capacity = {most} it must be >= 0 and <= {most}"
            raise forbidden("initial_tokens", options.initial_tokens if each else start, reason)
        if self.rate_range is None:
            self._numbers("token_rate", at_least=0.0, at_most=1.0 if self.draws_harvest else None)
        elif self.unlimited:
            where = "with tokens='unlimited'"
            raise forbidden("token_rate", options.token_rate, "a range has no use", where)

    def _numbers(self, name: str, **limits: float | None) -> Array | float:
        """Return the checked numbers of an option: one, or (sensors, 1) of each sensor's bucket."""
        value = getattr(self.options, name)
        if not self.per_sensor:
            return validation.number(name, value, **limits)
        entries = validation.spread(name, value, (self.sensors,)).tolist()
        return np.array([[validation.number(name, entry, **limits)] for entry in entries])

    @cached_property
    def cost(self) -> Array:
        """Tokens c (sensors, 1) of a transmission."""
        return validation.positive("token_cost", self.options.token_cost, (self.sensors,))[:, None]

    @cached_property
    def rate(self) -> Array | float:
        """Tokens per step, typical ones with a range."""
        return self._numbers("token_rate") if self.rate_range is None else sum(self.rate_range) / 2

    @cached_property
    def rate_range(self) -> tuple[float, float] | None:
        """Range (low, high) of the tokens per step of an episode; ``None`` is :attr:`rate`."""
        value: Any = self.options.token_rate
        shape = validation.array_shape(value)
        if self.per_sensor or shape == ():
            return None
        ends = value if shape == (2,) else (0.0, 0.0)
        low, high = (validation.number("token_rate", end, at_least=0.0) for end in ends)
        if not low < high:
            allowed = "a number >= 0, or a pair (low, high) of such numbers, low < high"
            raise refusal("token_rate", value, allowed)
        return low, high

    @cached_property
    def capacity(self) -> Array | float:
        """Largest number of tokens."""
        return self._numbers("token_capacity", above=0.0)

    @cached_property
    def initial(self) -> Array | float:
        """Tokens at the start of an episode."""
        return self._numbers("initial_tokens", at_least=0.0)

    @cached_property
    def unlimited(self) -> bool:
        """Whether every request is granted."""
        return self.options.tokens == "unlimited"

    @cached_property
    def per_sensor(self) -> bool:
        """Whether each sensor has a bucket of its own."""
        return self.options.budget == "sensor"

    @cached_property
    def draws_harvest(self) -> bool:
        """Whether a bucket gains one token with the probability ``rate``."""
        return self.options.harvest == "bernoulli"

    @cached_property
    def sharing(self) -> str:
        """Rule of sharing; sensors with their own buckets share nothing, as under ``"equal"``."""
        return "equal" if self.per_sensor else self.options.sharing

    @property
    def round_cost(self) -> Array:
        """Tokens (buckets, 1) of one packet of each sensor that a bucket pays for."""
        return self.cost if self.per_sensor else self.cost.sum(keepdims=True)

    @property
    def resonates(self) -> bool:
        """Whether round-robin access grants some sensors more often than others if all request.

        A packet costs the tokens of p/q steps, in lowest terms. With d = gcd(p, sensors) the grants
        fall on q of d groups of sensors in turn, evenly where d divides q.
        """
        costs = np.unique(self.cost)
        free = self.per_sensor or self.unlimited or self.rate_range is not None
        if free or len(costs) > 1 or not 0.0 < self.rate < costs[0]:
            return False
        steps = Fraction(float(costs[0] / self.rate)).limit_denominator(1000)
        return steps.denominator % math.gcd(steps.numerator, len(self.cost)) != 0

    @property
    def favours_cheaper(self) -> bool:
        """Whether sensors with a higher cost may lose their turns more often (rate < max c_m)."""
        unequal = float(self.cost.min()) < float(self.cost.max())
        free = self.unlimited or self.per_sensor or not unequal
        return not free and bool(self.rate < self.cost.max())

    def start(self, num_envs: int) -> Array:
        """Return the tokens (num_envs,) or (sensors, num_envs) at the start of an episode."""
        shape = (len(self.cost), num_envs) if self.per_sensor else (num_envs,)
        return np.full(shape, self.capacity if self.unlimited else self.initial)

    def start_rate(self, noise: Array) -> Array | None:
        """Return the tokens per step (N,) of an episode; ``None`` is :attr:`rate`.

        Args:
            noise: Standard normals (channels, N), of which a range takes the last.
        """
        if self.rate_range is None:
            return None
        low, high = self.rate_range
        return low + (high - low) * ndtr(noise[-1])

    def start_queue(self, num_envs: int) -> Queue:
        """Return the queue (sensors, num_envs) at the start of an episode, sensor 0 first."""
        return np.repeat(np.arange(len(self.cost))[:, None], num_envs, axis=1)

    def affordable(self, tokens: Array) -> NDArray[np.bool_]:
        """Return whether tokens pay for a single request of each sensor (sensors, N)."""
        share = len(self.cost) if self.sharing == "equal" and not self.per_sensor else 1
        return (self.cost * share <= tokens + _ROUNDING) | self.unlimited

    def grant(
        self,
        tokens: Array,
        requests: NDArray[np.bool_],
        queue: Queue | None = None,
        harvest: Array | NDArray[np.bool_] | None = None,
    ) -> Grants:
        """Return the grants for the requests of a step.

        Args:
            tokens: (N,), or (sensors, N) with a bucket for each sensor.
            requests: (sensors, N) bool.
            queue: (sensors, N), the order of ``"turns"``; by default sensor 0 is first.
            harvest: Tokens (N,) or (sensors, N) that the buckets gain; by default ``rate``.

        Source: tobit_token_bucket, equations (16)-(18).
        """
        xp = namespace(tokens, requests)
        queue = self.start_queue(tokens.shape[-1]) if queue is None else queue
        if self.unlimited:
            granted = requests.copy()
        elif self.sharing == "equal":
            granted = requests & self.affordable(tokens)
        elif self.sharing == "turns":
            due = ranked_sum(requests * self.cost, queue)  # for all requests up to each one's place
            granted = requests & (due <= tokens + _ROUNDING)
        else:
            granted = self._grant_in_order(tokens, requests)
        paid = granted * self.cost
        spent = linalg.total(paid)
        if not self.unlimited:
            gained = tokens + (self.rate if harvest is None else harvest)
            left = gained - (paid if self.per_sensor else spent)
            tokens = xp.minimum(xp.maximum(left, 0.0), self.capacity)
        return Grants(granted, spent, tokens, move_to_end(queue, granted))

    def _grant_in_order(self, tokens: Array, requests: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Grant affordable requests in the order of the sensors."""
        left, answers = tokens + _ROUNDING, []
        for request, price in zip(requests, self.cost, strict=True):
            answers.append(request & (price <= left))
            left = left - answers[-1] * price
        granted: NDArray[np.bool_] = namespace(tokens, requests).stack(answers)
        return granted


def move_to_end(queue: Queue, granted: NDArray[np.bool_]) -> Queue:
    """Return the queue with granted sensors at its end, several in their order."""
    if len(queue) == 1:
        return queue
    key = queue + len(queue) * granted
    if len(queue) > _FEW:
        xp = namespace(key)
        return xp.argsort(xp.argsort(key, axis=0), axis=0)
    return (key[:, None] > key).sum(1)
