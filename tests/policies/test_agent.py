"""A rule as an agent: `predict` in a user's loop is the evaluation of the rule."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import FrameStackObservation, NormalizeObservation, RecordEpisodeStatistics
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import SubprocVecEnv, VecFrameStack, VecNormalize

import fusion_gym
from fusion_gym import ConfigurationError, make_policy
from fusion_gym.envs.registration import ENVIRONMENTS
from fusion_gym.evaluation import run_episodes

LINEAR = "fusion_gym/LinearFusion-v2"
RULES = "innovation_threshold:threshold=1", "random", "value_of_information", "periodic:period=3"
SLOW = "fusion_gym/GymnasiumEnvironment-v1"  # steps its runs one by one


def play(env: Any, agent: Any, seed: int) -> float:
    """Return the return of an episode in a loop of one's own."""
    observation, _ = env.reset(seed=seed)
    total, done = 0.0, False
    while not done:
        action, _ = agent.predict(observation)
        observation, reward, terminated, truncated, _ = env.step(action)
        total, done = total + float(reward), terminated or truncated
    return total


@pytest.mark.parametrize("text", RULES)
@pytest.mark.parametrize("kind", ["single", "vector", "native", "dummy", "parallel"])
def test_every_loop_gives_the_returns_of_the_evaluation(text: str, kind: str) -> None:
    options: dict[str, Any] = {"horizon": 20}
    task = fusion_gym.make_task(LINEAR, **options)
    expected = run_episodes(task, make_policy(text, task), 3, seed=0).returns
    if kind == "single":
        env: Any = gym.make(LINEAR, **options)
        agent = make_policy(text, env)
        returns = []
        for seed in range(3):
            agent.set_random_seed(seed)
            returns.append(play(env, agent, seed))
    elif kind == "vector":
        env = gym.make_vec(LINEAR, num_envs=3, **options)
        agent, (observation, _) = make_policy(text, env), env.reset(seed=0)
        returns = np.zeros(3)  # type: ignore[assignment]
        for _ in range(20):
            observation, reward, *_ = env.step(agent.predict(observation)[0])
            returns += reward
    elif kind == "parallel":
        env = fusion_gym.parallel_env(LINEAR, **options)
        agent, (observation, _), total = make_policy(text, env), env.reset(seed=0), 0.0
        while env.agents:
            observation, reward, *_ = env.step(agent.predict(observation)[0])
            total += reward["sensor_0"]
        returns, expected = [total], expected[:1]
    else:
        make = fusion_gym.make_sb3_vec_env if kind == "native" else make_vec_env
        env = make(LINEAR, 3, seed=0, **(options if kind == "native" else {"env_kwargs": options}))
        agent = make_policy(text, env)
        returns = evaluate_policy(agent, env, 3, return_episode_rewards=True)[0]  # type: ignore
    np.testing.assert_allclose(sorted(returns), sorted(expected), rtol=1e-5)


@pytest.mark.parametrize("options", [{}, {"action": "multidiscrete"}, {"action": "discrete"},
    {"access": "single"}, {"action": "threshold"}, {"access": "assignment", "channels": 2},
    {"access": "assignment", "action": "assignment", "channels": 2}])  # fmt: skip
@pytest.mark.parametrize("text", ["always", "value_of_information:threshold=0.001", "periodic"])
def test_every_kind_of_action_expresses_the_requests(options: dict[str, Any], text: str) -> None:
    options = {"horizon": 12, **options}
    task = fusion_gym.make_task("fusion_gym/TobitOscillator-v1", **options)
    expected = run_episodes(task, make_policy(text, task), 2, seed=5)
    env = gym.make("fusion_gym/TobitOscillator-v1", **options)
    agent = make_policy(text, env)
    returns = [play(env, agent, seed) for seed in (5, 6)]
    np.testing.assert_allclose(returns, expected.returns, rtol=1e-9)


@pytest.mark.parametrize("env_id", [name for name in ENVIRONMENTS if name != SLOW])
def test_a_reference_acts_in_every_environment(env_id: str) -> None:
    env = gym.make(env_id, horizon=8)
    text = "whittle" if "Remote" in env_id else "round_robin"
    task = env.unwrapped.task
    expected = run_episodes(task, make_policy(text, task), 1, seed=2).returns[0]
    assert play(env, make_policy(text, env), 2) == pytest.approx(expected, rel=1e-9)


def test_a_saved_agent_acts_as_the_file_does(tmp_path: Any) -> None:
    from stable_baselines3 import PPO

    envs = fusion_gym.make_sb3_vec_env(LINEAR, 2, seed=0)
    model = PPO("MlpPolicy", envs, n_steps=8, batch_size=16, seed=0)
    model.save(tmp_path / "agent")
    observation, agent = envs.reset(), make_policy(f"model:{tmp_path}/agent.zip", envs)
    expected = model.predict(observation, deterministic=True)[0]
    np.testing.assert_array_equal(agent.predict(observation)[0], expected)
    drawn = [agent.predict(observation, deterministic=False)[0].tolist() for _ in range(30)]
    assert len({str(action) for action in drawn}) > 1


def test_wrappers_that_change_observations_are_allowed_and_others_are_compared() -> None:
    for wrap in (RecordEpisodeStatistics, NormalizeObservation,
                 lambda env: FrameStackObservation(env, 3)):  # fmt: skip
        env = wrap(gym.make(LINEAR, horizon=10))
        assert play(env, make_policy("always", env), 0) < 0.0
    for wrapped in (VecNormalize, lambda envs: VecFrameStack(envs, 2)):
        envs = wrapped(fusion_gym.make_sb3_vec_env(LINEAR, 2, horizon=10, seed=0))
        agent, observation = make_policy("always", envs), envs.reset()
        assert agent.predict(observation)[0].tolist() == [[1, 1]] * 2
        envs.step(agent.predict(observation)[0])


def test_another_observation_or_environment_is_refused() -> None:
    env, other = gym.make(LINEAR), gym.make(LINEAR)
    agent = make_policy("always", env)
    with pytest.raises(gym.error.ResetNeeded, match="call reset"):
        agent.predict(other.reset(seed=1)[0])
    first, _ = env.reset(seed=0)
    env.step([0, 0])
    for stored in (first, other.reset(seed=1)[0], np.zeros((2, 13))):
        with pytest.raises(ConfigurationError, match=r"^observation = .*the environment's last"):
            agent.predict(stored)
    for strange in (gym.make("CartPole-v1"), 3, None, "fusion_gym/LinearFusion-v2"):
        with pytest.raises(ConfigurationError, match=r"^env = .*in this process"):
            make_policy("always", strange)
    with pytest.raises(ConfigurationError, match="beliefs of 'own'"):
        make_policy("value_of_information:own=true", env)


@pytest.mark.slow
def test_other_processes_are_refused() -> None:
    for envs in (make_vec_env(LINEAR, 2, vec_env_cls=SubprocVecEnv,
                             vec_env_kwargs={"start_method": "fork"}),
                 gym.make_vec(LINEAR, 2, vectorization_mode="async")):  # fmt: skip
        with pytest.raises(ConfigurationError, match=r"^env = .*in this process"):
            make_policy("always", envs)
        envs.close()
