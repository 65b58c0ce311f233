"""A seed fixes an episode's noise: whatever is done, however long the one before it was."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest
from cases import CASES, Case, actions, each_default, each_lasting, requests
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.system import Signals
from fusion_gym.envs.vector import FusionVectorEnv

LONG = 530  # more than two blocks of noise
DRAWING = [case for case in CASES if not case.number or case.options.get("access") == "random"]
each_stream = pytest.mark.parametrize("case", DRAWING, ids=str)


class Latent(NamedTuple):
    """What no policy can change: the normals, the truth, the price and who may speak.

    And what is measured, if something is.
    """

    noise: NDArray[np.float64]
    truth: NDArray[np.float64]
    price: NDArray[np.float64]
    admitted: NDArray[np.bool_]
    measurement: NDArray[np.float64]


def latent(batch: EpisodeBatch) -> Latent:
    """Copies of a batch's, before a step."""
    system = batch.task.system
    signals = Signals(dict(system.read(batch.state)))
    measured = np.moveaxis(np.array(signals["measurement"]), 1, 0)
    if "sampled" in set(signals):
        measured = np.where(signals["sampled"], measured, 0.0)
    return Latent(
        batch.noise().copy(),
        system.truth(batch.state).copy(),
        batch.price.copy(),
        batch.admitted().copy(),
        measured,
    )


def same(one: Latent, other: Latent, runs: Any = slice(None)) -> None:
    """Bitwise, in the given runs."""
    for name, first, second in zip(one._fields, one, other, strict=True):
        np.testing.assert_array_equal(first[..., runs], second[..., runs], name)


@each_lasting
def test_noise_is_the_same_whatever_is_asked(case: Case) -> None:
    """Over three episodes of unequal length: the vector environment resets runs early."""
    silent, busy = (FusionVectorEnv(case.task(12), 3, AutoresetMode.DISABLED) for _ in range(2))
    task, episodes = silent.task, np.ones(3, dtype=np.int64)
    for env in (silent, busy):
        env.reset(seed=20)
    errors = np.zeros((2, 3))
    for step, wanted in enumerate(requests(task, 3, 22, rate=0.6)):
        same(latent(silent.batch), latent(busy.batch))
        ended = np.zeros(3, dtype=np.bool_)
        for place, (env, asked) in enumerate(((silent, wanted & False), (busy, wanted))):
            *_, terminated, truncated, info = env.step(actions(task, asked))
            ended = terminated | truncated
            errors[place] += info["squared_error"].sum(1)
        begin = ended | np.array([step in (3, 9), step in (6, 7), step == 15])
        episodes += begin
        if begin.any():
            for env in (silent, busy):
                env.reset(options={"reset_mask": begin.copy()})
    assert episodes.min() >= 3
    assert (errors[0] != errors[1]).all()


@each_stream
def test_noise_is_the_generators_own_stream_and_never_repeated(case: Case) -> None:
    """Two runs, the second one late, each from its own generator without a gap or a repetition."""
    batch = case.batch([11, 12], LONG)
    task, late = batch.task, 100
    channels = task.system.noise_channels
    rows = np.zeros((LONG + 1, channels, 2))
    nobody = np.zeros((task.sensors, 2), dtype=np.bool_)
    for step in range(LONG):
        if step == late:
            batch.seed(np.array([1]), [13])
            batch.reset(np.array([1]))
        rows[step] = batch.noise()
        batch.step(nobody)
    rows[LONG] = batch.noise()
    for run, first, seed in ((0, 0, 11), (1, 0, 12), (1, late, 13)):
        generator = seeding.np_random(seed)[0]
        generator.standard_normal(task.system.start_channels)
        last = late if seed == 12 else LONG + 1
        everything = channels + (task.access == "random")
        drawn = generator.standard_normal((last - first, everything))[:, :channels]
        np.testing.assert_array_equal(rows[first:last, :, run], drawn)
    assert len(np.unique(rows[:, 0, 0])) == LONG + 1
    assert (rows[:-256] != rows[256:]).all()


@each_stream
def test_an_episode_does_not_depend_on_the_length_of_the_one_before(case: Case) -> None:
    """That one was cut short, or went on for more than a block of noise."""
    short, long = (case.batch([31], 300) for _ in range(2))
    nobody = np.zeros((case.task().sensors, 1), dtype=np.bool_)
    before = []
    for batch, steps in ((short, 4), (long, 299)):
        for _ in range(steps):
            before.append(batch.noise().copy())
            batch.step(nobody)
        batch.reset()
    for _ in range(5):
        same(latent(short), latent(long))
        assert not np.isin(latent(short).noise, before).any()
        for batch in (short, long):
            batch.step(nobody)


@each_default
def test_seeds_differ_and_repeat(case: Case) -> None:
    one, other = case.batch([1, 2, 3]), case.batch([3, 2, 1])
    found, turned = latent(one), latent(other)
    np.testing.assert_array_equal(found.noise[:, ::-1], turned.noise)
    np.testing.assert_array_equal(found.truth[:, ::-1], turned.truth)
    assert len(np.unique(found.noise)) == found.noise.size
