"""Views of a batch: one row per decision, of a scheduler or of every local sensor.

A view turns observations into rows and actions into requests. Its attributes are ``names`` of the
entries, ``space`` (float32) of a row, ``actions`` (the action space), ``rows_per_run`` (adjacent
rows of a run), ``knowledge`` (class of a row), ``local`` (whether each row belongs to a sensor) and
``owner`` (of the batch's memory, or ``None``).
"""

from __future__ import annotations

import sys
from typing import Any, TypeAlias

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from fusion_gym.core.access import channel_requests
from fusion_gym.core.knowledge import Knowledge
from fusion_gym.core.memory import Owner
from fusion_gym.core.observation import ObservationEntry, ObservationLayout
from fusion_gym.core.task import Task
from fusion_gym.errors import ConfigurationError, display, refusal

_ONE = np.array(1, np.int8)  # which NumPy compares in half the time of a Python number
Rows = NDArray[np.float32]
Requests = NDArray[np.bool_]
Actions: TypeAlias = "spaces.MultiBinary | spaces.MultiDiscrete | spaces.Discrete[Any]"


class SchedulerView:
    """One row per run: the task's observation, and a decision for all sensors.

    The action space is ``MultiBinary(sensors)``, with ``action="multidiscrete"``
    ``MultiDiscrete([2] * sensors)``. With ``action="discrete"`` it is ``Discrete(2**sensors)`` for
    the number Σ u_m 2^m, and with ``access="single"`` it is ``Discrete(sensors + 1)``: 0 is no
    request, m is sensor m - 1. With ``action="assignment"`` it is that number for each channel,
    ``MultiDiscrete([sensors + 1] * channels)``.
    """

    rows_per_run, local = 1, False
    owner: Owner | None = None

    def __init__(self, task: Task) -> None:
        layout = ObservationLayout(task)
        self.knowledge = task.knowledge
        self.names = layout.names
        self.space = spaces.Box(layout.low, layout.high, dtype=np.float32)
        self._sensors, self._single = task.sensors, task.network.access == "single"
        self._channels = task.network.slots if task.action == "assignment" else 0
        self.actions: Actions = spaces.MultiBinary(task.sensors)
        if self._single:
            self.actions = spaces.Discrete(task.sensors + 1)
        elif task.action == "discrete":
            self.actions = spaces.Discrete(2**task.sensors)
        elif task.action == "multidiscrete":
            self.actions = spaces.MultiDiscrete([2] * task.sensors)
        elif self._channels:
            self.actions = spaces.MultiDiscrete([task.sensors + 1] * self._channels)

    def rows(self, observation: Rows) -> Rows:
        """Return the observations unchanged."""
        return observation

    def requests(self, actions: Any, runs: int | None) -> NDArray[Any]:
        """Return the requests (sensors, N) of actions (N, sensors) or (N,), or assigned channels.

        Args:
            actions: Actions of N runs, or of one run without the axis N.
            runs: Number N of runs; ``None`` is one run without the axis N.

        Raises:
            ValueError: The actions have another shape, are not finite, or are not in the action
                space.
        """
        shape = self.actions.shape or ()
        array = _numbers(actions, shape if runs is None else (runs, *shape))
        if self._channels:
            _whole(array, self._sensors)
            return channel_requests(array.reshape(-1, *shape).T, self._sensors)
        if not isinstance(self.actions, spaces.Discrete):
            return np.ascontiguousarray(_bits(array).reshape(-1, self._sensors).T)
        _whole(array, int(self.actions.n) - 1)
        return self._decoded(array.astype(np.int64).reshape(-1))

    def masks(self, allowed: Requests) -> NDArray[np.bool_]:
        """Return the allowed choices (N, choices) in the layout of sb3-contrib's MaskablePPO.

        ``MultiBinary`` and ``MultiDiscrete`` have two choices per sensor, silence and a request.
        ``Discrete`` has one choice per number, which is allowed if all its requests are. An
        assignment has for each channel nobody and every sensor.

        Args:
            allowed: (sensors, N), whether the sensor may request.
        """
        if isinstance(self.actions, spaces.Discrete):
            requested = self._decoded(np.arange(self.actions.n))
            return np.asarray(~(requested[:, None] & ~allowed[:, :, None]).any(axis=0))
        if self._channels:
            open_ = np.insert(allowed, 0, values=True, axis=0).T
            return np.tile(open_, self._channels)
        result = np.ones((allowed.shape[1], self._sensors, 2), dtype=np.bool_)
        result[..., 1] = allowed.T
        return result.reshape(len(result), -1)

    def _decoded(self, numbers: NDArray[np.int64]) -> Requests:
        """Return the requests (sensors, …) of whole numbers."""
        sensors = np.arange(self._sensors)[:, None]
        return numbers == sensors + 1 if self._single else (numbers >> sensors & 1).astype(np.bool_)


class SensorView:
    """One row per sensor and run: the observation of a local sensor, and its own decision.

    A sensor observes the entries of its own node, the broadcast entries (token level, price, an
    estimate that the centre feeds back) and, with ``own_number``, its own number. With
    ``broadcast="estimate"`` it also observes the centre's estimate, and with ``"packets"``
    everything that the centre knows.

    Row ``run * sensors + sensor`` belongs to that sensor; ``names`` omit the sensor's index. The
    action space is ``Discrete(2)``, in which 1 is a request, so one policy serves all sensors.

    Args:
        task: The task.

    Raises:
        ConfigurationError: The task has ``information="centre"``, ``packet="estimate"``, or sensors
            with different kinds of entries.
    """

    local = True

    def __init__(self, task: Task) -> None:
        self.knowledge: Knowledge = "own_memory" if task.memory else "own"
        self.owner: Owner | None = "own" if task.memory or task.belief_features else None
        if task.packet == "estimate":
            allowed = "'measurement', because the estimate belongs to the scheduler"
            raise refusal("packet", "estimate", allowed, "with a local view")
        if task.information != "sensors":
            allowed = "'sensors', because a sensor uses its own measurement"
            raise refusal("information", task.information, allowed, "with a local view")
        if task.action == "assignment":
            allowed = "'binary', because the scheduler assigns channels"
            raise refusal("action", task.action, allowed, "with a local view")
        layout, count = ObservationLayout(task, "own"), task.sensors
        received = [
            p for p, entry in enumerate(layout.entries) if is_received(entry, task.broadcast)
        ]
        columns, names = [], []
        for sensor in range(count):
            own = [place for place, entry in enumerate(layout.entries) if entry.sensor == sensor]
            columns.append(own + received)
            names.append([layout.entries[place].own_name for place in own])
        if any(kinds != names[0] for kinds in names):
            raise ConfigurationError(
                f"observation entries {names} are not allowed in a local view: all sensors must "
                "have the same kinds of entries"
            )
        self._columns = np.array(columns)
        self.rows_per_run = count
        # One-hot number of the sensor: (sensors, sensors), or (sensors, 0) without it.
        self._identity = np.eye(count, dtype=np.float32)[:, : count if task.own_number else 0]
        identity = [f"sensor[{sensor}]" for sensor in range(self._identity.shape[1])]
        self.names = (*names[0], *(layout.names[place] for place in received), *identity)
        low = np.concatenate((layout.low[columns[0]], np.zeros_like(self._identity[0])))
        high = np.concatenate((layout.high[columns[0]], np.ones_like(self._identity[0])))
        self.space = spaces.Box(low, high, dtype=np.float32)
        self.actions: spaces.Discrete[Any] = spaces.Discrete(2)

    def rows(self, observation: Rows) -> Rows:
        """Return rows (N·sensors, entries) of observations (N, entries of the scheduler)."""
        observed = observation[:, self._columns]
        shared = np.broadcast_to(self._identity, (len(observation), *self._identity.shape))
        return np.concatenate((observed, shared), axis=-1).reshape(-1, len(self.names))

    def requests(self, actions: Any, runs: int | None) -> Requests:
        """Return the requests (sensors, N) of actions (N·sensors,), in which 1 is a request."""
        values = _numbers(actions, ((1 if runs is None else runs) * self.rows_per_run,))
        return np.ascontiguousarray(_bits(values).reshape(-1, self.rows_per_run).T)

    def masks(self, allowed: Requests) -> NDArray[np.bool_]:
        """Return the allowed choices (N·sensors, 2): silence and a request."""
        return np.stack((np.ones(allowed.size, dtype=np.bool_), allowed.T.ravel()), axis=1)


View = SchedulerView | SensorView


def make_view(task: Task, local: bool = False) -> View:
    """Return the scheduler's view of a task, or the sensors' view with ``local``."""
    return SensorView(task) if local else SchedulerView(task)


def space_text(space: spaces.Space[Any]) -> str:
    """Return a space as Gymnasium writes it, in one line and with all its numbers."""
    with np.printoptions(threshold=sys.maxsize, linewidth=sys.maxsize):
        return str(space)


def is_received(entry: ObservationEntry, broadcast: str) -> bool:
    """Return whether every sensor observes an entry."""
    received = {"none": False, "estimate": entry.centre and entry.sensor is None}
    return entry.broadcast or received.get(broadcast, entry.centre)


def _numbers(actions: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return the actions as a numeric array of this shape, or raise a ``ValueError``."""
    try:
        values = np.asarray(actions)
    except ValueError:
        values = np.array(None)
    if values.dtype.kind not in "biuf":
        raise ValueError(
            f"action {display(actions)} is not allowed: it must be numbers of shape {shape}, not "
            f"{type(actions).__name__} of {values.dtype}"
        )
    if values.shape != shape:
        raise ValueError(
            f"action {display(values)} of shape {values.shape} is not allowed: its shape must be "
            f"{shape}"
        )
    return values


def _bits(values: NDArray[Any]) -> Requests:
    """Return where the actions are 1; the others must be 0."""
    requests: Requests = values == _ONE
    if np.count_nonzero(requests) < np.count_nonzero(values):
        _check(values, requests | (values == 0), "0 or 1")
    return requests


def _whole(values: NDArray[Any], high: int) -> None:
    """Check that the actions are whole numbers from 0 to ``high``."""
    valid = (values >= 0) & (values <= high) & (values == np.floor(values))
    _check(values, valid, f"0..{high}")


def _check(values: NDArray[Any], valid: NDArray[np.bool_], allowed: str) -> None:
    if not valid.all():
        place = tuple(int(i) for i in np.argwhere(~valid)[0])
        where = f"action {list(place)}" if place else "action"
        raise ValueError(f"{where} = {values[place]} is not allowed: it must be {allowed}")
