"""The model-based lookahead: against its own arithmetic, its limits, and what it may not see."""

from __future__ import annotations

import dataclasses
from itertools import product
from typing import Any

import numpy as np
import pytest

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.lookahead import Lookahead
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

TOBIT = "fusion_gym/TobitOscillator-v0"
TRACKING = "fusion_gym/BiasedTracking-v0"


def played(task: Task, runs: int = 30, steps: int = 5) -> EpisodeBatch:
    batch = EpisodeBatch(task, runs)
    batch.seed(np.arange(runs), list(range(runs)))
    batch.reset()
    generator = np.random.default_rng(1)
    for _ in range(steps):
        batch.step(generator.random((task.sensors, runs)) < 0.3)
    return batch


def test_its_choice_is_the_cheapest_of_all_sets() -> None:
    """A linear target: the distance to the best estimate moves with the transition matrix."""
    options: dict[str, Any] = {"filter": "kalman", "access": "any", "tokens": "unlimited"}
    task = fusion_gym.make_task(TRACKING, token_cost=(3.0, 5.0), **options)
    batch, price, steps = played(task), 0.002, 4
    chosen = Lookahead(task, price, steps)(batch.signals())
    system, weights = task.system, task.reward.state_weights[:, 0]
    transition = system.plant.transition[..., 0]
    best, _ = system.fused(system.deliver(batch.state, np.ones((2, 30), dtype=np.bool_)))
    for run in range(30):
        costs = {}
        for pattern in product((False, True), repeat=2):
            granted = np.zeros((2, 30), dtype=np.bool_)
            granted[:, run] = pattern
            mean, _ = system.fused(system.deliver(batch.state, granted))
            distance = mean[:, run] - best[:, run]
            total = price * (3.0 * pattern[0] + 5.0 * pattern[1])
            for _ in range(steps):
                total += weights @ distance**2
                distance = transition @ distance
            costs[pattern] = total
        assert tuple(chosen[:, run]) == min(costs, key=lambda key: costs[key])


def test_the_true_state_does_not_matter() -> None:
    task = fusion_gym.make_task(TOBIT, filter="tobit", token_rate=2.0)
    batch = played(task)
    policy = Lookahead(task, price=0.003)
    first = policy(batch.signals())
    assert first.any()
    assert not first.all()
    batch.state = dataclasses.replace(batch.state, truth=batch.state.truth + 7.0)
    assert np.isnan(batch.signals()["model"].truth).all()
    np.testing.assert_array_equal(policy(batch.signals()), first)


def test_its_limits() -> None:
    task = fusion_gym.make_task(TOBIT, filter="tobit", tokens="unlimited")
    assert run_episodes(task, Lookahead(task, price=1e9), 5, seed=0).rate.max() == 0.0
    free = run_episodes(task, Lookahead(task, price=0.0), 5, seed=0)
    always = run_episodes(task, make_policy("always", task), 5, seed=0)
    np.testing.assert_allclose(free.mse, always.mse, rtol=1e-9)


def test_it_asks_only_for_what_the_network_grants() -> None:
    task = fusion_gym.make_task(TOBIT, filter="tobit", token_rate=1.0, sharing="rotating")
    results = run_episodes(task, Lookahead(task, price=1e-4), 20, seed=0)
    assert results.rate.mean() > 0.05
    assert results.denied.max() == 0.0
    single = fusion_gym.make_task(TOBIT, filter="tobit", access="single")
    assert Lookahead(single, price=0.0)(played(single).signals()).sum(0).max() == 1


def test_it_beats_thresholds_and_sends_less() -> None:
    """400 paired episodes on the benchmark setting; the margin is many standard errors."""
    task = fusion_gym.make_task(TOBIT, filter="tobit", random_start=True, token_rate=2.0)
    ahead = run_episodes(task, make_policy("lookahead:steps=1,price=0.01", task), 400, seed=0)
    for threshold in (0.5, 0.75, 1.0):
        policy = make_policy(f"innovation_threshold:threshold={threshold}", task)
        other = run_episodes(task, policy, 400, seed=0)
        difference = ahead.mse - other.mse
        assert difference.mean() < -4 * difference.std() / np.sqrt(400)
        assert ahead.rate.mean() < other.rate.mean() - 0.02


def test_what_cannot_be_is_refused() -> None:
    task = fusion_gym.make_task(TOBIT)
    for text, message in (
        ("lookahead:steps=0", "steps = 0"),
        ("lookahead:price=-1", "price = -1"),
        ("lookahead:horizon=3", "unknown parameter of policy 'lookahead' 'horizon'"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            make_policy(text, task)
    centre = fusion_gym.make_task(TOBIT, information="centre")
    with pytest.raises(ConfigurationError, match="information = 'centre'"):
        make_policy("lookahead", centre)
    with pytest.raises(LookupError, match="'model'"):
        played(centre).signals()["model"]
