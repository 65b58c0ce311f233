"""Wrappers of other Gymnasium environments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import ArrayLike, NDArray

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.envs.predictor import Predictor, action_of, check_indices, check_spaces, sample
from fusion_gym.errors import refusal

__all__ = ["CostlyObservation"]

_AGE = 10.0  # steps at which the entry of an age is a half
_ROUNDING = 1e-9  # tokens: ten times 0.1 pays for a request


class CostlyObservation(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Let an agent pay for each sensor whose next observation it requests.

    The action has the environment's action, then a request for each sensor: a ``MultiDiscrete`` of
    0 and 1, or with a ``Box`` of actions an entry in [-1, 1], which requests if it is positive. The
    requests of a step are for the observation after its move.

    The observation is a float32 ``Box``: the estimate of the environment's observation, which has
    the entries of granted requests and predicts the others, then a/(a + 10) for each sensor, where
    a are the steps since its last observation, and with ``token_rate`` the tokens over
    ``token_capacity``. The first observation is free.

    The reward is the environment's less the prices of the granted requests. ``info`` has ``cost``,
    the granted requests, and ``observation``, the environment's whole observation.
    ``predictor.explained_variance`` (n,) is R² of the predicted changes in episodes without a fit.

    Args:
        env: Environment whose observation is a vector (n,) and whose action is made of numbers.
        sensor_indices: Entries of the observation that each sensor measures; together all.
        price: Price of a request >= 0, in units of the reward, or one per sensor.
        predictor: Estimate of the entries that are not observed: ``"hold"``, ``"linear"``, which
            fits the next observation to observation and random actions in 20 episodes, or a
            function ``predict(observations, actions)`` from arrays (N, n) and (N,) or (N, k) to
            (N, n), or its ``"module:name"``.
        token_rate: Requests per step that a token bucket allows on average; ``None`` is no limit.
        token_capacity: Most tokens of the bucket, which starts full. A request takes one; if the
            tokens do not pay for all, the first sensors have precedence.

    Raises:
        ConfigurationError: An argument is not allowed.

    Example:
        >>> import gymnasium
        >>> from fusion_gym.wrappers import CostlyObservation
        >>> env = gymnasium.make("CartPole-v1")
        >>> env = CostlyObservation(env, sensor_indices=[[0, 1], [2, 3]], price=0.1)
        >>> observation, info = env.reset(seed=0)
        >>> env.action_space, len(observation)
        (MultiDiscrete([2 2 2]), 6)
        >>> observation, reward, *_ = env.step([1, 0, 1])
        >>> reward
        0.9
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        sensor_indices: Sequence[Sequence[int]],
        price: ArrayLike,
        predictor: str | Callable[[Array, Any], Any] = "hold",
        token_rate: float | None = None,
        token_capacity: float = 10.0,
    ) -> None:
        RecordConstructorArgs.__init__(
            self,
            sensor_indices=sensor_indices,
            price=price,
            predictor=predictor,
            token_rate=token_rate,
            token_capacity=token_capacity,
        )
        super().__init__(env)
        check_spaces("env", env, env)
        seen: Any = env.observation_space
        indices = check_indices(sensor_indices, len(seen.low))
        self._sensors, self._entries = len(indices), indices
        self._prices = validation.not_negative("price", price, (self._sensors,)).tolist()
        self._limit: tuple[float, float] | None = None
        if token_rate is not None:
            rate = validation.number("token_rate", token_rate, at_least=0.0)
            self._limit = rate, validation.number("token_capacity", token_capacity, at_least=1.0)
        self.predictor = self._fit(predictor)
        self._own = env.action_space
        self.action_space = _joint(self._own, self._sensors)
        low, high = (
            np.append(bound, [end] * (self._sensors + bool(self._limit))).astype(np.float32)
            for bound, end in ((seen.low, 0.0), (seen.high, 1.0))
        )
        self.observation_space = spaces.Box(low, high, dtype=np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment, whose first observation is free."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._estimate = np.asarray(observation, np.float64).tolist()
        self._ages, self._tokens = [0.0] * self._sensors, self._limit[1] if self._limit else 0.0
        return self._observe(), info | {"cost": 0.0, "observation": observation}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Move the environment, and deliver what is requested of its observation."""
        joint, price, cost = np.asarray(action), 0.0, 0.0
        control, requests = joint[: -self._sensors], joint[-self._sensors :].tolist()
        result = self.env.step(action_of(self._own, control))
        observation, reward, terminated, truncated, info = result
        if self._limit:
            self._tokens = min(self._tokens + self._limit[0], self._limit[1])
        estimate, seen = np.array([self._estimate]).T, observation.tolist()
        self._estimate = self.predictor(estimate, control[:, None])[:, 0].tolist()
        for sensor, request in enumerate(requests):
            granted = request > 0 and (self._limit is None or self._tokens >= 1.0 - _ROUNDING)
            self._ages[sensor] = 0.0 if granted else self._ages[sensor] + 1.0
            if granted:
                price, cost = price + self._prices[sensor], cost + 1.0
                for entry in self._entries[sensor]:
                    self._estimate[entry] = seen[entry]
                self._tokens -= 1.0
        info = info | {"cost": cost, "observation": observation}
        return self._observe(), float(reward) - price, terminated, truncated, info

    def _observe(self) -> NDArray[np.float32]:
        """Return estimate, ages and tokens."""
        tokens = [self._tokens / self._limit[1]] if self._limit else []
        rows = *self._estimate, *(age / (age + _AGE) for age in self._ages), *tokens
        return np.array(rows, np.float32)

    def _fit(self, predictor: Any) -> Predictor:
        """Return the predictor, fitted to episodes of another copy of the environment."""
        if self.env.spec is None:
            raise refusal("env", self.env, "an environment of gymnasium.make, which can be copied")
        with gymnasium.make(self.env.spec) as copy:
            samples = sample(copy)
        return Predictor(predictor, self.env, samples)


def _joint(actions: Any, sensors: int) -> spaces.Space[Any]:
    """Return the space of the environment's action and a request for each sensor."""
    if isinstance(actions, spaces.Box):
        ends = np.full(sensors, 1.0, actions.low.dtype)
        low, high = np.append(actions.low, -ends), np.append(actions.high, ends)
        return spaces.Box(low, high, dtype=low.dtype.type)
    if isinstance(actions, spaces.MultiBinary):
        return spaces.MultiDiscrete([2] * (len(actions.sample()) + sensors))
    counts = actions.nvec if isinstance(actions, spaces.MultiDiscrete) else [actions.n]
    start = np.append(actions.start, np.zeros(sensors, np.int64))
    return spaces.MultiDiscrete(np.append(counts, [2] * sensors), start=start)
