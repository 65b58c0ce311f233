"""The plants that nobody tuned: each is a task, and a unit of length changes nothing."""

import argparse
from pathlib import Path

import numpy as np
import pytest

from benchmarks.plants import PLANTS, draw_plant, judge
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy

ENV = "fusion_gym/LinearFusion-v2"


@pytest.mark.parametrize("name", PLANTS)
def test_transmissions_pay(name: str) -> None:
    task = make_task(ENV, **PLANTS[name])
    errors = [
        run_episodes(task, make_policy(policy, task), 20, 0).mse.mean()
        for policy in ("never", "paced:rate=0.05", "always")
    ]
    assert errors[0] > 1.2 * errors[1] > 1.2 * errors[2]


def test_millimetres_are_metres() -> None:
    metres, millimetres = (
        run_episodes(task, make_policy("information_gain", task), 5, 0)
        for unit in ("metres", "millimetres")
        for task in [make_task(ENV, **PLANTS[f"random_walk_{unit}"])]
    )
    np.testing.assert_allclose(millimetres.mse, 1e6 * metres.mse, rtol=1e-9)
    np.testing.assert_allclose(millimetres.returns, metres.returns, rtol=1e-9)


def test_a_seed_draws_a_plant() -> None:
    assert draw_plant(5) == draw_plant(5) != draw_plant(6)
    assert len(PLANTS) == 13


@pytest.mark.slow
def test_the_command_judges_a_front(tmp_path: Path) -> None:
    arguments = argparse.Namespace(output=tmp_path, episodes=10, timesteps=50_000, resume=True)
    row = judge("random_walk_metres", arguments)
    assert row.least <= row.mean <= row.most
    assert judge("random_walk_metres", arguments) == row
