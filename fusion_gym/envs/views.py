"""What each sensor can see by itself: the honest view for policies without a coordinator."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.task import Task
from fusion_gym.validation import ConfigurationError


class LocalView:
    """Every sensor's part of a coordinator's observation.

    A sensor sees the entries that its own node knows, what all nodes are told (the token level,
    the price, an estimate that is fed back) and its own number. ``names`` has one name an entry,
    without the sensor's index; ``low`` and ``high`` (entries,) float32 are its bounds.

    Raises:
        ConfigurationError: a task whose information is not "sensors", or whose sensors do not see
            the same kinds of entries.
    """

    def __init__(self, task: Task) -> None:
        if task.information != "sensors":
            raise ConfigurationError(
                f"information = {task.information!r} is not allowed with a local view: it must be "
                "'sensors', for a sensor sees its own measurement"
            )
        layout = ObservationLayout(task)
        self.sensors = task.sensors
        shared = [i for i, entry in enumerate(layout.entries) if entry.broadcast]
        columns, names = [], []
        for sensor in range(task.sensors):
            own = [i for i, entry in enumerate(layout.entries) if entry.sensor == sensor]
            columns.append(own + shared)
            names.append([_without(sensor, layout.names[i]) for i in own])
        if any(kinds != names[0] for kinds in names):
            raise ConfigurationError(
                f"observation entries {names} are not allowed in a local view: all sensors must "
                "see the same kinds"
            )
        self._columns = np.array(columns)
        identity = [f"sensor[{sensor}]" for sensor in range(task.sensors)]
        self.names = (*names[0], *(layout.names[i] for i in shared), *identity)
        zeros, ones = np.zeros(task.sensors), np.ones(task.sensors)
        self.low = np.concatenate((layout.low[self._columns[0]], zeros)).astype(np.float32)
        self.high = np.concatenate((layout.high[self._columns[0]], ones)).astype(np.float32)

    @property
    def space(self) -> spaces.Box:
        """Box of shape (entries,), float32."""
        return spaces.Box(self.low, self.high, dtype=np.float32)

    def rows(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """One row for each sensor of each run: (N, coordinator's entries) to (N·sensors, entries).

        Row run · sensors + sensor belongs to that sensor of that run.
        """
        runs, entries = len(observation), len(self.names)
        result = np.zeros((runs, self.sensors, entries), dtype=np.float32)
        result[..., : self._columns.shape[1]] = observation[:, self._columns]
        result[..., self._columns.shape[1] :] = np.eye(self.sensors, dtype=np.float32)
        return result.reshape(runs * self.sensors, entries)

    def requests(self, actions: NDArray[Any]) -> NDArray[np.bool_]:
        """Requests (sensors, N) from the rows' actions (N·sensors,), 1 for a request.

        Raises:
            ValueError: actions of another shape, or other than 0 and 1.
        """
        given = np.asarray(actions)
        if given.ndim != 1 or given.size % self.sensors or not np.isin(given, (0, 1)).all():
            raise ValueError(
                f"actions of shape {given.shape} are not allowed: there must be one of 0 and 1 "
                f"for each of {self.sensors} sensors of each run"
            )
        return np.ascontiguousarray((given == 1).reshape(-1, self.sensors).T)

    @staticmethod
    def action_masks(allowed: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Open choices (N·sensors, 2) where sensors (sensors, N) are allowed to request."""
        return np.stack((np.ones(allowed.size, dtype=np.bool_), allowed.T.ravel()), axis=1)


def _without(sensor: int, name: str) -> str:
    """``kind[sensor,place]`` as ``kind[place]``, ``kind[sensor]`` as ``kind``."""
    kind, _, inner = name.partition("[")
    places = inner.rstrip("]").split(",")
    return kind if places == [str(sensor)] else f"{kind}[{','.join(places[1:])}]"
