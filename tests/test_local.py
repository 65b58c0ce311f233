"""Sensors that decide by themselves: PettingZoo's interface, SB3 rows, and what they may see."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env.util import obs_space_info

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.envs.registration import ENVIRONMENTS
from fusion_gym.envs.sb3 import FusionSB3VecEnv
from fusion_gym.envs.views import SensorView
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.model import tag_model
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

TOBIT = "fusion_gym/TobitOscillator-v0"
CORRELATED = "fusion_gym/CorrelatedTracking-v0"
GLOBAL = {CORRELATED: {"fused_innovation", "log_deviation", "estimate"}}


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_pettingzoos_own_checks(env_id: str) -> None:
    parallel_api_test(fusion_gym.parallel_env(env_id, horizon=20), num_cycles=50)
    parallel_seed_test(lambda: fusion_gym.parallel_env(env_id, horizon=20), num_cycles=25)


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_a_row_has_what_the_sensor_knows_and_nothing_else(env_id: str) -> None:
    task = fusion_gym.make_task(env_id, price_range=(0.001, 0.1), cost_weight=0.01)
    view, batch = SensorView(task), EpisodeBatch(task, 5)
    batch.seed(np.arange(5), list(range(5)))
    batch.reset()
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


def test_another_sensors_measurement_changes_nothing() -> None:
    """The entries of sensor 0 are the same whatever the others have measured."""
    task = fusion_gym.make_task(TOBIT, filter="tobit")
    view = SensorView(task)
    observation = np.zeros((1, len(EpisodeBatch(task, 1).layout.names)), dtype=np.float32)
    before = view.rows(observation)
    for entry, feature in enumerate(EpisodeBatch(task, 1).layout.entries):
        if feature.sensor in (1, 2):
            observation[0, entry] = 1.0
    np.testing.assert_array_equal(view.rows(observation)[0], before[0])
    assert (view.rows(observation)[1] != before[1]).any()


def test_rows_of_the_vec_env_are_the_coordinators_runs() -> None:
    options: dict[str, Any] = {"filter": "tobit", "horizon": 7}
    local = fusion_gym.make_sb3_vec_env(TOBIT, 4, seed=3, local=True, **options)
    whole = fusion_gym.make_sb3_vec_env(TOBIT, 4, seed=3, **options)
    assert local.num_envs == 12
    assert obs_space_info(local.observation_space)[1][None] == (len(local.observation_names),)
    first, second = local.reset(), whole.reset()
    assert isinstance(first, np.ndarray)
    np.testing.assert_array_equal(first, local.view.rows(second))
    generator = np.random.default_rng(0)
    for step in range(9):
        action = generator.integers(0, 2, (4, 3))
        rows, row_reward, row_done, row_infos = local.step(action.ravel())
        plain, reward, done, infos = whole.step(action)
        np.testing.assert_array_equal(rows, local.view.rows(plain))
        np.testing.assert_array_equal(row_reward, reward.repeat(3))
        np.testing.assert_array_equal(row_done, done.repeat(3))
        assert done.all() == (step == 6)
        if done.all():
            episodes = [info["episode"]["r"] for info in row_infos]
            assert episodes == list(np.repeat([info["episode"]["r"] for info in infos], 3))
            assert all(info["terminal_observation"].shape == rows[0].shape for info in row_infos)


def test_the_parallel_environment_is_the_coordinators_run() -> None:
    env = fusion_gym.parallel_env(TOBIT, horizon=5)
    whole = fusion_gym.make_sb3_vec_env(TOBIT, 1, seed=11, horizon=5)
    observations, _ = env.reset(seed=11)
    view = SensorView(env.task)
    np.testing.assert_array_equal(np.stack(list(observations.values())), view.rows(whole.reset()))
    for step in range(5):
        chosen = np.array([1, 0, 1])
        observations, rewards, _, truncated, infos = env.step(
            dict(zip(env.agents, chosen, strict=True))
        )
        _, reward, _, _ = whole.step(chosen[None])
        assert np.float32(rewards["sensor_0"]) == reward[0]
        assert truncated["sensor_2"] == (step == 4)
        assert infos["sensor_1"]["cost"] == 0.0
    assert env.agents == []


def test_a_shared_policy_is_trained_saved_and_evaluated(tmp_path: Path) -> None:
    task = fusion_gym.make_task(TOBIT, filter="tobit", horizon=10)
    env = FusionSB3VecEnv(task, 4, local=True)
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=48, device="cpu", seed=0)
    model.learn(96)
    tag_model(model, task, local=True)
    model.save(tmp_path / "local.zip")
    policy = make_policy(f"model:{tmp_path / 'local.zip'}", task)
    results = run_episodes(task, policy, 3, seed=0)
    batch = EpisodeBatch(task, 3)
    batch.seed(np.arange(3), [0, 1, 2])
    batch.reset()
    rate = np.zeros((3, 3))
    for _ in range(10):
        action, _ = model.predict(SensorView(task).rows(batch.observe()), deterministic=True)
        rate += batch.step(action.reshape(3, 3).T.astype(np.bool_)).granted.T
    np.testing.assert_allclose(results.rate, rate / 10)


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="parallel_env"):
        fusion_gym.make_task(TOBIT, information="local")
    with pytest.raises(ConfigurationError, match="information = 'centre'"):
        fusion_gym.parallel_env(TOBIT, information="centre")
    env = fusion_gym.parallel_env(TOBIT)
    with pytest.raises(Exception, match="call reset"):
        env.step({})
    env.reset(seed=0)
    with pytest.raises(ValueError, match="one of each of"):
        env.step({"sensor_0": 1})
    with pytest.raises(ValueError, match="0 and 1"):
        env.step(dict.fromkeys(env.agents, 2))
