"""The reachable levels of a token bucket, as states of a dynamic programme."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.core.token_bucket import TokenBucket
from fusion_gym.validation import ConfigurationError

_MOST_LEVELS = 500
_MOST_SENSORS = 12
_DIGITS = 9


@dataclass(frozen=True)
class TokenLevels:
    """The reachable levels of a token bucket, and the effect of each set of requests.

    A choice is a set of sensors, the bits of its number; choice 0 is silence.

    Args:
        level: levels (K,) in ascending order.
        initial: index of the level at the start.
        affordable: whether the network grants every request of the choice (K, choices), bool.
        following: index of the next level (K, choices).
        spent: tokens of each choice (choices,).
    """

    level: Array
    initial: int
    affordable: NDArray[np.bool_]
    following: NDArray[np.int64]
    spent: Array

    @classmethod
    def create(cls, bucket: TokenBucket) -> TokenLevels:
        """Return the reachable levels of the bucket; an unlimited bucket has one level."""
        sensors = len(bucket.cost)
        if sensors > _MOST_SENSORS:
            raise ConfigurationError(
                f"sensors = {sensors} is not allowed for the exact optimum under a common bucket: "
                f"it must be at most {_MOST_SENSORS}, because all 2^{sensors} sets of sensors are "
                "choices"
            )
        choices = np.arange(2**sensors)
        sets = (choices >> np.arange(sensors)[:, None] & 1).astype(np.bool_)
        spent = (sets * bucket.cost).sum(0)
        start = float(bucket.start(1)[0])
        if bucket.unlimited:
            everything = np.ones((1, len(choices)), dtype=np.bool_)
            return cls(np.array([start]), 0, everything, np.zeros((1, len(choices)), int), spent)
        result, new = {round(start, _DIGITS)}, [round(start, _DIGITS)]
        while new:
            following = {
                round(float(level), _DIGITS)
                for source in new
                for level in bucket.grant(np.full(len(choices), source), sets).tokens
            }
            new = sorted(following - result)
            result |= following
            if len(result) > _MOST_LEVELS:
                raise ConfigurationError(
                    f"token_rate = {bucket.rate}, token_capacity = {bucket.capacity} are not "
                    f"allowed for the exact optimum: the bucket must have at most {_MOST_LEVELS} "
                    "levels, so rate, cost and capacity need a common divisor"
                )
        level = np.array(sorted(result))
        grants = bucket.grant(np.repeat(level, len(choices)), np.tile(sets, len(level)))
        shape = (len(level), len(choices))
        affordable = (grants.granted == np.tile(sets, len(level))).all(0).reshape(shape)
        after = np.searchsorted(level, np.round(grants.tokens, _DIGITS) - 10.0**-_DIGITS)
        initial = int(np.searchsorted(level, round(start, _DIGITS) - 10.0**-_DIGITS))
        return cls(level, initial, affordable, after.reshape(shape), spent)

    @property
    def wait(self) -> float:
        """Steps for which the tokens of all sensors are saved; 0 for unlimited tokens."""
        if len(self.level) == 1:
            return 0.0
        rate = float((self.level[self.following[:, 0]] - self.level).max())
        return float(self.spent[-1]) / max(rate, 1e-12)

    def index(self, tokens: Array) -> NDArray[np.int64]:
        """Return the index of each level in ``tokens`` (N,)."""
        if len(self.level) == 1:
            return np.zeros(len(tokens), dtype=np.int64)
        middle = 0.5 * (self.level[1:] + self.level[:-1])
        return np.searchsorted(middle, tokens)
