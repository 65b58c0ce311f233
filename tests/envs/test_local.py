"""Sensors that decide by themselves: PettingZoo's interface, SB3 rows, and what they may see."""

from pathlib import Path

import numpy as np
import pytest
from stable_baselines3 import PPO

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.envs.registration import ENVIRONMENTS
from fusion_gym.envs.sb3 import FusionSB3VecEnv
from fusion_gym.envs.views import SensorView
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.policies.saved import tag_model

TOBIT = "fusion_gym/TobitOscillator-v1"
CORRELATED = "fusion_gym/CorrelatedTracking-v1"
GLOBAL = {CORRELATED: {"fused_innovation", "log_deviation", "estimate"}}


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_a_row_has_what_the_sensor_knows_and_nothing_else(env_id: str) -> None:
    task = fusion_gym.make_task(env_id, price_range=(0.001, 0.1), cost_weight=0.01)
    view, batch = SensorView(task), EpisodeBatch.seeded(task, 5, 0)
    for _ in range(3):
        batch.step(np.ones((task.sensors, 5), dtype=np.bool_))
    observation = batch.observe()
    rows = view.rows(observation).reshape(5, task.sensors, -1)
    assert rows.shape[-1] == len(view.names) == len(view.space.low)
    for sensor in range(task.sensors):
        for place, name in enumerate(view.names):
            kind, _, inner = name.partition("[")
            if kind == "sensor":
                assert (rows[:, sensor, place] == (inner == f"{sensor}]")).all()
                continue
            own = f"{kind}[{sensor},{inner}" if inner else f"{kind}[{sensor}]"
            source = own if own in batch.layout.names else name
            entry = batch.layout.names.index(source)
            np.testing.assert_array_equal(rows[:, sensor, place], observation[:, entry])
    kinds = {name.partition("[")[0] for name in view.names}
    measured = {block.name for block in batch.layout.blocks if block.knowledge == "own"}
    assert measured & kinds, "a sensor must see what it measures"
    assert {"tokens", "price", "sensor"} <= kinds
    assert not kinds & GLOBAL.get(env_id, set())


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_without_its_number_a_row_is_the_same_but_for_that(env_id: str) -> None:
    """And sensors of one kind in the same place are told nothing apart."""
    received, untold = (fusion_gym.make_task(env_id, own_number=number) for number in (True, False))
    view, other = SensorView(received), SensorView(untold)
    batch = EpisodeBatch.seeded(received, 4, 0)
    stored = len(other.names)
    assert view.names[:stored] == other.names
    assert view.names[stored:] == tuple(f"sensor[{sensor}]" for sensor in range(received.sensors))
    assert other.space.shape == (stored,)
    rows, fewer = view.rows(batch.observe()), other.rows(batch.observe())
    np.testing.assert_array_equal(rows[:, :stored], fewer, strict=True)


def test_a_shared_policy_is_trained_saved_and_evaluated(tmp_path: Path) -> None:
    task = fusion_gym.make_task(TOBIT, filter="tobit", horizon=10)
    env = FusionSB3VecEnv(task, 4, local=True)
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=48, device="cpu", seed=0)
    model.learn(96)
    tag_model(model, task, local=True)
    model.save(tmp_path / "local.zip")
    policy = make_policy(f"model:{tmp_path / 'local.zip'}", task)
    results = run_episodes(task, policy, 3, seed=0)
    batch = EpisodeBatch.seeded(task, 3, 0)
    rate = np.zeros((3, 3))
    for _ in range(10):
        action, _ = model.predict(SensorView(task).rows(batch.observe()), deterministic=True)
        rate += batch.step(action.reshape(3, 3).T.astype(np.bool_)).granted.T
    np.testing.assert_allclose(results.rate, rate / 10)
