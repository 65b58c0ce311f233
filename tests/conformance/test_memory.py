"""What is remembered is what was measured and heard: nothing else, and never what is hidden."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from broadcasts import ALL, DEAF, PARTLY, Array, Setting, begun, each
from cases import REMOTE, requests
from moments import unseeing
from numpy.typing import NDArray

import fusion_gym
from fusion_gym.arrays import take_runs
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.beliefs import Beliefs, Estimate, OwnBeliefs
from fusion_gym.core.memory import Memory, Owner, Shadows
from fusion_gym.core.task import Task
from fusion_gym.envs.views import SensorView
from fusion_gym.policies.base import Policy
from fusion_gym.policies.registry import make_policy

STEPS, LATE, TIMES = 7, 2, -1.5
OWN_RULES = (
    "value_of_information:threshold=0.003,own=true",
    "value_of_information:threshold=0.02,own=true",
    "estimate_difference:threshold=0.3,own=true",
    "estimate_difference:threshold=1,whitened=true,own=true",
    "kullback_leibler:threshold=0.5,own=true",
)

# --- a sensor knows its own and what it hears ---------------------------------------------------


class Branches(NamedTuple):
    """Runs on one noise. In a group's first run nothing is changed; in each other run one normal
    is, from ``LATE`` on in every step, that reaches the measurements of ``sensor`` alone."""

    sensor: Array
    base: Array
    channel: Array

    @classmethod
    def of(cls, task: Task) -> Branches:
        """As many as the task's system has such channels."""
        channels = task.system.noise_channels
        batch = begun(task, [5] * (channels + 1))
        _turn(batch, np.arange(channels), np.arange(1, channels + 1))
        reached = np.zeros((task.sensors, channels), dtype=np.bool_)
        for _ in range(STEPS):
            measured = np.asarray(batch.signals()["measurement"])
            changed = measured[..., 1:] != measured[..., :1]
            reached |= changed.reshape(task.sensors, -1, channels).any(1)
            batch.step(np.zeros((task.sensors, channels + 1), dtype=np.bool_))
        rows: list[tuple[int, int, int]] = []
        for sensor in range(task.sensors):
            only = np.flatnonzero(reached[sensor] & (reached.sum(0) == 1))
            assert only.size, f"nothing reaches sensor {sensor} alone"
            first = len(rows)
            rows += [(sensor, first, channel) for channel in (-1, *only[:2].tolist())]
        return cls(*np.array(rows).T)

    def batch(self, task: Task) -> EpisodeBatch:
        """Their runs, begun."""
        batch = begun(task, [5] * len(self.sensor))
        changed = np.flatnonzero(self.channel >= 0)
        _turn(batch, self.channel[changed], changed)
        return batch

    def differs(self, value: Array) -> NDArray[np.bool_]:
        """Whose values (sensors, …, N) differ from those in the group's first run (sensors, N)."""
        apart = value != value[..., self.base]
        return np.asarray(apart.reshape(len(value), -1, value.shape[-1]).any(1))

    @property
    def others(self) -> NDArray[np.bool_]:
        """The sensors (sensors, N) whose own measurements are unchanged."""
        return np.arange(self.sensor.max() + 1)[:, None] != self.sensor


def _turn(batch: EpisodeBatch, channels: Array, runs: Array) -> None:
    batch._ring[LATE + 1 :, channels, runs] *= TIMES


def shown(batch: EpisodeBatch, rules: list[Policy]) -> dict[str, Array]:
    """All that sensors have for themselves (sensors, …, N): rows, signals, requests of rules."""
    view, signals = SensorView(batch.task), batch.signals()
    rows = view.rows(batch.observe()).reshape(batch.num_envs, view.rows_per_run, -1)
    found: dict[str, Array] = {"row": rows.transpose(1, 2, 0)}
    found |= {name: np.asarray(signals[name]) for name in ("own_difference", "own_value")}
    return found | {str(rule): rule(signals) for rule in rules}


@each(ALL)
def test_what_others_measured_and_did_not_send_changes_nothing(setting: Setting) -> None:
    """All grants are the same; the sensor's own measurements do change what it is shown."""
    task = setting.task()
    branches, rules = Branches.of(task), [make_policy(rule, task) for rule in OWN_RULES]
    batch, noticed = branches.batch(task), set()
    for step, wanted in enumerate(requests(task, 1, STEPS)):
        for name, value in shown(batch, rules).items():
            differs = branches.differs(value)
            assert not (differs & branches.others).any(), name
            noticed |= {name} if (differs & ~branches.others).any() else set()
        batch.step(wanted & (branches.others | (step < LATE)))
    assert {"row", "own_difference", "own_value"} <= noticed
    assert len(noticed) > 3


@each(DEAF)
def test_who_hears_nothing_knows_nothing_of_others_packets(setting: Setting) -> None:
    task = setting.task()
    branches, rules = Branches.of(task), [make_policy(rule, task) for rule in OWN_RULES]
    batch = branches.batch(task)
    for wanted in requests(task, len(branches.sensor), STEPS):
        for name, value in shown(batch, rules).items():
            assert not (branches.differs(value) & branches.others).any(), name
        batch.step(wanted[:, branches.base])


@each(PARTLY)
def test_who_hears_the_estimate_knows_nothing_else_of_others_packets(setting: Setting) -> None:
    """Told another run's estimate, it believes what it believes there."""
    task = setting.task()
    branches = Branches.of(task)
    batch, told = branches.batch(task), False
    for wanted in requests(task, len(branches.sensor), STEPS):
        heard = batch.beliefs().silent
        deceived = OwnBeliefs(task, batch.state, batch.shadows or Shadows())
        vars(deceived)["silent"] = Estimate(*(part[..., branches.base] for part in heard))
        for value in (deceived.difference, deceived.value(), deceived.best.covariance):
            assert not (branches.differs(value) & branches.others).any()
        told |= bool((branches.differs(heard.mean) & branches.others).any())
        batch.step(wanted[:, branches.base])
    assert told == (task.sensors > 1)


# --- nobody knows what is hidden ----------------------------------------------------------------


def believed(beliefs: Beliefs, owner: Owner) -> list[Array]:
    """All numbers of it."""
    numbers = [beliefs.difference, *beliefs.best, *beliefs.silent, *beliefs.sent]
    for steps in (1, 3) if owner == "coordinator" else (1,):
        numbers += [beliefs.loss(steps), beliefs.value(steps)]
    return numbers if beliefs.arrival is None else [*numbers, beliefs.arrival]


@pytest.mark.parametrize("owner", ["coordinator", "own"])
@each(ALL)
def test_beliefs_do_not_depend_on_the_truth_or_coming_losses(
    setting: Setting, owner: Owner
) -> None:
    task = setting.task()
    batch = begun(task, [0, 1, 2], owner)
    for wanted in requests(task, 3, STEPS):
        blind = batch.memory.beliefs(task.system.visible(batch.state), unseeing(batch))
        seeing = batch.beliefs()
        for one, other in zip(believed(blind, owner), believed(seeing, owner), strict=True):
            assert np.isfinite(other).all()
            np.testing.assert_array_equal(one, other)
        batch.step(wanted)


@pytest.mark.parametrize("channel", ["independent", "gilbert_elliott"])
def test_the_value_of_a_transmission_is_its_mean_over_the_losses(channel: str) -> None:
    """The same values of the sources in many runs, channel and losses drawn in each."""
    runs = 40_000
    task = fusion_gym.make_task(
        REMOTE, sensors=2, channel=channel, initial_deviation=1.0, state_weights=(1.0, 3.0)
    )
    system, draw = task.system, np.random.default_rng(0)
    memory = Memory(task, "coordinator")
    state = system.start(draw.standard_normal((system.start_channels, 1)))
    for step in range(4):
        noise = draw.standard_normal((system.noise_channels, runs))
        noise[:2] = noise[:2, :1]  # those of the sources
        state = system.sense(take_runs(state, np.zeros(runs, dtype=np.int64)), noise)
        beliefs, weights = memory.beliefs(state, Shadows()), np.array([[0.5], [1.5]])
        value = beliefs.value()
        assert (value == value[:, :1]).all()
        truth = system.truth(state)
        for sensor in range(2):
            error = [
                (weights * (truth - system.fused(system.deliver(state, granted))[0]) ** 2).sum(0)
                for granted in (
                    np.zeros((2, runs), dtype=np.bool_),
                    np.arange(2)[:, None] * np.ones((1, runs)) == sensor,
                )
            ]
            gain = error[0] - error[1]
            assert abs(gain.mean() - value[sensor, 0]) < 5.0 * gain.std() / np.sqrt(runs) + 1e-12
        state = system.deliver(state, np.full((2, runs), step == 1))
