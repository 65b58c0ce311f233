"""`action="threshold"`: a sensor sends where its score reaches the threshold that it was given."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from sb3_contrib import TQC, MaskablePPO
from stable_baselines3 import PPO, SAC, TD3

import fusion_gym
from fusion_gym import ConfigurationError, make_policy
from fusion_gym.core.action import SCORES
from fusion_gym.evaluation import run_episodes
from fusion_gym.evaluation.onnx_export import export_onnx

LINEAR = "fusion_gym/LinearFusion-v2"


@pytest.mark.parametrize(
    ("score", "rule"),
    [
        ("innovation", "innovation_threshold:whitened=true,threshold={}"),
        ("value", "value_of_information:threshold={}"),
    ],
)
@pytest.mark.parametrize("logarithm", [-1.0, 0.0, 0.7])
def test_a_constant_threshold_is_the_rule(score: str, rule: str, logarithm: float) -> None:
    options: dict[str, Any] = {"horizon": 30, "tokens": "unlimited"}
    env = gym.make(LINEAR, action="threshold", score=score, **options)
    task = fusion_gym.make_task(LINEAR, **options)
    reference = 1.0 if score == "innovation" else task.error_scale
    text = rule.format(np.exp(np.float64(np.float32(logarithm))) / reference)
    expected = run_episodes(task, make_policy(text, task), 2, seed=4).rate
    for episode, rate in enumerate(expected):
        env.reset(seed=4 + episode)
        action = np.full(2, logarithm, np.float32)
        granted = [env.step(action)[-1]["granted"] for _ in range(30)]
        np.testing.assert_allclose(np.mean(granted, 0), rate)


@pytest.mark.parametrize("score", SCORES)
def test_bounds_always_and_never_send(score: str) -> None:
    env = gym.make(LINEAR, action="threshold", score=score, tokens="unlimited")
    env.reset(seed=0)
    for _ in range(5):
        action = np.array([env.action_space.low[0], env.action_space.high[1]])
        assert env.step(action)[-1]["granted"].tolist() == [True, False]
    for wrong in ([9.0, 0.0], [np.nan, 0.0]):
        with pytest.raises(ValueError, match=r"action \[0\] = .*it must be a number from"):
            env.step(wrong)


def test_bounds_tell_the_scores_apart() -> None:
    assert len({score.bounds for score in SCORES.values()}) == len(SCORES)


def test_one_sensor_at_a_time_is_the_largest_ratio() -> None:
    env = gym.make("fusion_gym/BiasedTracking-v1", action="threshold")
    env.reset(seed=0)
    low, high = env.action_space.low[0], env.action_space.high[0]
    assert env.step([low, high])[-1]["granted"].tolist() == [True, False]
    assert env.step([high, low])[-1]["granted"].tolist() == [False, True]
    whitened = env.unwrapped.batch.signals()
    score = np.abs(whitened["innovation"] / whitened["innovation_deviation"])[:, 0, 0]
    granted = env.step(np.full(2, low + 0.01, np.float32))[-1]["granted"]
    assert granted.argmax() == score.argmax()


@pytest.mark.parametrize("kind", [SAC, TD3, TQC, PPO])
def test_a_file_loads_without_trust_and_exports(kind: Any, tmp_path: Any) -> None:
    settings = {"n_steps": 16} if kind is PPO else {"learning_starts": 8, "batch_size": 8}
    for score in SCORES:
        envs = fusion_gym.make_sb3_vec_env(LINEAR, 4, seed=0, action="threshold", score=score)
        model = kind("MlpPolicy", envs, policy_kwargs={"net_arch": [8]}, seed=0, **settings)
        model.learn(48).save(tmp_path / "agent")
        task = fusion_gym.make_task(LINEAR, horizon=15)
        agent: Any = make_policy(f"model:{tmp_path}/agent.zip", task)
        agents_own = make_policy(f"model:{tmp_path}/agent.zip", envs)
        observation = envs.reset()
        expected = envs.view.action.requests(
            model.predict(observation, deterministic=True)[0], 4, envs.batch.signals
        )
        taken = agents_own.predict(observation)[0]
        np.testing.assert_array_equal(taken == envs.action_space.low, expected.T)
        assert (agent.knowledge, agent.task.options.score) == ("scheduler", score)
        signals = envs.batch.signals()
        np.testing.assert_array_equal(agent.logits(signals) >= 0.0, agent(signals))
        assert (agent.with_threshold(99.0)(signals) <= agent(signals)).all()
    written = export_onnx(agent, task, tmp_path / "agent.onnx", LINEAR)
    assert written.outputs == {"threshold": ("batch", 2)}
    assert written.agreement.holds


def test_a_centre_sets_thresholds_that_the_sensors_compare(tmp_path: Any) -> None:
    options = {"information": "centre", "action": "threshold", "horizon": 15}
    envs = fusion_gym.make_sb3_vec_env(LINEAR, 4, seed=0, **options)
    PPO("MlpPolicy", envs, n_steps=8, seed=0, batch_size=32).learn(32).save(tmp_path / "agent")
    assert not any("innovation" in name for name in envs.observation_names)
    task = fusion_gym.make_task(LINEAR, **options)
    agent = make_policy(f"model:{tmp_path}/agent.zip", task)
    assert agent.knowledge == "scheduler"  # the join of the centre's and a sensor's
    assert run_episodes(task, agent, 2).rate.mean() > 0.0
    other = fusion_gym.make_task(LINEAR, information="centre")
    with pytest.raises(ConfigurationError, match=r"action space 'Box"):
        make_policy(f"model:{tmp_path}/agent.zip", other)


def test_masks_local_views_channels_and_rates_are_refused() -> None:
    env = gym.make(LINEAR, action="threshold")
    env.reset(seed=0)
    with pytest.raises(ConfigurationError, match=r"action = 'threshold' .*with a mask"):
        env.unwrapped.action_masks()  # type: ignore[attr-defined]
    envs = fusion_gym.make_sb3_vec_env(LINEAR, 2, action="threshold")
    with pytest.raises((ConfigurationError, ValueError, AssertionError)):
        MaskablePPO("MlpPolicy", envs, n_steps=4, batch_size=4).learn(8)
    refused: tuple[dict[str, Any], ...] = ({"access": "assignment"}, {"score": "value", "delay": 2})
    for options in refused:
        with pytest.raises(ConfigurationError, match="is not allowed"):
            fusion_gym.make_task(LINEAR, action="threshold", **options)
    with pytest.raises(ConfigurationError, match="with a local view"):
        fusion_gym.make_sb3_vec_env(LINEAR, 2, action="threshold", local=True)
