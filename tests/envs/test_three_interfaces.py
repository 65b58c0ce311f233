"""Seeds and arrays of Gymnasium's and SB3's environments, and what SB3 expects beside steps."""

import itertools
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

import fusion_gym

ENV_ID = "fusion_gym/TobitOscillator-v1"
MODES = list(AutoresetMode)


def make_vector(num_envs: int, mode: AutoresetMode, **options: Any) -> Any:
    options["autoreset_mode"] = mode
    return gymnasium.make_vec(ENV_ID, num_envs, vectorization_mode="vector_entry_point", **options)


def draw_actions(steps: int, num_envs: int) -> NDArray[np.int64]:
    return (np.random.default_rng(0).random((steps, num_envs, 3)) < 0.3).astype(np.int64)


def scribble(value: Any) -> None:
    """Overwrite everything in what an environment returned."""
    if isinstance(value, dict):
        scribble(list(value.values()))
        value["scribble"] = True
    elif isinstance(value, (list, tuple)):
        for entry in value:
            scribble(entry)
    elif isinstance(value, np.ndarray):
        if value.dtype == object:
            scribble(value.tolist())
        else:
            value[...] = ~value if value.dtype == np.bool_ else 77


def text_of(value: Any) -> str:
    """Everything in what an environment returned but wall times, digit by digit."""
    if isinstance(value, dict):
        return str({key: text_of(value[key]) for key in value if key != "t"})
    if isinstance(value, (list, tuple)):
        return str([text_of(entry) for entry in value])
    return text_of(value.tolist()) if isinstance(value, np.ndarray) else repr(value)


def arrays_in(value: Any) -> list[NDArray[Any]]:
    if isinstance(value, (dict, list, tuple)):
        entries = value.values() if isinstance(value, dict) else value
        return [array for entry in entries for array in arrays_in(entry)]
    return [value] if isinstance(value, np.ndarray) else []


@pytest.mark.parametrize("backend", ["numpy", "compiled"])
@pytest.mark.parametrize("interface", ["single", "sb3", *MODES], ids=str)
def test_returned_arrays_belong_to_the_caller(interface: Any, backend: str) -> None:
    """What was returned never changes later, and changing it changes nothing later."""

    def make() -> Any:
        if interface == "single":
            return gymnasium.make(ENV_ID, horizon=3, backend=backend)
        if interface == "sb3":
            return fusion_gym.make_sb3_vec_env(ENV_ID, 3, horizon=3, backend=backend)
        return make_vector(3, interface, horizon=3, backend=backend)

    def reset(env: Any, seed: int | None, over: Any) -> Any:
        if interface == "sb3":
            env.seed(seed)
            return env.reset(), env.reset_infos
        mask = {} if interface == "single" or seed is not None else {"reset_mask": over}
        return env.reset(seed=seed, options=mask)

    touched, clean = make(), make()
    scribble(reset(touched, 1, None))
    stored = [reset(clean, 1, None)]
    texts = [text_of(stored[0])]
    if interface not in ("single", "sb3"):
        mask = np.array([False, True, False])  # from here on episodes end at different times
        for env in (touched, clean):
            env.step(np.ones((3, 3), dtype=np.int64))
            env.reset(options={"reset_mask": mask})
    for action in draw_actions(12, 3):
        action = action[0] if interface == "single" else action
        mine, other = touched.step(action.copy()), clean.step(action.copy())
        assert text_of(mine) == text_of(other)
        stored.append(other)
        texts.append(text_of(other))
        over = np.copy(other[3]) if interface != "sb3" else None
        for first, two in itertools.combinations(arrays_in(mine), 2):
            assert not np.may_share_memory(first, two)
        scribble(mine)
        if interface in ("single", AutoresetMode.DISABLED) and np.any(over):
            mine, other = reset(touched, None, over.copy()), reset(clean, None, over.copy())
            assert text_of(mine) == text_of(other)
            scribble(mine)
    assert [text_of(entry) for entry in stored] == texts


def test_sb3_seeds_and_options_count_once() -> None:
    env = fusion_gym.make_sb3_vec_env(ENV_ID, 2, seed=30, horizon=5)
    single = gymnasium.make(ENV_ID, horizon=5)
    np.testing.assert_allclose(env.reset()[0], single.reset(seed=30)[0], atol=1e-6)
    np.testing.assert_allclose(env.reset()[0], single.reset()[0], atol=1e-6)
    assert env.seed(60) == [60, 61]
    np.testing.assert_allclose(env.reset()[0], single.reset(seed=60)[0], atol=1e-6)
    assert env.reset_infos == [{}, {}]
    env.set_options({"colour": "red"})
    with pytest.raises(ValueError, match="unknown reset option 'colour'"):
        env.reset()


@pytest.mark.parametrize(
    ("num_envs", "horizon", "first"), [(4, 8, [8, 6, 4, 2]), (5, 3, [3, 3, 2, 2, 1]), (1, 6, [6])]
)
def test_stagger_spreads_the_first_episodes_only(
    num_envs: int, horizon: int, first: list[int]
) -> None:
    env = fusion_gym.make_sb3_vec_env(ENV_ID, num_envs, seed=0, stagger=True, horizon=horizon)
    for _ in range(2):
        lengths: list[list[int]] = [[] for _ in range(num_envs)]
        env.reset()
        for _ in range(4 * horizon):
            *_, done, infos = env.step(np.zeros((num_envs, 3), dtype=np.int64))
            for run in np.flatnonzero(done):
                lengths[run].append(infos[run]["episode"]["l"])
        assert [entry[0] for entry in lengths] == first
        assert {length for entry in lengths for length in entry[1:]} == {horizon}


def test_sb3_wrappers_and_attributes() -> None:
    env = fusion_gym.make_sb3_vec_env(ENV_ID, 4, seed=0, stagger=True, horizon=6)
    assert env.env_is_wrapped(Monitor) == [True] * 4
    assert env.get_attr("task", indices=[0, 2]) == [env.task] * 2
    with pytest.raises(AttributeError, match="colour"):
        env.set_attr("colour", "red")
    with pytest.raises(AttributeError, match="paint"):
        env.env_method("paint")
    with pytest.warns(UserWarning, match="already wrapped with a `Monitor`"):
        monitored = VecMonitor(env)
    wrapped = VecNormalize(monitored, clip_obs=4.0)
    observation = wrapped.reset()
    assert observation.shape == (4, len(env.observation_names))
    episodes = 0
    for action in draw_actions(30, 4):
        observation, _, done, infos = wrapped.step(action)
        assert np.isfinite(observation).all()
        assert np.abs(observation).max() <= 4.0
        assert (wrapped.get_original_reward() < 0.0).all()
        for run in np.flatnonzero(done):
            episodes += infos[run]["episode"]["l"]
            assert infos[run]["terminal_observation"].shape == observation[run].shape
    assert episodes == 4 * 30 - env.batch.steps.sum()
    assert wrapped.obs_rms.count == pytest.approx(4 * 31, abs=0.01)
