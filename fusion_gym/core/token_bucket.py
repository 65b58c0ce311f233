"""Token bucket: the network's hard limit of the rate of transmissions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.options import SharingRule
from fusion_gym.errors import forbidden
from fusion_gym.namespace import namespace, ranked_sum
from fusion_gym.validation import ConfigurationError

SHARING_RULES: tuple[str, ...] = get_args(SharingRule)
Queue = NDArray[np.int64]
_ROUNDING = 1e-9  # tokens: ten times 0.1 pays for a transmission that costs 1
_FEW = 16  # sensors up to which pairwise comparison is faster than sorting


class Grants(NamedTuple):
    """The network's response to the requests of a step.

    Attributes:
        granted: (sensors, N) bool.
        spent: Tokens spent (N,).
        tokens: Tokens after the step (N,).
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
        rate: Tokens per step.
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
    """

    rate: float
    capacity: float
    initial: float
    cost: Array
    sharing: str = "equal"
    unlimited: bool = False

    @classmethod
    def create(
        cls,
        rate: float,
        capacity: float,
        initial: float,
        cost: ArrayLike,
        sensors: int,
        sharing: str = "equal",
        unlimited: bool = False,
    ) -> TokenBucket:
        """Return a bucket with checked numbers; ``cost`` is one number or one per sensor."""
        costs = validation.positive("token_cost", cost, (sensors,))[:, None]
        limit = validation.number("token_capacity", capacity, above=0.0)
        rule = validation.choice("sharing", sharing, SHARING_RULES)
        needed = float(costs.max()) * (sensors if rule == "equal" else 1)
        if limit < needed * (1.0 - 1e-12) and not unlimited:
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
        start = validation.number("initial_tokens", initial, at_least=0.0)
        if start > limit:
            reason = f"with token_capacity = {limit:g} it must be >= 0 and <= {limit:g}"
            raise forbidden("initial_tokens", start, reason)
        return cls(
            rate=validation.number("token_rate", rate, at_least=0.0),
            capacity=limit,
            initial=start,
            cost=costs,
            sharing=rule,
            unlimited=validation.boolean("unlimited", unlimited),
        )

    @property
    def resonates(self) -> bool:
        """Whether round-robin access grants some sensors more often than others if all request.

        A packet costs the tokens of p/q steps, in lowest terms. With d = gcd(p, sensors) the grants
        fall on q of d groups of sensors in turn, evenly where d divides q.
        """
        costs = np.unique(self.cost)
        if self.unlimited or len(costs) > 1 or not 0.0 < self.rate < costs[0]:
            return False
        steps = Fraction(float(costs[0]) / self.rate).limit_denominator(1000)
        return steps.denominator % math.gcd(steps.numerator, len(self.cost)) != 0

    @property
    def favours_cheaper(self) -> bool:
        """Whether sensors with a higher cost may lose their turns more often (rate < max c_m)."""
        unequal = float(self.cost.min()) < float(self.cost.max())
        return not self.unlimited and unequal and self.rate < float(self.cost.max())

    def start(self, num_envs: int) -> Array:
        """Return the tokens (num_envs,) at the start of an episode."""
        return np.full(num_envs, self.capacity if self.unlimited else self.initial)

    def start_queue(self, num_envs: int) -> Queue:
        """Return the queue (sensors, num_envs) at the start of an episode, sensor 0 first."""
        return np.repeat(np.arange(len(self.cost))[:, None], num_envs, axis=1)

    def affordable(self, tokens: Array) -> NDArray[np.bool_]:
        """Return whether tokens (N,) pay for a single request of each sensor (sensors, N)."""
        share = len(self.cost) if self.sharing == "equal" else 1
        return (self.cost * share <= tokens + _ROUNDING) | self.unlimited

    def grant(
        self, tokens: Array, requests: NDArray[np.bool_], queue: Queue | None = None
    ) -> Grants:
        """Return the grants for the requests of a step.

        Args:
            tokens: (N,).
            requests: (sensors, N) bool.
            queue: (sensors, N), the order of ``"turns"``; by default sensor 0 is first.

        Source: tobit_token_bucket, equations (16)-(18).
        """
        xp = namespace(tokens, requests)
        queue = self.start_queue(len(tokens)) if queue is None else queue
        if self.unlimited:
            granted = requests.copy()
        elif self.sharing == "equal":
            granted = requests & self.affordable(tokens)
        elif self.sharing == "turns":
            due = ranked_sum(requests * self.cost, queue)  # for all requests up to each one's place
            granted = requests & (due <= tokens + _ROUNDING)
        else:
            granted = self._grant_in_order(tokens, requests)
        spent = linalg.total(granted * self.cost)
        if not self.unlimited:
            tokens = xp.minimum(xp.maximum(tokens + self.rate - spent, 0.0), self.capacity)
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
