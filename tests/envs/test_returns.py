"""The measured returns of every environment, and the threshold of its specification."""

import warnings

import gymnasium
import numpy as np
import pytest

import fusion_gym
from fusion_gym import seeds
from fusion_gym.envs.registration import ENVIRONMENTS
from fusion_gym.envs.returns import NAIVE, TUNED, ReturnRow, read_returns, returns_of, share_text
from fusion_gym.evaluation.episodes import run_episodes

OWN = [name for name in ENVIRONMENTS if name.startswith("fusion_gym/")]
KINDS = {*NAIVE, *TUNED, "PPO", "PPO, defaults"}


def rows_of(env_id: str) -> dict[str, ReturnRow]:
    return {row.kind: row for row in read_returns() if row.environment == env_id}


@pytest.mark.parametrize("env_id", OWN)
def test_the_threshold_of_an_environment_is_what_its_tuned_rule_returns(env_id: str) -> None:
    rows = rows_of(env_id)
    assert rows.keys() - {"bound", "SAC, thresholds"} == KINDS
    threshold = gymnasium.spec(env_id).reward_threshold
    assert threshold == max(rows[kind].mean for kind in TUNED)
    assert threshold > max(rows[kind].mean for kind in NAIVE)
    bound = rows.get("bound")
    assert bound is None or all(row.mean - row.half_width <= bound.mean for row in rows.values())


@pytest.mark.parametrize("kind", ["always", "best threshold"])
@pytest.mark.parametrize("env_id", OWN)
def test_a_rule_returns_what_the_table_says(env_id: str, kind: str) -> None:
    """In the first 40 of its episodes, to what their mean and the table's interval allow."""
    row, task = rows_of(env_id)[kind], fusion_gym.make_task(env_id)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the windows of a recording repeat
        policy = fusion_gym.make_policy(row.policy, task)
        returns = run_episodes(task, policy, 40, seeds.TEST.start).returns
    error = max(returns.std(), row.half_width / 1.96 * 1000**0.5) / 40**0.5
    assert returns.mean() == pytest.approx(row.mean, abs=4.5 * error + 1e-9)


@pytest.mark.parametrize("kind", ["PPO", "PPO, defaults"])
@pytest.mark.parametrize("env_id", OWN)
def test_ppo_closes_most_of_the_gap_to_the_best_threshold(env_id: str, kind: str) -> None:
    """In the median of three trainings, with README's lines and with other defaults."""
    returns = returns_of(env_id)
    low, high = max(returns[name][0] for name in NAIVE), returns["best threshold"][0]
    assert len(returns[kind]) == 3
    share = (np.median(returns[kind]) - low) / (high - low)
    assert share >= 0.6
    assert share_text(env_id, kind).startswith(f"{share:.0%} (")


def test_continuous_actions_are_measured_in_two_environments() -> None:
    measured = [env_id for env_id in OWN if "SAC, thresholds" in returns_of(env_id)]
    assert measured == ["fusion_gym/LinearFusion-v2", "fusion_gym/RemoteEstimation-v1"]


def test_an_environment_of_a_user_has_no_threshold() -> None:
    spec = gymnasium.spec("fusion_gym/LinearFusion-v2")
    assert spec.reward_threshold is not None
    fusion_gym.register("mine/Returns-v0", ENVIRONMENTS["fusion_gym/LinearFusion-v2"])
    try:
        assert gymnasium.spec("mine/Returns-v0").reward_threshold is None
    finally:
        ENVIRONMENTS.pop("mine/Returns-v0")
        gymnasium.registry.pop("mine/Returns-v0")
