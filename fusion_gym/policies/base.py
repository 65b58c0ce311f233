"""The one interface of every policy, and what the analytic ones share."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from fusion_gym import validation
from fusion_gym.core.system import Signals

Requests = NDArray[np.bool_]
PerSensor = float | tuple[float, ...]


class Policy(Protocol):
    """From signals to requests, for N runs at once.

    ``reset(num_envs, seed)`` comes before the first call; ``seed`` is for policies that draw.
    A call takes the signals of one step and returns requests (sensors, N) bool. A run begins a
    new episode wherever ``signals["start"]`` is true.
    """

    def reset(self, num_envs: int, seed: int = 0) -> None:
        """Forget everything."""
        ...

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N) for these signals."""
        ...


class Trigger:
    """Base of the analytic policies: a dataclass of parameters, checked before anything runs."""

    def reset(self, num_envs: int, seed: int = 0) -> None:
        """Nothing to forget, unless a trigger with a memory says otherwise."""

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N) for these signals."""
        raise TypeError(f"{type(self).__name__} does not say what it requests")


def shape_of(signals: Signals) -> tuple[int, int]:
    """Number of sensors and of runs."""
    return len(signals["token_cost"]), len(signals["tokens"])


def column(name: str, value: Any, sensors: int) -> NDArray[np.float64]:
    """A parameter as (sensors, 1): one number for all sensors, or one for each.

    Raises:
        ConfigurationError: another number of entries.
    """
    return validation.spread(name, value, (sensors,))[:, None]


def check_not_negative(name: str, value: Any) -> None:
    """One number >= 0 or a sequence of them.

    Raises:
        ConfigurationError: anything else.
    """
    given = np.asarray(value)
    validation.not_negative(name, value, given.shape if given.ndim == 1 else ())


def check_at_most(value: int | None) -> None:
    """How many sensors may be requested in a step: a whole number >= 1, or None for all.

    Raises:
        ConfigurationError: anything else.
    """
    if value is not None:
        validation.integer("at_most", value, at_least=1)


def strongest(
    score: NDArray[np.float64], wanted: Requests, at_most: int | None, age: NDArray[np.float64]
) -> Requests:
    """Of the ``wanted`` (sensors, N) those ``at_most`` with the highest score in each run.

    Equal scores go to the sensor that was silent for longer, then to the first.
    """
    sensors = len(score)
    if at_most is None or at_most >= sensors:
        return wanted
    ranked = np.where(wanted, score, -np.inf)
    order = np.lexsort((-age, -ranked), axis=0)
    chosen = np.zeros_like(wanted)
    np.put_along_axis(chosen, order[:at_most], True, axis=0)
    return chosen & wanted
