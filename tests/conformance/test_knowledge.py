"""Signals are what they are declared to be, and nobody is shown what they cannot know."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from cases import CASES, Case, each_case, requests
from moments import Moment, unseeing
from numpy.typing import NDArray

from fusion_gym.arrays import take_runs
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.observation import Network
from fusion_gym.core.system import Signals, covers
from fusion_gym.core.task import Task
from fusion_gym.envs.views import SensorView

STEPS = 12
# A channel with a state tells the centre of it, whether or not anything is sent.
QUIET = [case for case in CASES if case.options.get("channel") != "gilbert_elliott"]


def read(task: Task, state: Any) -> dict[str, NDArray[Any]]:
    """All signals of a state, withheld ones too."""
    offered = task.system.read(state)
    return {name: np.asarray(Signals(dict(offered))[name]) for name in offered}


@each_case
def test_signals_are_those_declared_with_their_axes(case: Case) -> None:
    runs = 5
    system, batch = case.task().system, case.batch(list(range(runs)))
    assert len({signal.name for signal in system.signals}) == len(system.signals)
    for wanted in requests(case.task(), runs, STEPS):
        found, sizes = read(case.task(), batch.state), {"N": runs, "sensors": system.sensor_count}
        assert found.keys() == {signal.name for signal in system.signals}
        assert len(found["prior_mean"]) <= len(system.state_names)
        for signal in system.signals:
            assert covers("coordinator", signal.knowledge)
            axes = [axis for axis in signal.axes.strip("()").replace(" ", "").split(",") if axis]
            value = found[signal.name]
            assert value.ndim == len(axes), signal.name
            for axis, size in zip(axes, value.shape, strict=True):
                # The letters n and m are one size each, whatever it is.
                fixed = int(axis) if axis.isdigit() else sizes.setdefault(axis, size)
                assert size == fixed, f"{signal.name}: {axis}"
            assert np.isfinite(value).all(), signal.name
        batch.step(wanted)


@each_case
def test_withheld_signals_are_those_of_the_sensors(case: Case) -> None:
    task, batch = case.task(), case.batch([0, 1])
    shown, withheld = set(batch.signals()), set()
    for signal in task.system.signals:
        if covers(task.knowledge, signal.knowledge):
            assert signal.name in shown
        else:
            withheld.add(signal.name)
    assert withheld.isdisjoint(shown)
    sees_all = task.information == "sensors"
    assert ("model" in shown) is sees_all
    assert bool(withheld) is not sees_all


@each_case
def test_nothing_shown_depends_on_the_truth(case: Case) -> None:
    """What is hidden is gone from the visible state, and nobody notices."""
    runs = 3
    system, batch = case.task().system, case.batch(list(range(runs)))
    for wanted in requests(case.task(), runs, 6):
        state = system.visible(batch.state)
        measured_exactly = np.array_equal(system.truth(state), system.truth(batch.state))
        assert measured_exactly or np.isnan(system.truth(state)).all()
        found = read(case.task(), state)
        for name, value in read(case.task(), batch.state).items():
            np.testing.assert_array_equal(found[name], value, err_msg=name)
        blind = batch.memory.beliefs(state, unseeing(batch))
        seen = batch.layout.encode(state, _network(batch), lambda blind=blind: blind)
        np.testing.assert_array_equal(seen, batch.observe())
        nobody = np.zeros_like(wanted)
        for granted in (wanted, nobody):
            seen = system.fused(system.deliver(state, granted))
            full = system.fused(system.deliver(batch.state, granted))
            lost = getattr(batch.state, "lost", nobody)
            for one, other in zip(seen, full, strict=True):
                assert np.isfinite(one).all()
                kept = ~(lost & granted).any(0)
                np.testing.assert_array_equal(one[..., kept], other[..., kept])
        batch.step(wanted)


@each_case
def test_whoever_is_shown_something_can_know_it(case: Case) -> None:
    """One normal of the coming step is changed at a time.

    Where it changes the new measurement of a single sensor, nobody else's view changes, and the
    centre's not at all; each sensor's view changes with its own measurement somewhere, if some
    normal is its alone. Where the nodes are told nothing of the state, not even a delivery changes
    another sensor's view later.
    """
    task = case.task()
    system, view = task.system, None if case.not_local else SensorView(task)
    batch = case.batch([3], owner=None if view is None else view.owner)
    told = any(block.node == "told" for block in system.observation)
    told |= task.broadcast != "none" and bool(task.memory or task.belief_features)
    noticed = np.zeros(task.sensors, dtype=np.bool_)
    able = noticed.copy()
    before = Moment.start(batch, np.random.default_rng(0))
    draw, channels = np.random.default_rng(1), system.noise_channels
    for wanted in requests(task, 1, STEPS):
        # Run 0 as drawn, run c + 1 with another normal in channel c.
        noise = np.repeat(draw.standard_normal((channels, 1)), channels + 1, axis=1)
        noise[np.arange(channels), np.arange(1, channels + 1)] *= -1.5
        moment = before.repeated(channels + 1).sensed(noise)
        signals = read(case.task(), moment.state)
        measured = _changed(signals["measurement"]).reshape(task.sensors, -1, channels).any(1)
        alone = measured.sum(0) == 1
        for signal in system.signals:
            changed = _changed(signals[signal.name])
            if signal.knowledge in ("clock", "centre"):
                assert not changed.any(), signal.name
            elif signal.axes.startswith("(sensors"):
                by_sensor = changed.reshape(task.sensors, -1, channels).any(1)
                assert not (by_sensor & ~measured)[:, alone].any(), signal.name
        if view is not None:
            changed = _changed_rows(view, moment.observed())
            assert not (changed & ~measured)[:, alone].any()
            noticed |= (changed & measured)[:, alone].any(1)
            able |= measured[:, alone].any(1)
            everyone = np.ones((task.sensors, channels + 1), dtype=np.bool_)
            later = moment.delivered(everyone).sensed(noise[:, :1] * everyone[:1])
            changed = _changed_rows(view, later.observed())
            # a normal of the sensor, not the plant
            alone &= ~_changed(system.truth(later.state)).any(0)
            assert told or not (changed & ~measured)[:, alone].any()
        elif task.information == "centre":
            assert not _changed(moment.observed().T).any()
        before = moment.first().delivered(wanted)
    assert view is None or (able.any() and noticed[able].all())


@pytest.mark.parametrize("case", QUIET, ids=str)
def test_silence_tells_the_centre_nothing(case: Case) -> None:
    """Other noises, the same silence: what the centre knows is the same, measurements are not."""
    system, runs = case.task().system, 4
    draw = np.random.default_rng(2)
    first = draw.standard_normal((system.start_channels, 1))
    state = take_runs(system.start(first), np.zeros(runs, dtype=np.int64))
    moved = np.zeros(system.sensor_count, dtype=np.bool_)
    for _ in range(STEPS):
        state = system.sense(state, draw.standard_normal((system.noise_channels, runs)))
        signals = read(case.task(), state)
        for signal in system.signals:
            if signal.knowledge in ("clock", "centre"):
                assert not _changed(signals[signal.name]).any(), signal.name
        for block in system.observation:
            if block.knowledge in ("clock", "centre"):
                assert not _changed(block.fill(state)).any(), block.name
        moved |= _changed(signals["measurement"]).reshape(system.sensor_count, -1).any(1)
        state = system.deliver(state, np.zeros((system.sensor_count, runs), dtype=np.bool_))
    assert moved.all()


def _changed(value: NDArray[Any]) -> NDArray[np.bool_]:
    """Where the later runs differ from run 0."""
    return np.asarray(value[..., 1:] != value[..., :1])


def _changed_rows(view: SensorView, observation: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which sensors' rows (sensors, later runs) differ from run 0's."""
    rows = view.rows(observation).reshape(len(observation), view.rows_per_run, -1)
    return _changed(rows.transpose(1, 2, 0)).any(1)


def _network(batch: EpisodeBatch) -> Network:
    return Network(batch.tokens, batch.admitted, batch.price, batch.task.horizon - batch.steps)
