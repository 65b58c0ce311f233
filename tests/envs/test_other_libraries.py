"""What other libraries ask beside steps: attributes of runs, a joint state, copies, processes."""

import copy
import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TimeAwareObservation
from pettingzoo.test.state_test import test_parallel_env as pettingzoos_check_of_states

import fusion_gym

TOBIT = "fusion_gym/TobitOscillator-v1"
CORRELATED = "fusion_gym/CorrelatedTracking-v1"
BIASED = "fusion_gym/BiasedOscillator-v2"


def vector(mode: str, num_envs: int = 3, **options: Any) -> Any:
    return gym.make_vec(TOBIT, num_envs, vectorization_mode=mode, **options)


def plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


NAMES = ("observation_names", "observation_space", "action_space", "reward_space", "render_mode")


@pytest.mark.parametrize("options", [{}, {"action": "discrete", "horizon": 7}], ids=str)
def test_runs_have_the_attributes_of_single_environments(options: dict[str, Any]) -> None:
    options = {"reward": "vector", "token_rate": 1.0, **options}
    native = vector("vector_entry_point", **options)
    others = [gym.make(TOBIT, disable_env_checker=True, **options) for _ in range(3)]
    for name in NAMES:
        assert native.get_attr(name) == tuple(env.get_wrapper_attr(name) for env in others), name
    assert native.get_attr("task") == (native.task,) * 3
    (spec, *_), expected = native.get_attr("spec"), others[0].spec
    assert (spec.id, spec.max_episode_steps) == (expected.id, expected.max_episode_steps)
    native.reset(seed=5)
    for run, env in enumerate(others):
        env.reset(seed=5 + run)
    random = np.random.default_rng(0)
    visited = set()
    for _ in range(6):
        masks = native.call("action_masks")
        np.testing.assert_array_equal(masks, native.action_masks())
        for mask, env in zip(masks, others, strict=True):
            assert mask.tolist() == env.get_wrapper_attr("action_masks")().tolist()
        visited.add(str(plain(np.array(masks))))
        requests = random.integers(0, 8, 3)
        actions = requests if "action" in options else requests[:, None] >> np.arange(3) & 1
        native.step(actions)
        for action, env in zip(actions, others, strict=True):
            env.step(action)
    assert len(visited) > 1


def test_infos_have_types_and_stack_to_plain_arrays() -> None:
    """TorchRL asks each value for its type; Gymnasium stacks them by it."""
    env = gym.make(TOBIT)
    native, stacked = vector("vector_entry_point"), vector("sync")
    for kind, infos in (("reset", env.reset()[1]), ("step", env.step(np.ones(3, dtype=int))[-1])):
        assert all(isinstance(value, (np.ndarray, np.floating)) for value in infos.values())
        if kind == "reset":
            result, expected = native.reset(seed=0)[1], stacked.reset(seed=0)[1]
        else:
            actions = np.ones((3, 3), dtype=np.int8)
            result, expected = native.step(actions)[-1], stacked.step(actions)[-1]
        assert result.keys() == expected.keys()
        for key, value in expected.items():
            assert value.dtype == result[key].dtype != object, key
            np.testing.assert_array_equal(value, result[key])


def test_what_runs_do_not_have_is_refused() -> None:
    envs = vector("vector_entry_point")
    for name in ("gravity", "step", "reset", "reward_space", "_started"):
        with pytest.raises(AttributeError, match=rf"no '{name}': known are action_masks, render"):
            envs.call(name)
        with pytest.raises(AttributeError, match=name):
            envs.get_attr(name)
    with pytest.raises(AttributeError, match=r"cannot set 'token_rate'.*make a new environment"):
        envs.set_attr("token_rate", [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("env_id", "options"),
    [
        (TOBIT, {}),
        (CORRELATED, {"memory": True, "broadcast": "packets"}),
        (BIASED, {"own_number": False, "clock": True}),
    ],
)
def test_the_joint_state_is_what_all_agents_see_together(
    env_id: str, options: dict[str, Any]
) -> None:
    env = fusion_gym.parallel_env(env_id, horizon=12, **options)
    with pytest.raises(gym.error.ResetNeeded):
        env.state()
    pettingzoos_check_of_states(env)
    scheduler = gym.make(env_id, horizon=12, **options)
    common = [n for n in scheduler.unwrapped.observation_names if n in env.state_names]  # type: ignore[attr-defined]
    assert len(common) > 5
    observed = [env.state_names.index(name) for name in common]
    theirs = [scheduler.unwrapped.observation_names.index(name) for name in common]  # type: ignore[attr-defined]
    observations, infos = env.reset(seed=4)
    observation, _ = scheduler.reset(seed=4)
    assert set(map(str, infos.values())) == {str({"granted": False, "cost": 0.0})}
    random = np.random.default_rng(1)
    while env.agents:
        state = env.state()
        assert env.state_space.contains(state)
        np.testing.assert_array_equal(state[observed], observation[theirs])
        every = np.concatenate(list(observations.values()))
        numbers = np.isin(every, [0.0, 1.0])  # a sensor's own number is no part of the state
        assert np.isin(every[~numbers], state).all()
        choice = int(random.integers(len(env.agents)))
        bits = np.eye(len(env.agents), dtype=np.int8)[choice]
        observations, _, _, _, infos = env.step(dict(zip(env.agents, bits.tolist(), strict=True)))
        single = isinstance(scheduler.action_space, gym.spaces.Discrete)  # 0 is for nobody
        observation, *_ = scheduler.step(choice + 1 if single else bits)
    assert not np.array_equal(state, env.state())


@pytest.mark.parametrize("kind", ["single", "vector", "parallel"])
def test_a_copy_goes_on_alike(kind: str) -> None:
    jobs: dict[str, Any] = {
        "single": lambda: gym.make(TOBIT, horizon=9),
        "vector": lambda: vector("vector_entry_point", horizon=9),
        "parallel": lambda: fusion_gym.parallel_env(TOBIT, horizon=9),
    }
    env = jobs[kind]()
    env.reset(seed=0)
    twins = [env, copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    for _ in range(4):
        actions = {"sensor_0": 1, "sensor_1": 0, "sensor_2": 1}
        action = actions if kind == "parallel" else env.action_space.sample()
        first, *rest = (str(twin.step(action)) for twin in twins)
        assert set(rest) == {first}


@pytest.mark.parametrize("horizon", [7, 130])
def test_the_specification_knows_the_horizon(horizon: int) -> None:
    """And survives a file."""
    options = {"horizon": horizon, "filter": "tobit"}
    env = gym.make(TOBIT, **options)
    spec: Any = env.spec
    again = gym.make(gym.envs.registration.EnvSpec.from_json(spec.to_json()))
    first, other = (each.reset(seed=2)[0] for each in (env, again))
    np.testing.assert_array_equal(first, other)
    native = vector("vector_entry_point", **options)
    assert {each.spec.max_episode_steps for each in (env, again, native)} == {horizon}
    aware = TimeAwareObservation(env)
    for each, steps in (
        *((env, horizon), (again, horizon), (gym.make(spec), horizon), (aware, horizon)),
        (gym.make(TOBIT, max_episode_steps=5, **options), 5),
    ):
        assert steps_of(each) == steps
    before, _ = aware.reset(seed=0)
    after = aware.step(np.zeros(3, dtype=np.int8))[0]
    assert aware.observation_space.contains(after)
    assert after[-1] > before[-1]


def steps_of(env: Any) -> int:
    env.reset(seed=0)
    count, over = 0, False
    while not over:
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        over, count = terminated or truncated, count + 1
    return count


def test_a_vector_of_rewards_sums_to_the_reward() -> None:
    options: dict[str, Any] = {"filter": "tobit", "horizon": 6, "cost_weight": 0.3}
    env: Any = gym.make(TOBIT, reward="vector", disable_env_checker=True, **options)
    plain = gym.make(TOBIT, **options)
    env.reset(seed=3)
    plain.reset(seed=3)
    assert env.unwrapped.reward_space.shape == (2,)
    for _ in range(6):
        action = plain.action_space.sample()
        _, pair, _, _, info = env.step(action)
        assert env.unwrapped.reward_space.contains(pair)
        assert pair.sum() == pytest.approx(plain.step(action)[1])
        assert pair.tolist() == [info["reward_error"], info["reward_cost"]]


def test_a_child_process_finds_an_id_with_its_module() -> None:
    """A child that has not imported the package does so by the name before the colon."""
    options: dict[str, Any] = {"horizon": 4, "filter": "tobit"}
    envs = gym.make_vec(
        f"fusion_gym:{TOBIT}", 1, vectorization_mode="async",
        vector_kwargs={"context": "spawn"}, **options,
    )  # fmt: skip
    action = np.ones((1, 3), dtype=np.int8)
    try:
        rows = [envs.reset(seed=3)[0]] + [envs.step(action)[0] for _ in range(3)]
    finally:
        envs.close()
    env = gym.make(TOBIT, **options)
    expected = [env.reset(seed=3)[0]] + [env.step(action[0])[0] for _ in range(3)]
    np.testing.assert_array_equal(np.concatenate(rows), expected)
