"""A shadow is a run of its own, in which more is delivered; what is believed follows from it."""

from __future__ import annotations

import copy
import dataclasses
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from broadcasts import ALL, WITH, Array, Setting, begun, each
from cases import requests
from meanings import Seen, arrival

from fusion_gym.arrays import take_runs
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.memory import Owner, Shadows
from fusion_gym.core.signals import MEMORY_SIGNALS
from fusion_gym.core.system import SignalError
from fusion_gym.core.task import Task
from fusion_gym.envs.views import SensorView
from fusion_gym.fusion.intersection import covariance_intersection

STEPS, LATE = 8, 3


def same(one: Any, other: Any) -> None:
    """Bitwise, through dataclasses and tuples."""
    assert type(one) is type(other)
    if dataclasses.is_dataclass(one):
        for field in dataclasses.fields(one):
            same(getattr(one, field.name), getattr(other, field.name))
    elif isinstance(one, tuple):
        for first, second in zip(one, other, strict=True):
            same(first, second)
    elif one is not None:
        np.testing.assert_array_equal(one, other, strict=True)


def of_sensor(shadow: Any, sensor: int, runs: int) -> Any:
    """The runs of one sensor."""
    return take_runs(shadow, sensor * runs + np.arange(runs))


class Company:
    """A batch and others on the same seeds, which end and begin their episodes with it."""

    def __init__(self, task: Task, owner: Owner, horizon: int = 4) -> None:
        self.task, self.seeds = task, [3, 4, 5, 6]
        self.batch = begun(task, self.seeds, owner)
        self.batch.reset(stagger=True)
        self.others: list[tuple[EpisodeBatch, Callable[[Array], Array]]] = []

    def add(self, system: Any, asked: Callable[[Array], Array]) -> EpisodeBatch:
        """One of this system; ``asked`` (sensors, N) follows from what the batch is granted."""
        plain = dataclasses.replace(
            self.task, system=system, memory=False, shadow=None, packet="measurement"
        )
        other = begun(plain, self.seeds, "coordinator")
        other.reset(stagger=True)
        self.others.append((other, asked))
        return other

    def step(self, wanted: Array) -> None:
        """All move on; what ended begins anew."""
        outcome = self.batch.step(wanted)
        for other, asked in self.others:
            other.step(asked(outcome.granted))
        if outcome.ended.any():
            for batch in (self.batch, *(other for other, _ in self.others)):
                batch.reset(np.flatnonzero(outcome.ended))


@each(WITH)
def test_the_coordinators_shadow_is_a_run_in_which_everything_is_delivered(
    setting: Setting,
) -> None:
    task = setting.task(horizon=4)
    company = Company(task, "coordinator")
    if task.shadow is None:
        assert company.batch.shadows is None
        return
    whole = company.add(task.shadow, lambda granted: granted | True)
    for wanted in requests(task, 4, STEPS):
        shadows: Any = company.batch.shadows
        same(shadows.every, whole.state)
        assert shadows.own is shadows.alone is None
        company.step(wanted)


class Alone:
    """Of every sensor the runs from which what it believes follows, made without a memory."""

    def __init__(self, setting: Setting) -> None:
        self.task = setting.task(horizon=4)
        self.company, sensors = Company(self.task, "own"), range(self.task.sensors)
        packets = setting.broadcast == "packets"
        self.own: list[EpisodeBatch] = []
        self.alone: list[EpisodeBatch] = []
        for itself in (np.arange(self.task.sensors)[:, None] == sensor for sensor in sensors):
            if self.task.shadow is not None:
                self.own.append(
                    self.company.add(
                        self.task.shadow,
                        lambda granted, itself=itself: (granted & packets) | itself,
                    )
                )
            if not (self.task.feedback or packets):
                self.alone.append(
                    self.company.add(
                        self.task.system, lambda granted, itself=itself: granted & itself
                    )
                )

    def estimates(self, sensor: int) -> tuple[Array, Array, Array]:
        """x*, x̂ and x̂(s) (n, N) as this sensor knows them."""
        batch, task, told = self.company.batch, self.task, self.task.broadcast
        centre = self.alone[sensor] if told == "none" else batch
        silent = after(task.system, centre.state)
        knower = self.alone[sensor] if self.alone else batch
        sent = after(task.system, knower.state, sensor)
        if told == "estimate" and not task.feedback:
            sent = joined(silent, sent)
        best = sent
        if self.own:
            assert task.shadow is not None
            best = after(task.shadow, self.own[sensor].state, sensor)
            if told == "estimate":
                best = joined(sent if task.feedback else silent, best)
        return best[0], silent[0], sent[0]


def after(system: Any, state: Any, *sensors: int) -> tuple[Array, Array]:
    """The centre's mean and covariance after these packets, none of which is lost."""
    if hasattr(state, "lost"):
        state = dataclasses.replace(state, lost=np.zeros_like(state.lost))
    granted = np.zeros((system.sensor_count, system.truth(state).shape[-1]), dtype=np.bool_)
    granted[list(sensors)] = True
    found: tuple[Array, Array] = system.fused(system.deliver(state, granted))
    return found


def joined(one: tuple[Array, Array], other: tuple[Array, Array]) -> tuple[Array, Array]:
    """By covariance intersection."""
    fused = covariance_intersection(*one, *other)
    return fused.mean, fused.covariance


@each(ALL)
def test_a_sensors_shadows_are_runs_of_what_it_measured_and_heard(setting: Setting) -> None:
    runs = Alone(setting)
    for wanted in requests(runs.task, 4, STEPS):
        shadows = runs.company.batch.shadows or Shadows()
        assert (shadows.own is not None) == bool(runs.own)
        assert (shadows.alone is not None) == bool(runs.alone)
        for kept, own in ((shadows.own, runs.own), (shadows.alone, runs.alone)):
            for sensor, batch in enumerate(own):
                same(of_sensor(kept, sensor, 4), batch.state)
        runs.company.step(wanted)


@each(ALL)
def test_a_sensors_entries_hold_what_their_names_say(setting: Setting) -> None:
    """Signals, and the entries of its row."""
    runs = Alone(setting)
    task, view = runs.task, SensorView(runs.task)
    weights = task.reward.state_weights / task.reward.state_weights.mean()
    spread = task.system.open_loop(task.horizon)[:, None]
    for wanted in requests(task, 4, STEPS):
        batch = runs.company.batch
        signals, rows = batch.signals(), view.rows(batch.observe())
        for sensor in range(task.sensors):
            best, silent, sent = runs.estimates(sensor)
            apart, far = best - silent, (weights * (best - silent) ** 2).sum(0)
            chance = np.broadcast_to(arrival(Seen.of(batch)), (task.sensors, 4))[sensor]
            value = chance * (far - (weights * (best - sent) ** 2).sum(0))
            close(signals["own_difference"][sensor], apart)
            close(signals["own_value"][sensor], value)
            if not task.memory:
                continue
            row = dict(zip(view.names, rows[sensor :: task.sensors].T, strict=True))
            for name, one in zip(task.system.state_names, apart / np.sqrt(spread), strict=True):
                shown = np.sign(one) * np.log(4 * abs(one) + np.sqrt(16 * one * one + 1))
                close(row[f"own_difference[{name}]"], np.clip(shown, -10, 10), 1e-6)
            for name, one in (("nobody", far), ("itself", value)):
                shown = 2 * np.sign(one) * np.sqrt(abs(one) / (weights * spread).sum())
                close(row[f"own_value[{name}]"], np.clip(shown, -20, 20), 1e-6)
        runs.company.step(wanted)


@pytest.mark.parametrize("owner", ["coordinator", "own"])
@each(WITH)
def test_what_is_believed_is_offered_to_whom_it_is_kept_for(setting: Setting, owner: Owner) -> None:
    """With the axes that are declared; the others' is missed by name."""
    task = setting.task()
    signals = begun(task, [1, 2], owner).signals()
    sizes = {"N": 2, "sensors": task.sensors, "n": len(task.system.state_names)}
    for signal in MEMORY_SIGNALS:
        theirs = signal.knowledge == f"{owner}_memory"
        assert (signal.name in set(signals)) == (signal.name in signals) == theirs
        if theirs:
            axes = signal.axes.strip("()").split(", ")
            assert signals[signal.name].shape == tuple(sizes[axis] for axis in axes)
            continue
        with pytest.raises(SignalError, match=rf"'{signal.name}' .* remember = 'coordinator'"):
            signals[signal.name]


def close(found: Array, expected: Array, size: float = 1e-9) -> None:
    """To rounding."""
    np.testing.assert_allclose(found, expected, rtol=size, atol=size)


@pytest.mark.parametrize("name", ["markov", "remote, losses"])
def test_where_nodes_remember_already_a_shadow_changes_nothing(name: str) -> None:
    """To the last digit."""
    task = Setting(name, "none", True).task()
    assert task.shadow is None
    shadowed = dataclasses.replace(task, shadow=task.system)
    plain, other = (begun(one, [0, 1, 2], "coordinator") for one in (task, shadowed))
    for wanted in requests(task, 3, STEPS):
        assert other.shadows is not None
        for signal in ("belief_difference", "transmission_value"):
            np.testing.assert_array_equal(plain.signals()[signal], other.signals()[signal])
        np.testing.assert_array_equal(plain.observe(), other.observe())
        plain.step(wanted)
        other.step(wanted)


@pytest.mark.parametrize("owner", ["coordinator", "own"])
@each(WITH)
def test_a_run_that_remembers_is_the_same_alone_copied_and_restored(
    setting: Setting, owner: Owner
) -> None:
    task = setting.task()
    together, alone = begun(task, [7, 8, 9], owner), begun(task, [8], owner)
    wanted = requests(task, 3, STEPS)
    for step, asked in enumerate(wanted):
        np.testing.assert_array_equal(together.observe()[1], alone.observe()[0], strict=True)
        if step == LATE:
            together.reset(np.array([0, 2]))
            copies = [copy.deepcopy(together), pickle.loads(pickle.dumps(together))]
            kept = together.snapshot()
        together.step(asked)
        alone.step(asked[:, 1:2])
    for other in (*copies, together):
        if other is together:
            last = together.observe()
            together.restore(kept)
        for asked in wanted[LATE:]:
            other.step(asked)
    for other in (*copies, together):
        np.testing.assert_array_equal(other.observe(), last)
