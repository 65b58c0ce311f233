"""Token bucket: the network's hard limit of the rate of transmissions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.options import Budget, Harvest, SharingRule
from fusion_gym.errors import forbidden
from fusion_gym.namespace import namespace, ranked_sum
from fusion_gym.validation import ConfigurationError

SHARING_RULES: tuple[str, ...] = get_args(SharingRule)
BUDGETS: tuple[str, ...] = get_args(Budget)
HARVESTS: tuple[str, ...] = get_args(Harvest)
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
class TokenBucket:
    """Tokens accrue at ``rate`` per step up to ``capacity``; a grant to sensor m costs c_m.

    Under every rule a granted sensor goes to the end of the queue, several in their order.

    Args:
        rate: Tokens per step; with a bucket for each sensor (sensors, 1), as the next two.
        capacity: Largest number of tokens.
        initial: Tokens at the start of an episode.
        cost: Tokens c (sensors, 1).
        sharing: ``"equal"``: each of the l sensors owns ξ/l of the tokens ξ before this step's
            spending, and a request is granted if ξ/l >= c_m (tobit_token_bucket, equations (16) and
            (18)). ``"fixed"``: requests are granted in the order of the sensors while tokens last.
            ``"turns"``: the order is a queue, whose head blocks the others if the tokens do not pay
            for it; of two sensors with equal requests, neither gets more than one grant more than
            the other in any window.
        unlimited: Whether every request is granted; tokens spent are counted, the level stays full.
        budget: ``"shared"`` is one bucket. With ``"sensor"`` each sensor has a bucket of its own,
            and a request is granted if its tokens are at least c_m.
        harvest: ``"constant"`` adds ``rate`` tokens. ``"bernoulli"`` adds one token to a sensor's
            bucket with the probability ``rate``.

    Source: A. Nayyar, T. Basar, D. Teneketzis and V. V. Veeravalli, "Optimal strategies for
    communication and remote estimation with an energy harvesting sensor", IEEE Trans. Automatic
    Control 58, 2013, for ``budget="sensor"``.
    """

    rate: Array | float
    capacity: Array | float
    initial: Array | float
    cost: Array
    sharing: str = "equal"
    unlimited: bool = False
    budget: str = "shared"
    harvest: str = "constant"

    @classmethod
    def create(
        cls,
        rate: ArrayLike,
        capacity: ArrayLike,
        initial: ArrayLike,
        cost: ArrayLike,
        sensors: int,
        sharing: str = "equal",
        unlimited: bool = False,
        budget: str = "shared",
        harvest: str = "constant",
    ) -> TokenBucket:
        """Return a bucket with checked numbers; ``cost`` is one number or one per sensor.

        With ``budget="sensor"`` so are ``rate``, ``capacity`` and ``initial``.
        """
        each = validation.choice("budget", budget, BUDGETS) == "sensor"
        drawn = validation.choice("harvest", harvest, HARVESTS) == "bernoulli"
        if drawn and not each:
            raise validation.refusal("harvest", harvest, "'constant'", f"with budget={budget!r}")

        def numbers(name: str, value: Any, **limits: float | None) -> Array | float:
            if not each:
                return validation.number(name, value, **limits)
            entries = validation.spread(name, value, (sensors,)).tolist()
            return np.array([[validation.number(name, entry, **limits)] for entry in entries])

        costs = validation.positive("token_cost", cost, (sensors,))[:, None]
        limit = numbers("token_capacity", capacity, above=0.0)
        rule = validation.choice("sharing", sharing, SHARING_RULES)
        if each and rule != "equal":
            raise forbidden("sharing", sharing, "it has no use", "with budget='sensor'")
        if each and np.any(limit < costs) and not unlimited:
            raise validation.refusal("token_capacity", capacity, "at least a sensor's token_cost")
        needed = float(costs.max()) * (sensors if rule == "equal" else 1)
        if not each and limit < needed * (1.0 - 1e-12) and not unlimited:
            reason = (
                f"at least {needed:g}: under sharing='equal' each of the {sensors} sensors owns "
                f"1/{sensors} of the bucket and a transmission costs up to {costs.max():g}"
                if rule == "equal"
                else f"at least the cost of a transmission, {needed:g}"
            )
            raise ConfigurationError(
                f"token_capacity = {limit:g} is not allowed: with token_cost = "
                f"{validation.display(cost)} it must be {reason}"
            )
        start = numbers("initial_tokens", initial, at_least=0.0)
        if np.any(start > limit):
            most = validation.display(capacity) if each else f"{limit:g}"
            reason = f"with token_capacity = {most} it must be >= 0 and <= {most}"
            raise forbidden("initial_tokens", initial if each else start, reason)
        return cls(
            rate=numbers("token_rate", rate, at_least=0.0, at_most=1.0 if drawn else None),
            capacity=limit,
            initial=start,
            cost=costs,
            sharing=rule,
            unlimited=validation.boolean("unlimited", unlimited),
            budget=budget,
            harvest=harvest,
        )

    @property
    def per_sensor(self) -> bool:
        """Whether each sensor has a bucket of its own."""
        return self.budget == "sensor"

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
        if self.per_sensor or self.unlimited or len(costs) > 1 or not 0.0 < self.rate < costs[0]:
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
        harvest: NDArray[np.bool_] | None = None,
    ) -> Grants:
        """Return the grants for the requests of a step.

        Args:
            tokens: (N,), or (sensors, N) with a bucket for each sensor.
            requests: (sensors, N) bool.
            queue: (sensors, N), the order of ``"turns"``; by default sensor 0 is first.
            harvest: Tokens (sensors, N) that the sensors gain; by default ``rate``.

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
