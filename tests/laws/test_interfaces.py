"""Laws of the interfaces: the other libraries' own checks, and what an id promises."""

import functools
import inspect
import re
import warnings
from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import gymnasium
import numpy as np
import pytest
from cases import CASES, IDS, PAIRS, QUALITY, Case, each_id, requests, short
from cases import actions as usual_actions
from gymnasium.utils.env_checker import check_env as gymnasium_check
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from own_system import OWN_ID, WalkOptions, build
from pettingzoo.test import parallel_api_test, parallel_seed_test
from refusals import refused
from stable_baselines3.common.env_checker import check_env as sb3_check

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import CommonOptions, Task
from fusion_gym.envs import registered
from fusion_gym.envs.registration import class_name, options_of
from fusion_gym.envs.single import FusionEnv
from fusion_gym.envs.vector import FusionVectorEnv
from fusion_gym.envs.views import SensorView
from fusion_gym.validation import ConfigurationError

COMMON_CASES = [
    case
    for case in CASES
    if not set(case.options) - {"information", "access", "clock", "error", "action", "error_weight"}
]
ASSIGNED = PAIRS | {"channel": "independent", "drop_probability": QUALITY, "action": "assignment"}
COMMON_CASES += [Case(i, ASSIGNED) for i in IDS if short(i) == "CorrelatedTracking"]
each_case = pytest.mark.parametrize("case", COMMON_CASES, ids=str)
each_default = pytest.mark.parametrize("case", [c for c in CASES if not c.options], ids=str)


@pytest.fixture(autouse=True)
def every_warning_is_an_error() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def actions(task: Task, request: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Actions (runs, …), of which those of an assignment give two channels to two sensors."""
    if task.options.action == "assignment":
        return request[:2].T * np.array([3, 1])
    return usual_actions(task, request)


def has_local_view(make: Any, case: Case) -> bool:
    """Whether sensors can decide by themselves; else ``make`` refuses it."""
    memory = case.local_memory if case.task().options.memory else case.local
    if memory and case.task().options.action != "assignment":
        return True
    message = r"(information = 'centre'|delay = |action = 'assignment' .*local view)"
    with pytest.raises(ConfigurationError, match=message):
        make(case.env_id, **case.options)
    return False


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
    if not has_local_view(fusion_gym.parallel_env, case):
        return
    env, task = fusion_gym.parallel_env(case.env_id, **case.options), case.task()
    view, bucket = SensorView(task), task.network.bucket
    batch = case.batch(1, 7, view.owner)
    observations, _ = env.reset(seed=7)
    assert env.possible_agents == [f"sensor_{m}" for m in range(task.sensors)]
    for request in requests(task, 1, 6):
        rows = np.stack(list(observations.values()))
        np.testing.assert_array_equal(rows, view.rows(batch.observe(local=True)))
        outcome = batch.step(request)
        selection = dict(zip(env.agents, request[:, 0].astype(int).tolist(), strict=True))
        observations, rewards, terminated, truncated, infos = env.step(selection)
        assert set(rewards.values()) == {outcome.reward[0]}
        assert not any(terminated.values())
        assert not any(truncated.values())
        granted = [info["granted"] for info in infos.values()]
        assert granted == outcome.granted[:, 0].tolist()
        costs = [info["cost"] for info in infos.values()]
        np.testing.assert_array_equal(costs, outcome.granted[:, 0] * bucket.cost[:, 0])


@each_case
def test_sensors_rows_of_stable_baselines_are_the_schedulers_runs(case: Case) -> None:
    make = functools.partial(fusion_gym.make_sb3_vec_env, num_envs=3, seed=3, local=True)
    if not has_local_view(make, case):
        return
    options = case.options | {"horizon": 5}
    local = make(case.env_id, **options)
    whole = fusion_gym.make_sb3_vec_env(case.env_id, 3, seed=3, **options)
    whole.batch = EpisodeBatch(whole.task, 3, local.view.owner)  # remembers for whom it is compared
    whole.view.local = True  # and supposes what the sensors suppose
    sensors = case.task().sensors
    assert local.num_envs == 3 * sensors
    np.testing.assert_array_equal(local.reset(), local.view.rows(whole.reset()))
    for step, request in enumerate(requests(case.task(), 3, 6), start=1):
        rows, row_reward, row_done, row_infos = local.step(request.T.ravel().astype(np.int64))
        plain, reward, done, infos = whole.step(actions(case.task(), request))
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


@pytest.mark.parametrize("more", [{}, {"clock": True}, ASSIGNED], ids=["time", "clock", "pairs"])
@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_agrees_with_gymnasiums_vector_of_single_environments(
    mode: AutoresetMode, more: dict[str, Any]
) -> None:
    """Runs 1 and 3 are reset in mid-episode, so that episodes end at different times."""
    case = Case(CASES[0].env_id, more)
    task = case.task()
    options: dict[str, Any] = {"num_envs": 4, "horizon": 5} | more
    ours: Any = gymnasium.make_vec(case.env_id, autoreset_mode=mode, **options)
    options["vector_kwargs"] = {"autoreset_mode": mode}
    theirs: Any = gymnasium.make_vec(case.env_id, vectorization_mode="sync", **options)
    assert ours.metadata["autoreset_mode"] is theirs.metadata["autoreset_mode"] is mode
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space

    def reset(seed: Any, mask: NDArray[np.bool_] | None) -> None:
        mine, other = ({} if mask is None else {"reset_mask": mask.copy()} for _ in range(2))
        same(ours.reset(seed=seed, options=mine), theirs.reset(seed=seed, options=other))

    reset(3, None)
    endings = set()
    for number, request in enumerate(requests(task, 4, 20)):
        action = actions(task, request)
        mine, other = ours.step(action), theirs.step(action)
        same(mine, other)
        over = other[2 if task.options.clock else 3].copy()
        endings.add(tuple(over.tolist()))
        if mode is AutoresetMode.DISABLED and over.any():
            reset(None, over)
        if number == 1:
            reset([None, 70, None, None], np.array([False, True, False, True]))
    assert endings == {(False,) * 4, (True, False) * 2, (False, True) * 2}


def same(mine: Any, other: Any) -> None:
    """Bitwise and of the same types, through dictionaries, tuples and arrays of objects."""
    if isinstance(other, dict):
        assert mine.keys() == other.keys()
        for key, value in other.items():
            same(mine[key], value)
    elif isinstance(other, tuple) or (isinstance(other, np.ndarray) and other.dtype == object):
        assert len(mine) == len(other)
        for first, two in zip(mine, other, strict=True):
            same(first, two)
    elif other is None:
        assert mine is None
    else:
        np.testing.assert_array_equal(mine, other, strict=True)


@each_case
def test_stable_baselines_rows_are_the_vector_environments(case: Case) -> None:
    """With the episodes' sums in the infos of those that end."""
    horizon, options = 5, case.options | {"horizon": 5}
    task = case.task(horizon=5)
    theirs = FusionVectorEnv(task, 3, AutoresetMode.SAME_STEP)
    ours = fusion_gym.make_sb3_vec_env(case.env_id, 3, seed=40, **options)
    np.testing.assert_array_equal(ours.reset(), theirs.reset(seed=40)[0], strict=True)
    returns, spent = np.zeros((2, 3))
    for step, request in enumerate(requests(task, 3, 2 * horizon + 1), start=1):
        action = actions(task, request)
        observation, reward, done, infos = ours.step(action)
        expected, value, terminated, truncated, info = theirs.step(action)
        over = terminated if task.options.clock else truncated
        np.testing.assert_array_equal(observation, expected, strict=True)
        np.testing.assert_array_equal(reward, value.astype(np.float32), strict=True)
        np.testing.assert_array_equal(done, over)
        assert over.all() == (step % horizon == 0)
        returns += value
        spent += info["final_info"]["cost"] if over.all() else info["cost"]
        if not over.all():
            assert infos == [{}, {}, {}]
            continue
        for run in range(3):
            assert infos[run].keys() == {"terminal_observation", "TimeLimit.truncated", "episode"}
            assert infos[run]["TimeLimit.truncated"] is not task.options.clock
            last = info["final_obs"][run]
            np.testing.assert_array_equal(infos[run]["terminal_observation"], last, strict=True)
            episode = infos[run]["episode"]
            sums = returns[run], horizon, spent[run]
            assert (episode["r"], episode["l"], episode["cost"]) == sums
        returns, spent = np.zeros((2, 3))


@each_id
def test_an_id_makes_every_interface(env_id: str) -> None:
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
    vector: Any = gymnasium.make_vec(env_id, 2, **{limit: 3})
    assert vector.task.horizon == 3
    vector.reset(seed=0)
    for step in range(1, 9):
        if step % 4 == 1:
            single.reset()
        if step % 4 == 0 and limit == "horizon":
            with pytest.raises(gymnasium.error.ResetNeeded):
                single.step(single.action_space.sample())
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
        parameters = inspect.signature(getattr(registered, name)).parameters
        file = {"system": None, "max_episode_steps": None}
        assert {key: item.default for key, item in parameters.items()} == first | options | file
        for key in options:
            assert parameters[key].kind is inspect.Parameter.KEYWORD_ONLY


@each_default
def test_an_unknown_option_is_named(case: Case) -> None:
    for make in (
        lambda **options: gymnasium.make(case.env_id, **options),
        lambda **options: fusion_gym.make_sb3_vec_env(case.env_id, 2, **options),
        lambda **options: fusion_gym.parallel_env(case.env_id, **options),
    ):
        message = f"{case.env_id} got an unexpected keyword argument "
        for kind in (ConfigurationError, TypeError):
            refused(lambda make=make: make(colour="red"), message, "known are access", kind=kind)
            refused(lambda make=make: make(horizn=1), message, "mean 'horizon'?", kind=kind)


# Options that may be negative.
SIGNED = {"true_threshold_shift", "censoring_threshold", "censoring_upper", "noise_coupling"}
SIGNED |= {"coefficient", "input_phase", "input_amplitude"}


@each_id
@pytest.mark.parametrize("value", ["no such word", float("nan"), {}, ((1.0,), (2.0, 3.0)), -1.0])
def test_what_an_option_cannot_be_is_refused_by_name(env_id: str, value: Any) -> None:
    """Where the library checks the options."""
    for option in (field.name for field in fields(options_of(env_id))):
        allowed = (value == -1.0 and option in SIGNED) or (value == {} and option == "env_kwargs")
        if env_id != OWN_ID and not allowed:
            make = functools.partial(fusion_gym.make_task, env_id, **{option: value})
            message = refused(make, " allowed")
            assert re.match(rf"{option}(\[\d\])? = ", message)
            assert not isinstance(value, str) or f"{option} = {value!r}" in message


def test_an_environment_of_ones_own_is_registered_once() -> None:
    fusion_gym.register(OWN_ID, build)
    assert fusion_gym.make_task(WalkOptions(q=2.0)).settings["q"] == 2.0
    assert isinstance(gymnasium.make(OWN_ID).unwrapped, FusionEnv)
    assert issubclass(registered.mine_RandomWalk_v0VectorEnv, FusionVectorEnv)
    with pytest.raises(ConfigurationError, match="registered already"):
        fusion_gym.register(OWN_ID, lambda selection: build(selection))
    refused(lambda: fusion_gym.register("mine/Other-v0"), "build = None")
    refused(lambda: fusion_gym.make_task("mine/Other-v0"), "unknown environment 'mine/Other-v0'")
