"""One run is the same alone and among others, in every face, bit by bit."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from cases import Case, actions, each_case, each_default, each_lasting, requests
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

import fusion_gym
from fusion_gym.core.batch import Outcome
from fusion_gym.envs.single import FusionEnv
from fusion_gym.envs.vector import FusionVectorEnv, step_infos

MANY, STEPS = 1024, 8
CHOSEN = slice(515, 520)  # the middle of the many runs, on no boundary of a vector register


def same_outcome(one: Outcome, other: Outcome, here: Any, there: Any) -> None:
    """Bitwise, the runs ``here`` of the one and the runs ``there`` of the other."""
    for name, first, second in zip(one._fields, one, other, strict=True):
        np.testing.assert_array_equal(first[..., here], second[..., there], name, strict=True)


def numbers(info: dict[str, Any]) -> dict[str, Any]:
    """An info as plain numbers and lists."""
    return {
        key: numbers(value) if isinstance(value, dict) else np.asarray(value).tolist()
        for key, value in info.items()
    }


def of_run(info: dict[str, Any], run: int) -> dict[str, Any]:
    """What the info of many runs says of one."""
    return {
        key: of_run(value, run) if isinstance(value, dict) else np.asarray(value)[run].tolist()
        for key, value in info.items()
        if not key.startswith("_")
    }


@each_case
def test_one_five_and_a_thousand_runs_are_the_same(case: Case) -> None:
    """A single environment, a vector environment and 1,024 runs, observation, reward and info."""
    many = case.batch(list(range(MANY)))
    five = FusionVectorEnv(case.task(), 5)
    one = FusionEnv(case.task())
    observation, infos = five.reset(seed=CHOSEN.start)
    alone, info = one.reset(seed=CHOSEN.start + 2)
    for wanted in requests(case.task(), MANY, STEPS):
        np.testing.assert_array_equal(many.observe()[CHOSEN], observation, strict=True)
        np.testing.assert_array_equal(alone, observation[2], strict=True)
        assert numbers(info) == of_run(infos, 2)
        outcome = many.step(wanted)
        action = actions(case.task(), wanted[:, CHOSEN])
        observation, reward, *ended, infos = five.step(action)
        alone, value, *over, info = one.step(action[2])
        expected = step_infos(outcome)
        for run, place in enumerate(range(MANY)[CHOSEN]):
            assert of_run(infos, run) == of_run(expected, place)
        np.testing.assert_array_equal(outcome.reward[CHOSEN], reward, strict=True)
        np.testing.assert_array_equal(outcome.ended[CHOSEN], np.logical_or(*ended))
        assert [value, *over] == [reward[2], *(each[2] for each in ended)]


@each_lasting
def test_a_run_does_not_depend_on_its_neighbours(case: Case) -> None:
    """Run 2 begins late, and later the others begin anew at odd times."""
    alone, together = case.batch([5], 400), case.batch([90, 91, 92, 93, 94, 95, 96], 400)
    wanted = requests(case.task(), 7, 30)
    for asked in wanted[:7]:
        together.step(asked)
    together.seed(np.array([2]), [5])
    together.reset(np.array([2]))
    for step, asked in enumerate(wanted[7:]):
        np.testing.assert_array_equal(together.observe()[2], alone.observe()[0], strict=True)
        same_outcome(alone.step(asked[:, 2:3]), together.step(asked), 0, 2)
        if step in (4, 11, 12):
            others = np.array([[0, 1], [6], [1, 3, 4]][step % 3])
            together.reset(others)


@pytest.mark.parametrize("clock", [False, True])
@pytest.mark.parametrize("mode", list(AutoresetMode))
@each_default
def test_agrees_with_gymnasiums_vector_of_single_environments(
    case: Case, mode: AutoresetMode, clock: bool
) -> None:
    """Runs 1 and 3 are reset in mid-episode, so that episodes end at different times."""
    options: dict[str, Any] = {"num_envs": 4, "horizon": 5, "clock": clock}
    ours: Any = gymnasium.make_vec(
        case.env_id, vectorization_mode="vector_entry_point", autoreset_mode=mode, **options
    )
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
    for number, wanted in enumerate(requests(case.task(), 4, 20)):
        action = actions(case.task(), wanted)
        mine, other = ours.step(action), theirs.step(action)
        same(mine, other)
        over = other[2 if clock else 3].copy()
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
        for one, two in zip(mine, other, strict=True):
            same(one, two)
    elif other is None:
        assert mine is None
    else:
        np.testing.assert_array_equal(mine, other, strict=True)


@each_lasting
def test_stable_baselines_rows_are_the_vector_environments(case: Case) -> None:
    """With the episodes' sums in the infos of those that end."""
    horizon, options = 5, case.options | {"horizon": 5}
    theirs = FusionVectorEnv(case.task(horizon), 3, AutoresetMode.SAME_STEP)
    ours = fusion_gym.make_sb3_vec_env(case.env_id, 3, seed=40, **options)
    np.testing.assert_array_equal(ours.reset(), theirs.reset(seed=40)[0], strict=True)
    returns, spent = np.zeros((2, 3))
    for step, wanted in enumerate(requests(case.task(), 3, 2 * horizon + 1), start=1):
        action = actions(case.task(), wanted)
        observation, reward, done, infos = ours.step(action)
        expected, value, terminated, truncated, info = theirs.step(action)
        over = terminated if case.task().clock else truncated
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
            assert infos[run]["TimeLimit.truncated"] is not case.task().clock
            last = info["final_obs"][run]
            np.testing.assert_array_equal(infos[run]["terminal_observation"], last, strict=True)
            episode = infos[run]["episode"]
            assert (episode["r"], episode["l"], episode["cost"]) == (
                returns[run],
                horizon,
                spent[run],
            )
        returns, spent = np.zeros((2, 3))
