"""Environments as pure functions of JAX: NumPy's results on the same noise, and autoresets."""

from typing import Any

import jax
import numpy as np
import pytest
from test_namespace import TASKS

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.noise import PhiloxNoise
from fusion_gym.jax import FunctionalEnv
from fusion_gym.validation import ConfigurationError

HORIZON, EPISODES = 30, 3
RULES = (
    "innovation_threshold:threshold=1.1",
    "innovation_threshold:threshold=1.1,whitened=true,at_most=1",
    "send_on_delta:threshold=0.9",
    "information_gain:threshold=0.03,at_most=none",
    "information_gain:threshold=0.01",
)


@pytest.mark.parametrize(("name", "options"), TASKS)
def test_episodes_equal_numpy(name: str, options: dict[str, Any]) -> None:
    task = fusion_gym.make_task(f"fusion_gym/{name}", **options | {"horizon": HORIZON})
    env, source, system = FunctionalEnv(task), PhiloxNoise(), task.system
    channels = system.noise_channels + (task.access == "random")
    space = env.action_space()
    space.seed(0)
    reset, step = jax.jit(env.reset_env), jax.jit(env.step_env)
    rules = [fusion_gym.make_policy(text, task) for text in RULES]
    decide = jax.jit(lambda state: [rule(env.signals(state)) for rule in rules])
    batch = EpisodeBatch(task, 1)
    batch.seed(np.arange(1), [7])
    for episode in range(EPISODES):
        batch.reset()
        start = source.start(7, episode, system.start_channels)[:, None]
        noise = source.steps(7, episode, 0, HORIZON + 1, channels)[..., None]
        uniform = np.array([source.uniform(7, episode)])
        observation, state = reset(start, noise[0], uniform)
        for place in range(HORIZON):
            np.testing.assert_allclose(observation, batch.observe()[0], rtol=1e-6, atol=1e-6)
            for rule, requests in zip(rules, decide(state), strict=True):
                np.testing.assert_array_equal(requests, rule(batch.signals()))
            action = space.sample()
            outcome = batch.step(np.asarray(env.requests(action)))
            observation, state, result = step(noise[place + 1], state, action)
            for ours, theirs in zip(result, outcome, strict=True):
                np.testing.assert_allclose(
                    np.asarray(ours, np.float64), theirs, rtol=1e-9, atol=1e-9
                )
        assert bool(result.ended[0])


def test_an_episode_that_ends_is_reset() -> None:
    env, params = fusion_gym.jax.make("fusion_gym/LinearFusion-v2", horizon=3)
    key = jax.random.key(0)
    _, state = env.reset(key, params)
    for number in range(1, 7):
        key, own = jax.random.split(key)
        observation, state, _, terminated, truncated, info = env.step(
            own, state, np.array([1, 0]), params
        )
        assert (bool(terminated), bool(truncated)) == (False, number % 3 == 0)
        assert int(state.steps[0]) == number % 3
        same = np.array_equal(observation, info["final_observation"])
        assert same == (number % 3 != 0)
    env, params = fusion_gym.jax.make("fusion_gym/LinearFusion-v2", horizon=1, clock=True)
    *_, terminated, truncated, _ = env.step(
        key, env.reset(key, params)[1], np.array([1, 0]), params
    )
    assert bool(terminated)
    assert not bool(truncated)


def test_an_action_of_another_shape_is_refused() -> None:
    for options, action in (({}, [1, 0, 1]), ({"access": "single"}, [1, 0])):
        env, params = fusion_gym.jax.make("fusion_gym/LinearFusion-v2", **options)
        _, state = env.reset(jax.random.key(0), params)
        with pytest.raises(ValueError, match=r"^action of shape .* is not allowed"):
            env.step(jax.random.key(1), state, np.array(action), params)


def test_parameters_may_be_mapped() -> None:
    env, params = fusion_gym.jax.make("fusion_gym/TobitOscillator-v1", filter="tobit")
    key = jax.random.key(0)

    def reward(variance: Any) -> Any:
        changed = params._replace(measurement_variance=variance)
        _, state = env.reset(key, changed)
        return env.step(key, state, np.ones(3), changed)[2]

    variances = np.stack([factor * params.measurement_variance for factor in (0.5, 1.0, 2.0)])
    together = jax.vmap(reward)(variances)
    np.testing.assert_allclose(together, [reward(v) for v in variances], rtol=1e-12)
    assert len(set(together.tolist())) == 3
    dear = params._replace(price=100.0)
    _, state = env.reset(key, dear)
    info = env.step(key, state, np.ones(3), dear)[-1]
    assert float(info["reward_cost"]) == -100.0 * float(info["cost"]) < 0.0


@pytest.mark.parametrize(
    ("name", "options", "field"),
    [
        ("MarkovJumpTracking-v1", {}, "system"),
        ("TobitOscillator-v1", {"memory": True}, "memory"),
        ("TobitOscillator-v1", {"fusion": "ci"}, "fusion"),
        ("LinearFusion-v2", {"true_process_noise": 2.0}, "true_process_noise"),
        ("LinearFusion-v2", {"error": "numpy:trace"}, "error"),
    ],
)
def test_what_jax_does_not_run_is_refused(name: str, options: dict[str, Any], field: str) -> None:
    options = {"error": lambda error, _: (error**2).sum(0)} if field == "error" else options
    with pytest.raises(ConfigurationError, match=rf"^{field} = .* is not allowed"):
        fusion_gym.jax.make(f"fusion_gym/{name}", **options)
