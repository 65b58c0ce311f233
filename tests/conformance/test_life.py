"""Short, long and copied lives: one step, a thousand silent ones, a copy in mid-episode."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from cases import LASTING, TOBIT, Case, actions, each_case, each_lasting, requests
from endurance import endure

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.envs import registered
from fusion_gym.envs.registration import class_name

SILENT, RUNS = 1000, 32
ANSWERED = {"tokens": "unlimited", "access": "any"}
SLOW = [
    c for c in LASTING if "fusion" in c.options or (c.options.get("memory") and c.env_id != TOBIT)
]
STARVED = [case for case in LASTING if case not in SLOW]
STARVED += [pytest.param(case, marks=pytest.mark.slow) for case in SLOW]


@each_lasting
def test_an_episode_of_one_step(case: Case) -> None:
    options = case.options | {"horizon": 1}
    env = getattr(registered, f"{class_name(case.env_id)}Env")(**options)
    for wanted in requests(env.task, 1, 3):
        first, _ = env.reset()
        last, reward, terminated, truncated, info = env.step(actions(env.task, wanted)[0])
        assert (terminated, truncated) == (env.task.clock, not env.task.clock)
        assert env.observation_space.contains(first)
        assert env.observation_space.contains(last)
        assert np.isfinite([reward, *info["squared_error"]]).all()


@pytest.mark.parametrize("case", STARVED, ids=str)
@pytest.mark.filterwarnings("error")
def test_finite_after_a_thousand_silent_steps_and_then_deliveries(case: Case) -> None:
    options = case.options | ANSWERED | {"horizon": SILENT + 20}
    batch = EpisodeBatch(fusion_gym.make_task(case.env_id, **options), RUNS)
    batch.seed(np.arange(RUNS), list(range(RUNS)))
    batch.reset()
    system, everyone = batch.task.system, np.ones((batch.task.sensors, RUNS), dtype=np.bool_)
    for step in range(SILENT + 10):
        outcome = batch.step(everyone & (step >= SILENT))
        assert np.isfinite(outcome.reward).all()
        if step >= SILENT - 1:
            observation = batch.observe()
            assert np.isfinite(observation).all()
            assert (observation >= batch.layout.low).all()
            assert (observation <= batch.layout.high).all()
            mean, covariance = system.fused(batch.delivered)
            assert np.isfinite(mean).all()
            assert (np.einsum("iir->ir", covariance) > 0.0).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
@each_lasting
def test_sound_for_a_million_steps_of_sparse_dense_and_random_requests(case: Case) -> None:
    endure(case, runs=1000, steps=1000)


def pickled(thing: Any) -> Any:
    """There and back."""
    return pickle.loads(pickle.dumps(thing))


@pytest.mark.parametrize("copied", [copy.deepcopy, pickled])
@each_case
def test_a_copied_task_is_the_same_task(case: Case, copied: Callable[[Any], Any]) -> None:
    batch, again = case.batch([4, 5, 6]), EpisodeBatch(copied(case.task()), 3)
    again.seed(np.arange(3), [4, 5, 6])
    again.reset()
    for wanted in requests(case.task(), 3, 3):
        np.testing.assert_array_equal(again.observe(), batch.observe())
        np.testing.assert_array_equal(again.step(wanted).reward, batch.step(wanted).reward)


@pytest.mark.parametrize("copied", [copy.deepcopy, pickled])
@each_case
def test_a_copy_goes_on_alike(case: Case, copied: Callable[[Any], Any]) -> None:
    """Of a batch, a single and a vector environment, in the middle of their episodes."""
    task, batch = case.task(), case.batch([4, 5, 6])
    prefix, wanted = class_name(case.env_id), requests(case.task(), 3, 9)
    single = getattr(registered, f"{prefix}Env")(**case.options)
    vector = getattr(registered, f"{prefix}VectorEnv")(3, "SameStep", **case.options)
    single.reset(seed=4)
    vector.reset(seed=4)
    for asked in wanted[:3]:
        batch.step(asked)
        single.step(actions(task, asked)[0])
        vector.step(actions(task, asked))
    other, other_single, other_vector = copied(batch), copied(single), copied(vector)
    for asked in wanted[3:6]:
        action = actions(task, asked)
        for one, two in zip(batch.step(asked), other.step(asked), strict=True):
            np.testing.assert_array_equal(one, two)
        observation, reward, *_ = vector.step(action)
        np.testing.assert_array_equal(observation, batch.observe())
        for face in (vector, other_vector):
            found = observation, reward
            if face is other_vector:
                found = other_vector.step(action)[:2]
            np.testing.assert_array_equal(found[0], other.observe())
            np.testing.assert_array_equal(found[1], reward)
        for face in (single, other_single):
            seen, value, *_ = face.step(action[0])
            np.testing.assert_array_equal(seen, observation[0])
            assert value == reward[0]
    np.testing.assert_array_equal(other_single.reset()[0], single.reset()[0])
    np.testing.assert_array_equal(other_vector.reset()[0], vector.reset()[0])
