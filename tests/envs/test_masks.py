"""Masks of actions: what the network would deny is closed, and masked agents never ask for it."""

from itertools import product
from typing import Any

import numpy as np
import pytest
from sb3_contrib import MaskablePPO, RecurrentPPO
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.envs.sb3 import FusionSB3VecEnv
from fusion_gym.envs.views import SchedulerView
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.policies.saved import ModelPolicy, tag_model

ENV_ID = "fusion_gym/TobitOscillator-v1"
BIASED = "fusion_gym/BiasedOscillator-v2"


@pytest.mark.parametrize(
    "options", [{}, {"action": "multidiscrete"}, {"action": "discrete"}, {"access": "single"}]
)
def test_masks_close_exactly_the_actions_with_closed_sensors(options: dict[str, Any]) -> None:
    task = fusion_gym.make_task(ENV_ID, **options)
    patterns = np.array(list(product((False, True), repeat=3))).T
    view = SchedulerView(task)
    masks = view.action.masks(patterns)
    if options.get("action") == "discrete" or options.get("access") == "single":
        for action in range(masks.shape[1]):
            selection = view.action.requests(np.full(8, action), 8)
            np.testing.assert_array_equal(masks[:, action], ~(selection & ~patterns).any(0))
    else:
        np.testing.assert_array_equal(masks.reshape(8, 3, 2)[..., 0], True)
        np.testing.assert_array_equal(masks.reshape(8, 3, 2)[..., 1], patterns.T)


@pytest.mark.parametrize("env_id", [ENV_ID, BIASED])
def test_a_masked_agent_is_never_denied(env_id: str, tmp_path: Any) -> None:
    options: Any = {"tokens": "limited", "sharing": "fixed", "access": "single", "horizon": 40}
    amounts = {"token_rate": 1.0, "token_capacity": 9.0, "initial_tokens": 6.0}
    task = fusion_gym.make_task(env_id, **options, **amounts)
    env = FusionSB3VecEnv(task, 4)
    assert is_masking_supported(env)
    env.reset()
    assert get_action_masks(env).shape == (4, task.sensors + 1)
    model = MaskablePPO("MlpPolicy", env, n_steps=16, batch_size=32, device="cpu", seed=0)
    model.learn(128)
    tag_model(model, task)
    model.save(tmp_path / "masked.zip")
    policy = make_policy(f"model:{tmp_path / 'masked.zip'},deterministic=false", task)
    results = run_episodes(task, policy, 20, seed=0)
    assert results.denied.max() == 0.0
    assert results.requests.mean() > 0.0


def test_the_single_environment_has_masks() -> None:
    import gymnasium

    env: Any = gymnasium.make(ENV_ID, token_rate=0.0, initial_tokens=9.0)
    env.reset(seed=0)
    assert env.unwrapped.action_masks().tolist() == [True] * 6
    env.step(np.ones(3, dtype=np.int8))
    assert env.unwrapped.action_masks().tolist() == [True, False] * 3


def test_a_recurrent_agent_keeps_its_memory_within_an_episode_only() -> None:
    task = fusion_gym.make_task(ENV_ID, filter="tobit", horizon=6, information="centre")
    env = FusionSB3VecEnv(task, 2)
    model = RecurrentPPO(
        "MlpLstmPolicy", env, n_steps=8, batch_size=8, device="cpu", seed=0,
        policy_kwargs={"lstm_hidden_size": 8},
    )  # fmt: skip
    policy = ModelPolicy(model, task)
    first = run_episodes(task, policy, 3, seed=0)
    np.testing.assert_array_equal(run_episodes(task, policy, 3, seed=0).mse, first.mse)
    batch = EpisodeBatch(task, 3)
    batch.reset()
    policy.reset(3)
    policy(batch.signals())
    memory = policy._memory[0].copy()
    batch.step(np.zeros((3, 3), dtype=np.bool_))
    policy(batch.signals())
    assert np.abs(policy._memory[0] - memory).max() > 0.0
