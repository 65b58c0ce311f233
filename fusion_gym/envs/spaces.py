"""Spaces of a task, and the way from an action to requests."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.task import Task


def observation_space(layout: ObservationLayout) -> spaces.Box:
    """Box of shape (entries,), float32, with the layout's bounds."""
    return spaces.Box(layout.low, layout.high, dtype=np.float32)


def action_space(task: Task) -> spaces.MultiBinary | spaces.Discrete[Any]:
    """``MultiBinary(sensors)``, or ``Discrete(2**sensors)`` for ``action="discrete"``.

    With ``access="single"`` it is ``Discrete(sensors + 1)``.
    """
    if task.access == "single":
        return spaces.Discrete(task.sensors + 1)
    if task.action == "discrete":
        return spaces.Discrete(2**task.sensors)
    return spaces.MultiBinary(task.sensors)


def requests(task: Task, actions: Any, num_envs: int) -> NDArray[np.bool_]:
    """Requests (sensors, N) from actions (N, sensors) of 0 and 1, or (N,) of whole numbers.

    A whole number holds the requests as bits, or with ``access="single"`` the sensor from 1.

    Raises:
        ValueError: an action of another shape, not finite, or outside the action space.
    """
    try:
        given = np.asarray(actions)
    except ValueError:
        raise ValueError(f"action {actions!r} is not allowed: it must be an array") from None
    single = task.access == "single"
    discrete = task.action == "discrete" or single
    wanted = (num_envs,) if discrete else (num_envs, task.sensors)
    if given.dtype.kind not in "biuf":
        raise ValueError(
            f"action {given.tolist()!r} of type {given.dtype} is not allowed: it must be numbers"
        )
    if given.shape != wanted:
        raise ValueError(f"action of shape {given.shape} is not allowed: it must be {wanted}")
    if discrete:
        high = task.sensors if single else 2**task.sensors - 1
        valid = (given >= 0) & (given <= high) & (given == np.floor(given))
        if not valid.all():
            raise ValueError(f"action {_first(given, valid)} is not allowed: it must be 0..{high}")
        if single:
            return np.arange(1, task.sensors + 1)[:, None] == given
        return (given.astype(np.int64) >> np.arange(task.sensors)[:, None] & 1).astype(np.bool_)
    result = given == 1
    valid = result | (given == 0)
    if not valid.all():
        raise ValueError(f"action {_first(given, valid)} is not allowed: it must be 0 or 1")
    return np.ascontiguousarray(result.T)


def action_masks(task: Task, allowed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which choices of an action are open (N, choices), where sensors (sensors, N) are allowed.

    In the layout of sb3-contrib's MaskablePPO: for ``MultiBinary`` two choices a sensor, silence
    and a request; for ``Discrete`` one a number. A number is closed if any of its requests is.
    """
    sensors, runs = allowed.shape
    if task.access == "single":
        return np.concatenate((np.ones((1, runs), dtype=np.bool_), allowed)).T
    if task.action == "discrete":
        numbers = np.arange(2**sensors)
        bits = (numbers >> np.arange(sensors)[:, None] & 1).astype(np.bool_)
        return np.asarray(~(bits[:, None] & ~allowed[:, :, None]).any(axis=0))
    result = np.ones((runs, sensors, 2), dtype=np.bool_)
    result[..., 1] = allowed.T
    return result.reshape(runs, 2 * sensors)


def _first(given: NDArray[Any], valid: NDArray[np.bool_]) -> str:
    place = tuple(int(i) for i in np.argwhere(~valid)[0])
    return f"{list(place)} = {given[place]}"
