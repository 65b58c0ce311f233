"""Prediction of an environment's next observation, for the entries that are not transmitted."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from fusion_gym.arrays import Array
from fusion_gym.errors import ConfigurationError, refusal
from fusion_gym.importing import import_named

_SEED, _EPISODES, _STEPS = 0, 20, 200  # of the episodes of the fit
_RANDOM = 0.2  # share of their actions that is random
_RANGES = 5.0  # ranges of the fit by which a linear prediction may depart from its middle
_ACTIONS = (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary, spaces.Box)


class Samples(NamedTuple):
    """T moves: ``before`` and ``after`` (n, T), ``control`` (k, T); the first ``fitted`` fit."""

    before: Array
    control: Array
    after: Array
    fitted: int


class Predictor:
    """Predict the next observation of one environment.

    ``explained_variance`` (n,) is R² of the predicted changes in episodes that did not fit.
    ``slope`` (n, n) and ``residual`` (n, n) are derivative and error covariance of a prediction.
    """

    def __init__(
        self, predictor: str | Callable[[Array, Any], Any], env: Any, samples: Samples
    ) -> None:
        self.weights: Array | None = None
        self.actions = env.action_space
        discrete = isinstance(self.actions, spaces.Discrete)
        self.units = np.eye(int(self.actions.n)) if discrete else None
        self.function: Callable[[Array, Any], Any] | None = None
        before, control, after, fitted = samples
        change, size = after - before, len(before)
        self.slope = np.eye(size)
        space, ranges = env.observation_space, np.ptp(after, 1)
        self.low, self.high = space.low[:, None], space.high[:, None]
        self.ranges = np.maximum(ranges, 1e-6)
        if predictor == "linear":
            terms = self._terms(control)
            rows = np.vstack((before, terms))[:, :fitted].T
            fit, *_ = np.linalg.lstsq(rows, change[:, :fitted].T, rcond=None)
            self.weights = np.asarray(fit.T[:, size:], dtype=np.float64)
            self.slope = self.slope + fit.T[:, :size]
            middle, reach = after.max(1) - 0.5 * ranges, _RANGES * self.ranges
            self.low = np.maximum(self.low, (middle - reach)[:, None])
            self.high = np.minimum(self.high, (middle + reach)[:, None])
        elif predictor != "hold":
            named = (
                import_named("predictor", predictor) if isinstance(predictor, str) else predictor
            )
            if not callable(named):
                raise refusal("predictor", predictor, "'hold', 'linear' or a function")
            self.function = named
        error = (after - self(before, control))[:, fitted:]
        total = change[:, fitted:].var(1)
        self.residual = error @ error.T / error.shape[1]
        self.explained_variance = 1.0 - np.diag(self.residual) / np.maximum(total, 1e-300)
        if predictor == "hold":
            self.residual = np.diag(np.diag(self.residual))

    def __call__(self, mean: Array, control: Array) -> Array:
        """Return the next observations (n, N) of estimates (n, N) and actions (k, N)."""
        if self.function is not None:
            actions = control.T if self.units is None else control[0].astype(np.int64)
            result = np.asarray(self.function(mean.T, actions), dtype=np.float64).T
            if result.shape != mean.shape:
                allowed = f"a function that returns the shape {mean.T.shape}, not {result.T.shape}"
                raise ConfigurationError(f"predictor is not allowed: it must be {allowed}")
        elif self.weights is not None:
            result = self.slope @ mean + self.weights @ self._terms(control)
        else:
            return mean
        clipped: Array = np.minimum(np.maximum(result, self.low), self.high)
        return clipped

    def _terms(self, control: Array) -> Array:
        """Return the actions and 1, or the unit vectors of discrete actions (entries, N)."""
        if self.units is None:
            return np.vstack((control, np.ones((1, control.shape[-1]))))
        return self.units.take(control[0].astype(np.int64) - self.actions.start, 1)


def sample(env: Any, act: Callable[[Array], Array] | None = None) -> Samples:
    """Return the moves of some episodes, a quarter of them for the test of a fit.

    Args:
        env: The environment.
        act: Function from estimates (n, N) to actions (k, N), a share of which is replaced by
            random actions; by default all are random.
    """
    generator, actions = np.random.default_rng(_SEED), env.action_space
    steps, fitted = list[Any](), 0
    actions.seed(_SEED)
    for number in range(_EPISODES):
        fitted = len(steps) if number == _EPISODES * 3 // 4 else fitted
        before, _ = env.reset(seed=number)
        for _ in range(_STEPS):
            if act is None or generator.random() < _RANDOM:
                control = np.array(actions.sample(), np.float64).reshape(-1)
            else:
                control = act(np.asarray(before, np.float64)[:, None])[:, 0]
            after, _, *ends, _ = env.step(action_of(actions, control))
            steps.append((before, control, after))
            before = after
            if any(ends):
                break
    moves = [np.array(part, np.float64).T for part in zip(*steps, strict=True)]
    return Samples(moves[0], moves[1], moves[2], fitted)


def action_of(space: spaces.Space[Any], control: Array) -> Any:
    """Return the action of numbers (k,)."""
    return int(control[0]) if isinstance(space, spaces.Discrete) else control.astype(space.dtype)


def check_spaces(field: str, value: Any, env: Any) -> None:
    """Raise an error if the observation is no vector or the action not made of numbers."""
    observations, actions = env.observation_space, env.action_space
    if not isinstance(observations, spaces.Box) or len(observations.shape) != 1:
        allowed = "an environment whose observation is a vector (FlattenObservation makes one)"
        raise refusal(field, value, f"{allowed}, not {observations}")
    if not isinstance(actions, _ACTIONS) or len(actions.shape or ()) > 1:
        raise refusal(field, value, f"an environment with numbers as action, not {actions}")


def check_indices(value: Any, size: int) -> tuple[tuple[int, ...], ...]:
    """Return the checked entries of each sensor."""
    allowed = f"a list of entries from 0 to {size - 1} for each sensor, together all of them"
    try:
        result = tuple(tuple(map(operator.index, sensor)) for sensor in value)
    except TypeError:
        raise refusal("sensor_indices", value, allowed) from None
    once = all(sensor and len(set(sensor)) == len(sensor) for sensor in result)
    if not once or {entry for sensor in result for entry in sensor} != set(range(size)):
        raise refusal("sensor_indices", value, allowed)
    return result
