"""Views of a batch: one row per decision, of a scheduler or of every local sensor.

A view turns observations into rows. Its attributes are ``names`` of the entries, ``space``
(float32) of a row, ``action`` (:class:`~fusion_gym.core.action.Action`), ``rows_per_run`` (adjacent
rows of a run), ``knowledge`` (class of a row), ``local`` (whether each row belongs to a sensor) and
``owner`` (of the batch's memory, or ``None``).
"""

from __future__ import annotations

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.core.action import Action, OwnBit
from fusion_gym.core.knowledge import Knowledge
from fusion_gym.core.memory import Owner
from fusion_gym.core.observation import ObservationEntry, ObservationLayout
from fusion_gym.core.task import Task
from fusion_gym.errors import ConfigurationError, refusal

Rows = NDArray[np.float32]
LARGEST_RATIO = 6.0  # of a rule's log ratios, as entries of an observation


class SchedulerView:
    """One row per run: the task's observation, and an action for all sensors."""

    rows_per_run, local = 1, False
    owner: Owner | None = None

    def __init__(self, task: Task) -> None:
        layout = ObservationLayout(task)
        self.knowledge = task.knowledge
        self.names = layout.names
        self.space = spaces.Box(layout.low, layout.high, dtype=np.float32)
        self.action = task.action

    def rows(self, observation: Rows) -> Rows:
        """Return the observations unchanged."""
        return observation


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
        self.knowledge: Knowledge = "own_memory" if task.options.memory else "own"
        self.owner: Owner | None = "own" if task.options.memory or task.belief_features else None
        if task.options.packet == "estimate":
            allowed = "'measurement', because the estimate belongs to the scheduler"
            raise refusal("packet", "estimate", allowed, "with a local view")
        if task.options.information != "sensors":
            allowed = "'sensors', because a sensor uses its own measurement"
            raise refusal("information", task.options.information, allowed, "with a local view")
        if task.options.action in ("assignment", "threshold"):
            allowed = "'binary', because this is an action of the scheduler"
            raise refusal("action", task.options.action, allowed, "with a local view")
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
        shown = count if task.options.own_number else 0
        self._identity = np.eye(count, dtype=np.float32)[:, :shown]
        identity = [f"sensor[{sensor}]" for sensor in range(self._identity.shape[1])]
        self.names = (*names[0], *(layout.names[place] for place in received), *identity)
        low = np.concatenate((layout.low[columns[0]], np.zeros_like(self._identity[0])))
        high = np.concatenate((layout.high[columns[0]], np.ones_like(self._identity[0])))
        self.space = spaces.Box(low, high, dtype=np.float32)
        self.action: Action = OwnBit(count)

    def rows(self, observation: Rows) -> Rows:
        """Return rows (N·sensors, entries) of observations (N, entries of the scheduler)."""
        observed = observation[:, self._columns]
        shared = np.broadcast_to(self._identity, (len(observation), *self._identity.shape))
        return np.concatenate((observed, shared), axis=-1).reshape(-1, len(self.names))


View = SchedulerView | SensorView


def make_view(task: Task, local: bool = False) -> View:
    """Return the scheduler's view of a task, or the sensors' view with ``local``."""
    return SensorView(task) if local else SchedulerView(task)


def append_ratios(rows: Rows, ratios: Array) -> Rows:
    """Return the rows (N·rows_per_run, entries) followed by a rule's log ratios (N, sensors)."""
    column = np.clip(ratios, -LARGEST_RATIO, LARGEST_RATIO).reshape(len(rows), -1)
    return np.concatenate((rows, column.astype(np.float32)), axis=1)


def space_with_ratios(view: View, rule: bool) -> spaces.Box:
    """Return the space of a view's rows, with a rule's log ratios behind them."""
    if not rule:
        return view.space
    ends = np.full(view.action.sensors // view.rows_per_run, LARGEST_RATIO, np.float32)
    low, high = np.append(view.space.low, -ends), np.append(view.space.high, ends)
    return spaces.Box(low, high, dtype=np.float32)


def is_received(entry: ObservationEntry, broadcast: str | None) -> bool:
    """Return whether every sensor observes an entry."""
    received = {"none": False, "estimate": entry.centre and entry.sensor is None}
    return entry.broadcast or received.get(broadcast or "", entry.centre)
