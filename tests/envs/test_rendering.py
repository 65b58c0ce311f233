"""Pictures of the live episode, and the recorders that take them."""

import os
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import HumanRendering, RecordVideo
from numpy.typing import NDArray
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecVideoRecorder

from fusion_gym import make_sb3_vec_env
from fusion_gym.envs.registration import ENVIRONMENTS

TOBIT = "fusion_gym/TobitOscillator-v1"
PICTURE = "fusion_gym/BiasedOscillator-v2"
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_every_environment_draws_its_episode(env_id: str) -> None:
    env: Any = gym.make(env_id, render_mode="rgb_array", horizon=5)
    env.reset(seed=0)
    empty = env.render()
    assert empty.dtype == np.uint8
    assert empty.shape[1:] == (640, 3)
    assert empty.shape[0] % 2 == 0  # as video codecs want it
    env.step(np.ones_like(env.action_space.sample()))
    single = env.render()
    env.step(np.ones_like(env.action_space.sample()))
    two = env.render()
    assert (single != empty).any()
    assert (two != single).any()
    np.testing.assert_array_equal(two, env.render())
    env.reset(seed=0)
    np.testing.assert_array_equal(env.render(), empty)


def test_a_picture_shows_what_happened() -> None:
    """Ticks of requests that were granted and denied, in their colours; the censored region."""
    tokens: Any = {"initial_tokens": 3.0, "token_rate": 0.0, "sharing": "fixed"}
    env: Any = gym.make(TOBIT, render_mode="rgb_array", **tokens)

    def counts() -> NDArray[Any]:
        granted, denied, censored = (0, 114, 178), (140, 140, 140), (247, 235, 241)
        away = np.abs(env.render()[..., None, :].astype(int) - [granted, denied, censored])
        return (away.max(-1) <= 3).sum((0, 1))

    env.reset(seed=0)
    legend = counts()
    assert legend[:2].all()
    env.step(np.array([1, 0, 0], dtype=np.int8))
    first = counts()
    assert first[0] > legend[0]
    env.step(np.array([0, 1, 0], dtype=np.int8))
    second = counts()
    assert second[0] == first[0]
    assert second[1] > first[1]
    assert second[2]


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_vector_environment_draws_every_run(mode: str) -> None:
    options: Any = {"horizon": 3, "render_mode": "rgb_array"}
    envs: Any = gym.make_vec(TOBIT, num_envs=2, autoreset_mode=mode, **options)
    single: Any = gym.make(TOBIT, **options)
    envs.reset(seed=0)
    single.reset(seed=1)
    for _ in range(2):
        envs.step(np.ones((2, 3), dtype=np.int8))
        single.step(np.ones(3, dtype=np.int8))
    for frames in (envs.render(), envs.unwrapped.call("render")):
        assert len(frames) == 2
        np.testing.assert_array_equal(frames[1], single.render())
        assert not np.array_equal(*frames)
    for _ in range(2):
        envs.step(np.ones((2, 3), dtype=np.int8))
    assert len(envs.render()) == 2
    blind: Any = gym.make_vec(TOBIT, num_envs=2)
    assert blind.render() is None
    assert blind.unwrapped.call("render") == (None, None)


@pytest.mark.slow
def test_recorders_write_films(tmp_path: Path) -> None:
    env: Any = RecordVideo(
        gym.make(PICTURE, render_mode="rgb_array", horizon=4), str(tmp_path / "gym"),
        disable_logger=True,
    )  # fmt: skip
    env.reset(seed=0)
    for _ in range(4):
        env.step(env.action_space.sample())
    env.close()
    assert list((tmp_path / "gym").glob("*.mp4"))
    native: Any = make_sb3_vec_env(TOBIT, 2, horizon=5, render_mode="rgb_array")
    singles: Any = make_vec_env(TOBIT, n_envs=2, env_kwargs={"horizon": 5})
    pictures: dict[str, Any] = {}
    for name, rows in (("native", native), ("singles", singles)):
        rows.seed(0)
        film = VecVideoRecorder(rows, str(tmp_path / name), lambda step: step == 0, video_length=3)
        film.reset()
        for _ in range(7):  # beyond the end of an episode
            film.step(np.ones((2, 3), dtype=np.int8))
        pictures[name] = rows.get_images()
        film.close()
        assert list((tmp_path / name).glob("*.mp4"))
    assert [p.shape for p in pictures["native"]] == [p.shape for p in pictures["singles"]]
    assert (pictures["native"][0] != pictures["native"][1]).any()
    assert make_sb3_vec_env(TOBIT, 2, horizon=5).render_mode is None


def test_a_window_shows_the_episode() -> None:
    env: Any = gym.make(TOBIT, render_mode="human", horizon=3)
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample())
        assert env.render() is None
    env.close()
    wrapped: Any = HumanRendering(gym.make(TOBIT, render_mode="rgb_array", horizon=3))
    wrapped.reset(seed=0)
    wrapped.step(wrapped.action_space.sample())
    wrapped.close()
