"""The scale of reward and features: ``reward_scale``."""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import PPO

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.scale import nominal_rate
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.policies.saved import tag_model
from fusion_gym.validation import ConfigurationError

LINEAR = "fusion_gym/LinearFusion-v2"
OPTIONS: dict[str, dict[str, Any]] = {
    LINEAR: {},
    "fusion_gym/TobitOscillator-v1": {"filter": "tobit"},
    "fusion_gym/CorrelatedTracking-v1": {},
    "fusion_gym/MarkovJumpTracking-v1": {},
    "fusion_gym/UnknownInput-v1": {},
    "fusion_gym/BiasedOscillator-v2": {"access": "any"},
    "fusion_gym/BiasedTracking-v1": {"access": "any"},
    "fusion_gym/RemoteEstimation-v1": {"sensors": 2},
}
# A target whose position drifts far where nobody transmits.
DRIFT: dict[str, Any] = {
    "transition": [[1, 0.5], [0, 1]],
    "process_covariance": [[0.01, 0.03], [0.03, 0.1]],
    "measurement_matrices": [[1, 0], [1, 0], [1, 0]],
    "measurement_covariances": [0.1, 0.5, 2.0],
    "token_rate": 1.5,
}


def error_cost(task: Task, policy: str, episodes: int = 400) -> float:
    """The reward's error term a step, of fresh episodes."""
    results = run_episodes(task, make_policy(policy, task), episodes, 0)
    weights = task.reward.error_weight * task.reward.state_weights[:, 0]
    return float((results.squared_error.mean(0) @ weights).mean())


@pytest.mark.parametrize("env_id", OPTIONS)
def test_an_even_pace_costs_about_one_a_step(env_id: str) -> None:
    task = fusion_gym.make_task(env_id, reward_scale="auto", **OPTIONS[env_id])
    rate = nominal_rate(task.network)
    assert error_cost(task, f"paced:rate={rate}") == pytest.approx(1.0, rel=0.12)


@pytest.mark.parametrize("access", ["round_robin", "random", "single"])
def test_the_pace_keeps_to_the_turns_of_the_access_rule(access: str) -> None:
    auto = fusion_gym.make_task(LINEAR, access=access, tokens="unlimited", **DRIFT)
    assert nominal_rate(auto.network) == pytest.approx(1.0 / 12.0)
    assert error_cost(auto, "never") > 100.0
    assert error_cost(auto, "paced:rate=1") < 1.0


def test_without_tokens_the_scale_is_open_loop() -> None:
    task = fusion_gym.make_task(LINEAR, token_rate=0, initial_tokens=0, **{
        key: value for key, value in DRIFT.items() if key != "token_rate"})  # fmt: skip
    assert task.reward.state_weights[:, 0] @ task.open_loop[:, 0] == pytest.approx(1.0, rel=0.005)


def test_filters_departures_and_settings_share_one_scale() -> None:
    usual = fusion_gym.make_task(LINEAR, **DRIFT)
    for other in (
        {"filter": "adf"},
        {"filter": "kalman", "fusion": "ci"},
        {"true_process_noise": 2.0, "memory": True},
        {"error_weight": 3.0, "cost_weight": 0.1},
    ):
        task = fusion_gym.make_task(LINEAR, **DRIFT, **other)
        assert task.settings["reward_scale"] == usual.settings["reward_scale"]
        np.testing.assert_array_equal(task.nominal_error, usual.nominal_error)
    again = fusion_gym.make_task(LINEAR, **usual.settings)
    np.testing.assert_array_equal(again.reward.state_weights, usual.reward.state_weights)


def test_given_weights_stay_and_a_number_multiplies() -> None:
    given = fusion_gym.make_task(LINEAR, state_weights=[1, 3], **DRIFT)
    assert given.reward.state_weights[:, 0].tolist() == [1, 3]
    assert given.settings["reward_scale"] == 1.0
    twice = fusion_gym.make_task(LINEAR, state_weights=[1, 3], reward_scale=2, **DRIFT)
    assert twice.reward.state_weights[:, 0].tolist() == [2, 6]


def test_units_change_no_reward_and_no_belief() -> None:
    """A plant in millimetres pays and shows what it does in metres."""
    shown = []
    for unit in (1.0, 1e3):
        plant = {
            "transition": DRIFT["transition"],
            "process_covariance": np.array(DRIFT["process_covariance"]) * unit**2,
            "initial_covariance": np.eye(2) * unit**2,
            "measurement_matrices": DRIFT["measurement_matrices"],
            "measurement_covariances": np.array(DRIFT["measurement_covariances"]) * unit**2,
        }
        batch = EpisodeBatch.seeded(fusion_gym.make_task(LINEAR, memory=True, **plant), 5, 0)
        rewards = [batch.step(np.eye(3, 5) > step % 3).reward for step in range(20)]
        names = list(batch.layout.names)
        beliefs = [i for i, name in enumerate(names) if name.startswith(("belief", "transmission"))]
        shown.append((np.array(rewards), batch.observe()[:, beliefs]))
    for first, second in zip(*shown, strict=True):
        np.testing.assert_allclose(first, second, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), "open", [1.0, 2.0]])
def test_other_scales_are_refused(value: object) -> None:
    with pytest.raises(ConfigurationError, match="reward_scale = "):
        fusion_gym.make_task(LINEAR, reward_scale=value)


def test_a_plant_without_error_is_refused() -> None:
    still = {"process_covariance": np.zeros((2, 2)), "initial_covariance": np.zeros((2, 2))}
    with pytest.raises(ConfigurationError):
        fusion_gym.make_task(LINEAR, **still)


@pytest.mark.parametrize("local", [False, True])
def test_a_model_sees_beliefs_in_the_scale_of_its_training(tmp_path: Path, local: bool) -> None:
    options = DRIFT | {"belief_features": True}
    envs = fusion_gym.make_sb3_vec_env(LINEAR, num_envs=4, seed=0, local=local, **options)
    model = PPO("MlpPolicy", envs, n_steps=8, batch_size=32, seed=0, device="cpu")
    trained = fusion_gym.make_task(LINEAR, **options)
    tag_model(model, trained, local)
    path = tmp_path / "agent.zip"
    model.save(path)
    other = fusion_gym.make_task(LINEAR, **options | {"token_rate": 0.3})
    assert not np.allclose(other.nominal_error, trained.nominal_error, rtol=0.5)
    policy = make_policy(f"model:{path}", other)
    owner = "own" if local else None
    shown = policy.view.rows(EpisodeBatch.seeded(trained, 3, 0, owner).observe())
    rows = policy.rows(EpisodeBatch.seeded(other, 3, 0, owner).signals())
    np.testing.assert_allclose(rows, shown, atol=1e-6)
    with zipfile.ZipFile(path) as archive:
        assert "nominal_error" in archive.read("data").decode()


def test_a_model_with_a_card_without_a_scale_is_refused(tmp_path: Path) -> None:
    options = {"belief_features": True}
    envs = fusion_gym.make_sb3_vec_env(LINEAR, num_envs=2, seed=0, **options)
    model = PPO("MlpPolicy", envs, n_steps=8, batch_size=16, seed=0, device="cpu")
    tag_model(model, fusion_gym.make_task(LINEAR, reward_scale=None, **options))
    model.save(tmp_path / "agent.zip")
    with pytest.raises(ConfigurationError, match="nominal_error = None is not allowed"):
        make_policy(f"model:{tmp_path / 'agent.zip'}", fusion_gym.make_task(LINEAR, **options))


FRONT: dict[str, Any] = {"memory": True, "cost_weight": "random", "price_range": "auto"}


@pytest.mark.slow
def test_prices_reach_from_60_to_12_percent_of_what_is_sustained() -> None:
    """At the ends of the range the cheapest of many thresholds sends about that much."""
    task = fusion_gym.make_task(LINEAR, **FRONT, **DRIFT)
    assert task.settings["price_range"] == list(task.reward.price.span or ())
    shares = []
    for price in task.reward.price.span or ():
        costs = {}
        for threshold in price * np.geomspace(0.05, 1.0, 13):
            rule = f"value_of_information:price={threshold:g},at_most=1"
            results = run_episodes(task, make_policy(rule, task), 200, 0)
            cost = float((results.error_cost + price * results.tokens).mean())
            costs[cost] = float(results.tokens.mean()) / 1.5
        shares.append(costs[min(costs)])
    assert shares == pytest.approx([0.6, 0.12], rel=0.25)


def test_units_and_filters_change_no_prices() -> None:
    usual = fusion_gym.make_task(LINEAR, **FRONT, **DRIFT).reward.price.span
    for other in ({"filter": "adf"}, {"true_process_noise": 2.0}):
        assert fusion_gym.make_task(LINEAR, **FRONT, **DRIFT, **other).reward.price.span == usual
    low, high = usual or (0.0, 0.0)
    double = fusion_gym.make_task(LINEAR, error_weight=2.0, **FRONT, **DRIFT).reward.price.span
    assert double == pytest.approx((2.0 * low, 2.0 * high), rel=0.01)


def test_short_episodes_keep_two_packets_of_each_sensor() -> None:
    long = fusion_gym.make_task(LINEAR, **FRONT, **DRIFT).reward.price.span
    short = fusion_gym.make_task(LINEAR, horizon=25, **FRONT, **DRIFT).reward.price.span
    assert long is not None
    assert short is not None
    assert short[1] < 0.5 * long[1]


def test_prices_reach_over_a_factor_of_two_at_least() -> None:
    """In four steps two packets of each sensor are more than 60 % of what is sustained."""
    span = fusion_gym.make_task(LINEAR, horizon=4, **FRONT, **DRIFT).reward.price.span
    assert span is not None
    assert span[1] == pytest.approx(2.0 * span[0], rel=0.01)


@pytest.mark.parametrize("value", ["open", [2.0, 1.0], [1.0, 1.0], 3.0])
def test_other_prices_are_refused(value: object) -> None:
    with pytest.raises(ConfigurationError, match="price_range = "):
        fusion_gym.make_task(LINEAR, cost_weight="random", price_range=value)


def test_prices_are_refused_where_transmissions_bring_nothing() -> None:
    blind = {"measurement_covariances": 1e12, "initial_covariance": np.eye(2) * 1e-3}
    with pytest.raises(ConfigurationError, match="price_range = 'auto' is not allowed here"):
        fusion_gym.make_task(LINEAR, **FRONT, **blind)
