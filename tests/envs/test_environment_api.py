"""What the environment promises beyond the laws: clipping, scales, ends of episodes."""

import sys
import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

import fusion_gym
from fusion_gym.envs import single

ENV_ID = "fusion_gym/TobitOscillator-v1"


@pytest.fixture(autouse=True)
def every_warning_is_an_error() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def test_extreme_entries_are_clipped_to_their_bounds() -> None:
    env: Any = gymnasium.make(ENV_ID).unwrapped
    env.reset(seed=4)
    state, space = env.batch.state.estimate, env.observation_space
    sensed = [n.startswith(("whitened", "held")) for n in env.observation_names]
    assumed = [n.startswith(("log_variance", "estimate")) for n in env.observation_names]
    for sign, bound in ((1.0, space.high), (-1.0, space.low)):
        state.measurement = np.full_like(state.measurement, sign * 1e6)
        state.prior_mean = np.full_like(state.prior_mean, sign * 1e6)
        state.prior_covariance = np.eye(2)[..., None] * 10.0 ** (9.0 * sign)
        observation = env.batch.observe()[0]
        assert space.contains(observation)
        for entries in (sensed, assumed):
            np.testing.assert_array_equal(observation[entries][1:], bound[entries][1:])


PACKAGES = {
    "make_sb3_vec_env": ("stable_baselines3", "privileged"),
    "parallel_env": ("pettingzoo", "parallel"),
}


@pytest.mark.parametrize("interface", PACKAGES)
def test_an_interface_without_its_package_says_what_to_install(
    interface: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    package, module = PACKAGES[interface]
    monkeypatch.delitem(sys.modules, f"fusion_gym.envs.{module}", raising=False)
    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    message = r"install fusion-gym with its extra '(sb3|marl)'$"
    with pytest.raises(ModuleNotFoundError, match=message):
        getattr(fusion_gym, interface)


def test_silence_costs_about_one_a_step() -> None:
    env: Any = gymnasium.make_vec(ENV_ID, 1000, filter="tobit")
    env.reset(seed=0)
    rewards = [env.step(np.zeros((1000, 3), dtype=np.int8))[1] for _ in range(100)]
    assert np.mean(rewards) == pytest.approx(-1.0, abs=0.1)


@pytest.mark.slow
def test_a_bound_starved_for_thousands_of_steps_does_not_overflow() -> None:
    env = gymnasium.make(ENV_ID, horizon=2500)
    env.reset(seed=0)
    for _ in range(2500):
        observation, reward, _, truncated, _ = env.step(np.zeros(3, dtype=np.int8))
        assert np.isfinite(reward)
        assert np.isfinite(observation).all()
    assert truncated


def test_the_slow_way_to_train_is_named_once() -> None:
    single._warn_of_single_steps.cache_clear()
    envs = [DummyVecEnv([lambda: gymnasium.make(ENV_ID)]) for _ in range(2)]
    with pytest.warns(UserWarning, match="make_sb3_vec_env"):
        envs[0].reset()
    envs[1].reset()
    gymnasium.make(ENV_ID).reset()
