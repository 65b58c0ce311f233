"""Gymnasium's, Stable-Baselines3's and PettingZoo's own checks, and what an id promises."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import gymnasium
import numpy as np
import pytest
from cases import IDS, Case, actions, each_case, each_default, each_lasting, requests
from gymnasium.utils.env_checker import check_env as gymnasium_check
from own_system import OWN_ID, WalkOptions, build
from pettingzoo.test import parallel_api_test, parallel_seed_test
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as sb3_check
from stable_baselines3.common.env_util import make_vec_env

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.options import CommonOptions
from fusion_gym.envs import registered
from fusion_gym.envs.registration import class_name, options_of
from fusion_gym.envs.single import FusionEnv
from fusion_gym.envs.vector import FusionVectorEnv
from fusion_gym.envs.views import SensorView
from fusion_gym.validation import ConfigurationError

each_id = pytest.mark.parametrize("env_id", IDS)


@pytest.fixture(autouse=True)
def every_warning_is_an_error() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@each_case
def test_gymnasiums_checker(case: Case) -> None:
    gymnasium_check(FusionEnv(case.task()), skip_render_check=True)


@each_case
def test_stable_baselines_checker(case: Case) -> None:
    sb3_check(FusionEnv(case.task()), warn=True)


@each_id
def test_pettingzoos_checks(env_id: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        parallel_api_test(fusion_gym.parallel_env(env_id, horizon=20), num_cycles=50)
        parallel_seed_test(lambda: fusion_gym.parallel_env(env_id, horizon=20), num_cycles=25)


@each_case
def test_agents_of_pettingzoo_see_the_rows_of_their_sensors(case: Case) -> None:
    if case.not_local:
        with pytest.raises(ConfigurationError, match=case.not_local):
            fusion_gym.parallel_env(case.env_id, **case.options)
        return
    env, view = fusion_gym.parallel_env(case.env_id, **case.options), SensorView(case.task())
    batch, bucket = case.batch([7], owner=view.owner), case.task().bucket
    observations, _ = env.reset(seed=7)
    assert env.possible_agents == [f"sensor_{m}" for m in range(case.task().sensors)]
    for wanted in requests(case.task(), 1, 6):
        rows = np.stack(list(observations.values()))
        np.testing.assert_array_equal(rows, view.rows(batch.observe()))
        outcome = batch.step(wanted)
        chosen = dict(zip(env.agents, wanted[:, 0].astype(int).tolist(), strict=True))
        observations, rewards, terminated, truncated, infos = env.step(chosen)
        assert set(rewards.values()) == {outcome.reward[0]}
        assert not any(terminated.values())
        assert not any(truncated.values())
        granted = [info["granted"] for info in infos.values()]
        assert granted == outcome.granted[:, 0].tolist()
        costs = [info["cost"] for info in infos.values()]
        np.testing.assert_array_equal(costs, outcome.granted[:, 0] * bucket.cost[:, 0])


@each_lasting
def test_sensors_rows_of_stable_baselines_are_the_coordinators_runs(case: Case) -> None:
    if case.not_local:
        with pytest.raises(ConfigurationError, match=case.not_local):
            fusion_gym.make_sb3_vec_env(case.env_id, 3, local=True, **case.options)
        return
    options = case.options | {"horizon": 5}
    local = fusion_gym.make_sb3_vec_env(case.env_id, 3, seed=3, local=True, **options)
    whole = fusion_gym.make_sb3_vec_env(case.env_id, 3, seed=3, **options)
    whole.batch = EpisodeBatch(whole.task, 3, local.view.owner)  # remembers for whom it is compared
    sensors = case.task().sensors
    assert local.num_envs == 3 * sensors
    np.testing.assert_array_equal(local.reset(), local.view.rows(whole.reset()))
    for step, wanted in enumerate(requests(case.task(), 3, 6), start=1):
        rows, row_reward, row_done, row_infos = local.step(wanted.T.ravel().astype(np.int64))
        plain, reward, done, infos = whole.step(actions(case.task(), wanted))
        np.testing.assert_array_equal(rows, local.view.rows(plain))
        np.testing.assert_array_equal(row_reward, reward.repeat(sensors))
        np.testing.assert_array_equal(row_done, done.repeat(sensors))
        assert done.all() == (step == 5)
        if step == 5:
            last = np.stack([info["terminal_observation"] for info in infos])
            rows = np.stack([info["terminal_observation"] for info in row_infos])
            np.testing.assert_array_equal(rows, local.view.rows(last))
            returns = np.repeat([info["episode"]["r"] for info in infos], sensors)
            assert [info["episode"]["r"] for info in row_infos] == returns.tolist()


@each_id
def test_an_id_makes_every_face(env_id: str) -> None:
    spec = gymnasium.spec(env_id)
    prefix = class_name(env_id)
    assert spec.max_episode_steps is None
    single = gymnasium.make(env_id, horizon=3)
    assert single.unwrapped.spec is not None
    assert type(single.unwrapped) is getattr(registered, f"{prefix}Env")
    assert single.unwrapped.spec.id == env_id
    vector: Any = gymnasium.make_vec(env_id, 2, vectorization_mode="vector_entry_point", horizon=3)
    assert type(vector.unwrapped) is getattr(registered, f"{prefix}VectorEnv")
    assert vector.spec.id == env_id
    sb3 = fusion_gym.make_sb3_vec_env(env_id, 2, horizon=3)
    task = fusion_gym.make_task(env_id, horizon=3)
    for env in (single.unwrapped, vector, sb3):
        assert env.task.settings == task.settings
        assert env.observation_names == vector.observation_names
    assert single.observation_space == vector.single_observation_space == sb3.observation_space
    assert single.action_space == vector.single_action_space == sb3.action_space


@each_id
@pytest.mark.parametrize("limit", ["max_episode_steps", "horizon"])
def test_episodes_end_by_truncation_alone(env_id: str, limit: str) -> None:
    """The vector environment takes ``max_episode_steps`` itself; ``make`` wraps."""
    single = gymnasium.make(env_id, **{limit: 3})
    vector: Any = gymnasium.make_vec(
        env_id, 2, vectorization_mode="vector_entry_point", **{limit: 3}
    )
    assert vector.task.horizon == 3
    vector.reset(seed=0)
    for step in range(1, 9):
        if step % 4 == 1:
            single.reset()
        *_, truncated, _ = vector.step(vector.action_space.sample())
        assert (truncated == (step % 4 == 3)).all()  # every fourth step is the reset
        if step % 4:
            _, _, terminated, over, _ = single.step(single.action_space.sample())
            assert not terminated
            assert over == (step % 4 == 3)


@each_id
def test_help_shows_every_option_with_its_default(env_id: str) -> None:
    kind, task = options_of(env_id), fusion_gym.make_task(env_id)
    assert issubclass(kind, CommonOptions)
    options = {field.name: field.default for field in fields(kind)}
    assert options.keys() == task.settings.keys()
    prefix, common = class_name(env_id), {"render_mode": None}
    more = {"num_envs": 1, "autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP}
    for name, first in ((f"{prefix}Env", common), (f"{prefix}VectorEnv", more | common)):
        shown = inspect.signature(getattr(registered, name)).parameters
        file = {"system": None}
        assert {key: one.default for key, one in shown.items()} == first | options | file
        for key in options:
            assert shown[key].kind is inspect.Parameter.KEYWORD_ONLY


@each_default
def test_an_unknown_option_is_named(case: Case) -> None:
    for make in (
        lambda **options: gymnasium.make(case.env_id, **options),
        lambda **options: fusion_gym.make_sb3_vec_env(case.env_id, 2, **options),
        lambda **options: fusion_gym.parallel_env(case.env_id, **options),
    ):
        message = rf"{case.env_id} got an unexpected keyword argument 'colour': .*known are access"
        for kind in (ConfigurationError, TypeError):
            with pytest.raises(kind, match=message):
                make(colour="red")
    with pytest.raises(ConfigurationError, match="information = 'nobody'"):
        fusion_gym.make_task(case.env_id, information="nobody")


@each_id
def test_stable_baselines_makes_an_environment_of_its_id(env_id: str) -> None:
    vector = make_vec_env(env_id, n_envs=2, seed=0)
    model = PPO("MlpPolicy", env_id, n_steps=4, batch_size=4, n_epochs=1, device="cpu")
    vector.reset()
    assert vector.step(np.array([vector.action_space.sample()] * 2))[1].shape == (2,)
    assert model.learn(4).num_timesteps == 4


def test_an_environment_of_ones_own_is_registered_once() -> None:
    fusion_gym.register(OWN_ID, build)
    assert fusion_gym.make_task(WalkOptions(q=2.0)).settings["q"] == 2.0
    assert isinstance(gymnasium.make(OWN_ID).unwrapped, FusionEnv)
    assert issubclass(registered.mine_RandomWalk_v0VectorEnv, FusionVectorEnv)
    with pytest.raises(ConfigurationError, match="registered already"):
        fusion_gym.register(OWN_ID, lambda chosen: build(chosen))
    with pytest.raises(ConfigurationError, match="build = None"):
        fusion_gym.register("mine/Other-v0")
    with pytest.raises(ConfigurationError, match="unknown environment 'mine/Other-v0'"):
        fusion_gym.make_task("mine/Other-v0")
