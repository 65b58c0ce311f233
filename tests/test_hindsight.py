"""Hindsight schedules: against all schedules there are, paired with other policies, refusals."""

import dataclasses
from itertools import product
from typing import Any

import numpy as np
import pytest

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.reward import Price
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import ENVIRONMENTS
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.evaluation.hindsight import run_hindsight
from fusion_gym.policies.hindsight import find_schedules
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

REMOTE = "fusion_gym/RemoteEstimation-v1"
TOBIT = "fusion_gym/TobitOscillator-v1"
TRACKING = "fusion_gym/BiasedTracking-v1"


def cheapest(task: Task, price: float, seed: int) -> float:
    """The least cost of all sequences of requests in one episode, by the environment itself."""
    steps = [np.array(p) for p in product((False, True), repeat=task.sensors)]
    sequences = np.array(list(product(steps, repeat=task.horizon)))
    count = len(sequences)
    priced = dataclasses.replace(task.reward, price=Price.create(price))
    batch = EpisodeBatch(dataclasses.replace(task, reward=priced), count)
    batch.seed(np.arange(count), [seed] * count)
    batch.reset()
    total = np.zeros(count)
    for step in range(task.horizon):
        total -= batch.step(sequences[:, step].T).reward
    return float(total.min())


@pytest.mark.parametrize(
    ("env_id", "options", "price"),
    [
        (REMOTE, {"max_episode_steps": 9, "tokens": "limited", "token_rate": 0.3}, 0.5),
        (
            REMOTE,
            {"max_episode_steps": 5, "sensors": 2, "channel": "gilbert_elliott", "token_cost": 2.0},
            0.3,
        ),
        (TRACKING, {"max_episode_steps": 5, "access": "single"}, 1e-3),
        (TRACKING, {"max_episode_steps": 5, "access": "random"}, 1e-3),
        (TRACKING, {"max_episode_steps": 5, "access": "any", "tokens": "limited"}, 3e-4),
        (TOBIT, {"max_episode_steps": 4, "filter": "tobit", "token_rate": 1.0}, 0.001),
        (TOBIT, {"max_episode_steps": 4, "sharing": "rotating", "initial_tokens": 5.0}, 0.001),
    ],
)
def test_it_finds_the_cheapest_of_all_schedules(
    env_id: str, options: dict[str, Any], price: float
) -> None:
    task = fusion_gym.make_task(env_id, **options)
    result = find_schedules(task, price, width=5000, episodes=4, seed=3)
    assert result.exact.all()
    assert result.granted.any()
    best = [cheapest(task, price, seed) for seed in range(3, 7)]
    np.testing.assert_allclose(result.cost, best, rtol=1e-9)
    played = run_hindsight(task, price, width=5000, episodes=4, seed=3)
    np.testing.assert_allclose(-played.returns, best, rtol=1e-9)
    assert played.denied.max() == 0.0
    # A beam of one drops candidates, says so, and is no better.
    narrow = find_schedules(task, price, width=1, episodes=4, seed=3)
    assert not narrow.exact.any()
    assert (narrow.cost >= result.cost * (1.0 - 1e-9)).all()


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_its_episodes_are_those_of_other_policies(env_id: str) -> None:
    """Where a token costs too much, the results are those of a policy that never asks."""
    task = fusion_gym.make_task(env_id, max_episode_steps=6)
    silent = run_hindsight(task, price=1e9, width=3, episodes=5, seed=11)
    never = run_episodes(task, make_policy("never", task), 5, seed=11)
    for field in dataclasses.fields(never):
        values = getattr(silent, field.name), getattr(never, field.name)
        np.testing.assert_allclose(*values, rtol=1e-9, err_msg=field.name)
    free = find_schedules(task, price=0.0, width=3, episodes=5, seed=11)
    assert free.granted.any()


def test_each_episode_has_a_search_of_its_own() -> None:
    """Also where the episodes do not fit side by side, and where noise is drawn in blocks."""
    task = fusion_gym.make_task(REMOTE, max_episode_steps=300)
    wide = 3000
    together = find_schedules(task, 3.0, wide // 1000, 5, seed=20)
    for place in range(5):
        single = find_schedules(task, 3.0, wide // 1000, 1, seed=20 + place)
        np.testing.assert_array_equal(together.granted[..., place], single.granted[..., 0])
    short = fusion_gym.make_task(REMOTE, max_episode_steps=20)
    split = find_schedules(short, 3.0, wide, 5, seed=20)
    single = find_schedules(short, 3.0, wide, 1, seed=24)
    np.testing.assert_array_equal(split.granted[..., 4], single.granted[..., 0])
    played = run_hindsight(task, 3.0, 3, 5, seed=20)
    np.testing.assert_allclose(-played.returns, together.cost, rtol=1e-9)


def test_in_the_solved_case_a_small_beam_reaches_the_optimum() -> None:
    """One source is where it was last sent: the best schedule follows from T(T + 1)/2 stretches."""
    task, price, horizon = fusion_gym.make_task(REMOTE, max_episode_steps=60), 5.0, 60
    batch = EpisodeBatch.seeded(task, 8, 0)
    path = np.zeros((horizon + 1, 8))
    for step in range(horizon):
        path[step + 1] = batch.state.truth[0]
        batch.step(np.zeros((1, 8), dtype=np.bool_))
    # to_go[t]: the least cost after t, sent at t; silent[s] the error of the steps t+1..s.
    to_go = np.zeros((horizon + 1, 8))
    for sent in reversed(range(horizon)):
        silent = np.cumsum((path[sent + 1 :] - path[sent]) ** 2, axis=0)
        before_next = np.concatenate([np.zeros((1, 8)), silent[:-1]])
        again = before_next + price + to_go[sent + 1 :]
        to_go[sent] = np.minimum(again.min(0), silent[-1])
    result = find_schedules(task, price, width=64, episodes=8, seed=0)
    np.testing.assert_allclose(result.cost, to_go[0], rtol=1e-9)
    assert not result.exact.any()


def test_what_cannot_be_is_refused() -> None:
    task = fusion_gym.make_task(REMOTE, max_episode_steps=5)
    for values, message in (
        ({"price": -1.0}, "price = -1"),
        ({"width": 0}, "width = 0"),
        ({"episodes": 0}, "episodes = 0"),
        ({"seed": -1}, "seed = -1"),
    ):
        arguments: dict[str, Any] = {"price": 1.0, "width": 2, "episodes": 3, "seed": 0} | values
        with pytest.raises(ConfigurationError, match=message):
            run_hindsight(task, **arguments)
    claimed = fusion_gym.make_task(TOBIT, error="trace")
    with pytest.raises(ConfigurationError, match="error = 'trace' is not allowed"):
        run_hindsight(claimed, 1.0, 2, 3, 0)
