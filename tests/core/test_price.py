"""The price of a token: fixed, drawn for each episode, seen by the policy."""

from typing import Any

import numpy as np
import pytest

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.reward import Price, equal_weights
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

ENV_ID = "fusion_gym/TobitOscillator-v1"
SPAN = (0.001, 0.1)


def started(runs: int, **options: Any) -> EpisodeBatch:
    return EpisodeBatch.seeded(fusion_gym.make_task(ENV_ID, **options), runs, 0)


def test_a_random_price_is_even_in_the_logarithm_and_observed() -> None:
    batch = started(4000, cost_weight="random", price_range=SPAN)
    place = np.log(batch.price / SPAN[0]) / np.log(SPAN[1] / SPAN[0])
    assert place.min() >= 0.0
    assert place.max() < 1.0
    assert place.mean() == pytest.approx(0.5, abs=4 * np.sqrt(1 / 12 / 4000))
    assert place.std() == pytest.approx(np.sqrt(1 / 12), abs=0.01)
    entry = batch.layout.names.index("price")
    np.testing.assert_allclose(batch.observe()[:, entry], place, atol=1e-6)
    np.testing.assert_array_equal(batch.signals()["price"], batch.price)


def test_every_episode_draws_its_own_price() -> None:
    batch = started(2, cost_weight="random", price_range=SPAN)
    first = batch.price.copy()
    batch.reset(np.array([1]))
    assert batch.price[0] == first[0]
    assert batch.price[1] != first[1]
    assert started(2, cost_weight="random", price_range=SPAN).price[1] == first[1]


def test_an_agent_is_asked_at_any_price(tmp_path: Any) -> None:
    from stable_baselines3 import PPO

    from fusion_gym.envs.sb3 import FusionSB3VecEnv
    from fusion_gym.policies.saved import ModelPolicy, tag_model

    options = {"filter": "tobit", "cost_weight": "random", "price_range": SPAN}
    task = fusion_gym.make_task(ENV_ID, **options)
    model = PPO("MlpPolicy", FusionSB3VecEnv(task, 4), n_steps=8, batch_size=16, device="cpu")
    tag_model(model, task)
    path = tmp_path / "model.zip"
    model.save(path)
    fixed = fusion_gym.make_task(ENV_ID, **(options | {"cost_weight": 0.05}))
    requests = make_policy(f"model:{path},price=0.05", task)
    own = make_policy(f"model:{path}", fixed)
    np.testing.assert_array_equal(
        run_episodes(task, requests, 5, seed=0).mse, run_episodes(fixed, own, 5, seed=0).mse
    )
    unseen = fusion_gym.make_task(ENV_ID, filter="tobit", cost_weight=0.002)
    for price in (0.05, 0.01):
        here = make_policy(f"model:{path},price={price}", unseen)
        there = make_policy(f"model:{path},price={price}", task)
        np.testing.assert_array_equal(
            run_episodes(unseen, here, 5, seed=0).mse, run_episodes(task, there, 5, seed=0).mse
        )
    by_itself = run_episodes(unseen, make_policy(f"model:{path}", unseen), 5, seed=0)
    own = run_episodes(unseen, make_policy(f"model:{path},price=0.002", unseen), 5, seed=0)
    np.testing.assert_array_equal(by_itself.mse, own.mse)
    with pytest.raises(ConfigurationError, match=r"price_range = \[0.001, 0.1\]"):
        make_policy(f"model:{path},price=0.5", task)
    plain = PPO("MlpPolicy", FusionSB3VecEnv(unseen, 4), device="cpu")
    with pytest.raises(ConfigurationError, match=r"price = 0\.05 is not allowed"):
        ModelPolicy(plain, unseen, price=0.05)


@pytest.mark.parametrize("local", [False, True])
def test_rewards_of_a_training_over_prices_are_scaled_and_returns_are_not(local: bool) -> None:
    from fusion_gym.envs.sb3 import FusionSB3VecEnv

    task = fusion_gym.make_task(
        ENV_ID, filter="tobit", cost_weight="random", price_range=SPAN, horizon=6
    )
    plain = FusionSB3VecEnv(task, 5, local=local)
    scaled = FusionSB3VecEnv(task, 5, local=local, price_exponent=0.5)
    for env in (plain, scaled):
        env.seed(7)
        env.reset()
    rows = plain.num_envs // 5
    action = np.ones(plain.num_envs, dtype=int) if local else np.ones((5, task.sensors), dtype=int)
    for _ in range(13):  # two episodes and a step: new prices are drawn on the way
        price = plain.batch.price.repeat(rows)
        _, reward, _, infos = plain.step(action)
        _, other, _, others = scaled.step(action)
        factor = np.sqrt(np.sqrt(SPAN[0] * SPAN[1]) / price)
        np.testing.assert_allclose(other, reward * factor, rtol=1e-5)
        assert [i.get("episode", {}).get("r") for i in infos] == [
            i.get("episode", {}).get("r") for i in others
        ]
    for value in (-0.1, 1.5, float("nan")):
        with pytest.raises(ConfigurationError, match="price_exponent"):
            FusionSB3VecEnv(task, 5, price_exponent=value)


RANGE = "it must be a pair (low, high) with 0 < low < high"
KINDS = "it must be one of 'squared', 'trace', 'maximum', a function, or its 'module:name'"


@pytest.mark.parametrize(("options", "message"), [
    ({"cost_weight": "drawn"}, "cost_weight = 'drawn' is not allowed: it must be one of 'random'"),
    ({"cost_weight": "random"},
     f"price_range = None is not allowed with cost_weight='random': {RANGE}"),
    ({"price_range": (0.1, 0.001)},
     "price_range = [0.1, 0.001] is not allowed: it must be a pair with 0 < low < high"),
    ({"price_range": "low"},
     "price_range = 'low' is not allowed: it must be an array of numbers"),
    ({"cost_weight": 0.5, "price_range": SPAN},
     "cost_weight = 0.5 is not allowed: it must lie in price_range = [0.001, 0.1]"),
    ({"error": np.zeros(0)}, f"error = [] is not allowed: {KINDS}"),
    ({"error": "cubed"}, f"error = 'cubed' is not allowed: {KINDS}"),
    ({"error": lambda error, covariance: 0.0 * error[0] - 1.0},
     "error = 'test_price:<lambda>' is not allowed: for errors (2, 3) it must return numbers "
     ">= 0 of shape (3,), but it returned [-1.0, -1.0, -1.0] of shape (3,)"),
    ({"error": "os:system"},
     "error = 'os:system' is not allowed: it must take errors (n, N) and covariances (n, n, N), "
     "and return numbers >= 0 (N,) (TypeError: system() takes at most 1 argument (2 given))"),
])  # fmt: skip
def test_a_reward_that_cannot_be_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        fusion_gym.make_task(ENV_ID, **options)
    assert str(caught.value) == message


def test_open_loop_costs_one_with_equal_weights() -> None:
    variances = np.array([0.5, 2.0, 8.0])
    np.testing.assert_allclose(equal_weights(variances) * variances, 1.0 / 3.0)
    ending = "every state must have noise before the horizon, or an uncertain start"
    with pytest.raises(ConfigurationError, match=f"^a squared error of .0.0. without .*{ending}$"):
        equal_weights(np.zeros(1))
    with pytest.raises(ConfigurationError, match=r"^price_range = None .* observed$"):
        Price.create(0.1).encode(variances)
