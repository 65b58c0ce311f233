"""Gymnasium's single and vector environments and SB3's: one behaviour, one noise for a seed."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

import fusion_gym

ENV_ID = "fusion_gym/TobitOscillator-v0"
MODES = list(AutoresetMode)
OPTIONS: list[dict[str, Any]] = [
    {},
    {"filter": "tobit", "information": "centre", "sharing": "rotating", "random_start": True},
    {"filter": "kalman", "action": "discrete", "process_noise": "full"},
]
each_option = pytest.mark.parametrize("options", OPTIONS, ids=["paper", "tobit", "kalman"])


class Step(NamedTuple):
    """What one step showed; ``observation`` is that of the new episode where one ended."""

    observation: NDArray[Any]
    reward: NDArray[Any]
    truncated: NDArray[Any]
    final: list[NDArray[Any]]
    cost: NDArray[Any]


NOTHING: Any = (np.array(0.0), np.array(False), [], np.array(0.0))


def make_vector(num_envs: int, mode: AutoresetMode, **options: Any) -> Any:
    options["autoreset_mode"] = mode
    return gymnasium.make_vec(ENV_ID, num_envs, vectorization_mode="vector_entry_point", **options)


def draw_actions(steps: int, num_envs: int, options: Any, seed: int = 0) -> NDArray[np.int64]:
    rng = np.random.default_rng(seed)
    if options.get("action") == "discrete":
        return rng.integers(0, 8, (steps, num_envs))
    return (rng.random((steps, num_envs, 3)) < 0.3).astype(np.int64)


def singles(runs: list[int], seed: int, actions: Any, **options: Any) -> Iterator[Step]:
    """The given runs as single environments, each reset at once where its episode ends."""
    envs = [gymnasium.make(ENV_ID, **options) for _ in runs]
    first = [env.reset(seed=seed + run)[0] for env, run in zip(envs, runs, strict=True)]
    yield Step(np.array(first), *NOTHING)
    for action in actions:
        results = [env.step(action[run]) for env, run in zip(envs, runs, strict=True)]
        observation, reward, terminated, truncated, info = zip(*results, strict=True)
        assert not any(terminated)
        ended = zip(envs, truncated, observation, strict=True)
        yield Step(
            np.array([env.reset()[0] if over else seen for env, over, seen in ended]),
            np.array(reward),
            np.array(truncated),
            [seen for seen, over in zip(observation, truncated, strict=True) if over],
            np.array([one["cost"] for one in info]),
        )


def vector(num_envs: int, seed: int, actions: Any, **options: Any) -> Iterator[Step]:
    """The vector environment with SAME_STEP autoreset."""
    env = make_vector(num_envs, AutoresetMode.SAME_STEP, **options)
    yield Step(env.reset(seed=seed)[0], *NOTHING)
    for action in actions:
        observation, reward, _, truncated, info = env.step(action)
        final = list(info["final_obs"][truncated]) if truncated.any() else []
        if truncated.any():
            info["cost"][truncated] = info["final_info"]["cost"][truncated]
        yield Step(observation, reward, truncated, final, info["cost"])


def same(one: Step, other: Step, runs: Any = slice(None)) -> None:
    np.testing.assert_allclose(one.observation[runs], other.observation, rtol=0, atol=1e-6)
    if other.reward.ndim:  # a step, no reset
        np.testing.assert_array_equal(one.truncated[runs], other.truncated)
        np.testing.assert_allclose(one.reward[runs], other.reward, rtol=1e-10)
        np.testing.assert_allclose(one.cost[runs], other.cost, rtol=1e-10)


@each_option
def test_three_faces_of_one_behaviour(options: dict[str, Any]) -> None:
    options = options | {"horizon": 7}
    actions = draw_actions(30, 3, options)
    reference = list(singles([0, 1, 2], 40, actions, **options))
    batched = list(vector(3, 40, actions, **options))
    sb3 = fusion_gym.make_sb3_vec_env(ENV_ID, 3, seed=40, **options)
    np.testing.assert_array_equal(sb3.reset(), batched[0].observation)
    assert sum(step.truncated.all() for step in reference) == 4
    returns, tokens = np.zeros((2, 3))
    for one, other, action in zip(batched[1:], reference[1:], actions, strict=True):
        same(one, other)
        np.testing.assert_allclose(one.final, other.final, rtol=0, atol=1e-6)
        observation, reward, done, infos = sb3.step(action)
        np.testing.assert_array_equal(done, other.truncated)
        np.testing.assert_array_equal(observation, one.observation)
        np.testing.assert_array_equal(reward, one.reward.astype(np.float32), strict=True)
        returns, tokens = returns + other.reward, tokens + other.cost
        if not done.any():
            assert infos == [{}, {}, {}]
            continue
        for run, info in enumerate(infos):
            assert info.keys() == {"terminal_observation", "TimeLimit.truncated", "episode"}
            assert info["TimeLimit.truncated"] is True
            np.testing.assert_array_equal(info["terminal_observation"], one.final[run])
            assert info["episode"].keys() == {"r", "l", "t", "cost"}
            assert info["episode"]["l"] == 7
            assert info["episode"]["r"] == pytest.approx(returns[run], rel=1e-10)
            assert info["episode"]["cost"] == pytest.approx(tokens[run], rel=1e-10)
            assert info["episode"]["t"] > 0.0
        returns, tokens = np.zeros((2, 3))


def assert_same_infos(ours: dict[str, Any], theirs: dict[str, Any]) -> None:
    assert ours.keys() == theirs.keys()
    for key, value in theirs.items():
        if isinstance(value, dict):
            assert_same_infos(ours[key], value)
            continue
        assert ours[key].dtype == value.dtype, key
        assert ours[key].shape == value.shape, key
        if value.dtype == object:
            missing = [entry is None for entry in value]
            assert [entry is None for entry in ours[key]] == missing
            for mine, other in zip(ours[key], value, strict=True):
                if other is not None:
                    np.testing.assert_allclose(mine, other, rtol=0, atol=1e-6)
        else:
            np.testing.assert_allclose(ours[key], value, rtol=1e-9, atol=1e-12, err_msg=key)


@pytest.mark.parametrize("mode", MODES)
@each_option
def test_agrees_with_the_sync_vector_environment(
    options: dict[str, Any], mode: AutoresetMode
) -> None:
    """Runs 1 and 3 are reset in mid-episode, so that episodes end at different times."""
    options = options | {"horizon": 5}
    ours = make_vector(4, mode, **options)
    options["vector_kwargs"] = {"autoreset_mode": mode}
    theirs = gymnasium.make_vec(ENV_ID, 4, vectorization_mode="sync", **options)
    assert ours.metadata["autoreset_mode"] is theirs.metadata["autoreset_mode"] is mode
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space

    def compare(mine: Any, other: Any) -> None:
        for a, b in zip(mine[:-1], other[:-1], strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-6 if a.dtype == np.float32 else 0)
        assert_same_infos(mine[-1], other[-1])

    def reset(seed: Any, mask: NDArray[np.bool_] | None) -> None:
        mine, other = ({} if mask is None else {"reset_mask": mask} for _ in range(2))
        compare(ours.reset(seed=seed, options=mine), theirs.reset(seed=seed, options=other))

    reset(3, None)
    endings: set[tuple[bool, ...]] = set()
    for number, action in enumerate(draw_actions(24, 4, options, seed=1)):
        mine, other = ours.step(action), theirs.step(action)
        compare(mine, other)
        over = other[3].copy()
        endings.add(tuple(over.tolist()))
        if mode is AutoresetMode.DISABLED and over.any():
            reset(None, over)
        if number == 1:
            reset([None, 70, None, None], np.array([False, True, False, True]))
    assert endings == {(False,) * 4, (True, False) * 2, (False, True) * 2}


@pytest.mark.parametrize("num_envs", [1, 3, 64])
@pytest.mark.parametrize(("horizon", "steps"), [(7, 30), (100, 230), (400, 810)])
def test_a_run_does_not_depend_on_its_neighbours(num_envs: int, horizon: int, steps: int) -> None:
    """Run i reset with seed s is the single environment with seed s + i, also after autoresets."""
    actions = draw_actions(steps, num_envs, {})
    runs = sorted({0, num_envs // 2, num_envs - 1})[-2:]
    alone = singles(runs, 9, actions, horizon=horizon)
    ended = 0
    for together, other in zip(vector(num_envs, 9, actions, horizon=horizon), alone, strict=True):
        same(together, other, runs)
        ended += bool(other.truncated.all())
    assert ended == steps // horizon


def test_partial_reset_leaves_the_others_alone() -> None:
    """Runs restarted at odd times, over the end of a noise block, against single environments."""
    env = make_vector(3, AutoresetMode.DISABLED, horizon=600)
    envs = [gymnasium.make(ENV_ID, horizon=600) for _ in range(3)]
    env.reset(seed=20)
    for run, single in enumerate(envs):
        single.reset(seed=20 + run)
    for number, action in enumerate(draw_actions(600, 3, {})):
        restart = np.array([number == 300, number in (37, 290), False])
        if restart.any():
            seed = 90 if number == 300 else None  # otherwise the stream goes on
            seen, _ = env.reset(seed=seed, options={"reset_mask": restart})
            for run in np.flatnonzero(restart).tolist():
                alone = envs[run].reset(seed=None if seed is None else seed + run)[0]
                np.testing.assert_allclose(seen[run], alone, rtol=0, atol=1e-6)
        observation, reward, _, truncated, _ = env.step(action)
        for run, single in enumerate(envs):
            alone = single.step(action[run])
            np.testing.assert_allclose(observation[run], alone[0], rtol=0, atol=1e-6)
            assert reward[run] == pytest.approx(alone[1], rel=1e-10)
            assert truncated[run] == alone[3]


def latent(env: Any) -> list[NDArray[Any]]:
    """Truth and, as nothing is censored, the measurements with all their noise."""
    state = env.unwrapped.batch.state
    return [state.truth.copy(), state.measurement.copy()]


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("horizon", [6, 300])
def test_common_random_numbers(horizon: int, mode: AutoresetMode) -> None:
    """Actions, filters and tokens change the estimates, never what there is to estimate."""
    common: dict[str, Any] = {"horizon": horizon, "censoring_threshold": -np.inf}
    variants = [{}, {}, {"filter": "tobit", "tokens": "unlimited"}, {"information": "centre"}]
    envs = [make_vector(4, mode, **common, **variant) for variant in variants]
    for env in envs:
        env.reset(seed=5)
    errors = np.zeros((len(envs), 4))
    for number in range(2 * horizon + 3):
        first = latent(envs[0])
        for env in envs[1:]:
            for one, other in zip(first, latent(env), strict=True):
                np.testing.assert_array_equal(one, other)
        for place, env in enumerate(envs):
            action = draw_actions(1, 4, {}, seed=1000 * place + number)[0] if place else 0
            info = env.step(np.broadcast_to(action, (4, 3)))[-1]
            errors[place] += info["squared_error"].sum(-1)
    assert len(np.unique(errors.round(6), axis=0)) == len(envs)


@pytest.mark.parametrize("mode", MODES)
def test_reset_with_a_seed_is_reproducible(mode: AutoresetMode) -> None:
    env = make_vector(3, mode, horizon=4)
    actions = draw_actions(4, 3, {})

    def play(seed: Any) -> NDArray[Any]:
        seen = [env.reset(seed=seed)[0]]
        seen += [env.step(action)[0] for action in actions]
        return np.array([*seen, env.reset()[0]])

    first = play(8)
    for seed in (8, [8, 9, 10]):
        np.testing.assert_array_equal(play(seed), first)
    np.testing.assert_array_equal(play([10, 9, 8])[:, 1], first[:, 1])
    assert not np.allclose(play(11), first)
    goes_on = play([8, None, 10])
    np.testing.assert_array_equal(goes_on[0][[0, 2]], first[0][[0, 2]])
    assert not np.allclose(goes_on[0][1], first[0][1])


def scribble(value: Any) -> None:
    """Overwrite everything in what an environment returned."""
    if isinstance(value, dict):
        for entry in value.values():
            scribble(entry)
        value["scribble"] = True
    elif isinstance(value, (list, tuple)):
        for entry in value:
            scribble(entry)
    elif isinstance(value, np.ndarray):
        if value.dtype == object:
            scribble(value.tolist())
        elif value.dtype == np.bool_:
            np.logical_not(value, out=value)
        else:
            value.fill(77)


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


@pytest.mark.parametrize("face", ["single", "sb3", *MODES], ids=str)
def test_returned_arrays_belong_to_the_caller(face: Any) -> None:
    """What was returned never changes later, and changing it changes nothing later."""

    def make() -> Any:
        if face == "single":
            return gymnasium.make(ENV_ID, horizon=3)
        if face == "sb3":
            return fusion_gym.make_sb3_vec_env(ENV_ID, 3, horizon=3)
        return make_vector(3, face, horizon=3)

    def reset(env: Any, seed: int | None, over: Any) -> Any:
        if face == "sb3":
            env.seed(seed)
            return env.reset(), env.reset_infos
        mask = {} if face == "single" or seed is not None else {"reset_mask": over}
        return env.reset(seed=seed, options=mask)

    touched, clean = make(), make()
    scribble(reset(touched, 1, None))
    kept = [reset(clean, 1, None)]
    texts = [text_of(kept[0])]
    if face not in ("single", "sb3"):
        mask = np.array([False, True, False])  # from here on episodes end at different times
        for env in (touched, clean):
            env.step(np.ones((3, 3), dtype=np.int64))
            env.reset(options={"reset_mask": mask})
    for action in draw_actions(12, 3, {}):
        action = action[0] if face == "single" else action
        mine, other = touched.step(action.copy()), clean.step(action.copy())
        assert text_of(mine) == text_of(other)
        kept.append(other)
        texts.append(text_of(other))
        over = np.copy(other[3]) if face != "sb3" else None
        for one, two in itertools.combinations(arrays_in(mine), 2):
            assert not np.may_share_memory(one, two)
        scribble(mine)
        if face in ("single", AutoresetMode.DISABLED) and np.any(over):
            mine, other = reset(touched, None, over.copy()), reset(clean, None, over.copy())
            assert text_of(mine) == text_of(other)
            scribble(mine)
    assert [text_of(entry) for entry in kept] == texts


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
    for action in draw_actions(30, 4, {}):
        observation, _, done, infos = wrapped.step(action)
        assert np.isfinite(observation).all()
        assert np.abs(observation).max() <= 4.0
        assert (wrapped.get_original_reward() < 0.0).all()
        for run in np.flatnonzero(done):
            episodes += infos[run]["episode"]["l"]
            assert infos[run]["terminal_observation"].shape == observation[run].shape
    assert episodes == 4 * 30 - env.batch.steps.sum()
    assert wrapped.obs_rms.count == pytest.approx(4 * 31, abs=0.01)
