"""What an untrained policy does: it requests at the rate that the config says."""

from typing import Any

import numpy as np
import pytest
import torch

from fusion_gym.envs.registration import make_task
from fusion_gym.envs.sb3 import FusionSB3VecEnv
from fusion_gym.training.config import Experiment, checked
from fusion_gym.training.run import make_model
from fusion_gym.validation import ConfigurationError

ENV = "fusion_gym/CorrelatedTracking-v1"


def experiment(algorithm: str = "ppo", local: bool = False, **options: Any) -> Experiment:
    content: dict[str, Any] = {
        "environment": {"id": ENV, "options": options, "local": local},
        "algorithm": {"name": algorithm, "initial_rate": 0.1},
        "training": {"timesteps": 64, "num_envs": 64},
        "output": "unused",
    }
    if algorithm == "a2c":
        content["algorithm"]["n_steps"] = 8
    return checked(Experiment, content, "config 'test'")


@pytest.mark.parametrize(
    ("algorithm", "local", "options"),
    [
        ("ppo", False, {}),
        ("a2c", False, {}),
        ("maskable_ppo", False, {}),
        ("ppo", True, {}),
        ("ppo", True, {"memory": True}),
        ("ppo", False, {"action": "discrete"}),
        ("recurrent_ppo", False, {"action": "discrete"}),
        ("ppo", False, {"action": "multidiscrete"}),
        ("maskable_ppo", False, {"action": "multidiscrete"}),
        ("recurrent_ppo", False, {"action": "multidiscrete"}),
        ("ppo", False, {"access": "single"}),
    ],
)
def test_an_untrained_policy_requests_at_the_initial_rate(
    algorithm: str, local: bool, options: dict[str, Any]
) -> None:
    suggestion = experiment(algorithm, local, **options)
    task = make_task(ENV, tokens="unlimited", **options)
    env = FusionSB3VecEnv(task, 64, local=local)
    model = make_model(suggestion, env)
    torch.manual_seed(0)
    env.seed(0)
    observation: Any = env.reset()
    requested, steps = 0.0, 60
    for _ in range(steps):
        action, _ = model.predict(observation)
        observation, _, _, _ = env.step(action)
    requested = env.totals[0] / (task.network.bucket.cost[0, 0] * task.sensors * env.totals[1])
    # 11,520 decisions at .1: standard error .0028; the first layer's weights add a little.
    assert requested == pytest.approx(0.1, abs=0.015)


def test_without_an_initial_rate_half_of_the_choices_are_requests() -> None:
    suggestion = experiment().model_dump()
    suggestion["algorithm"]["initial_rate"] = None
    env = FusionSB3VecEnv(make_task(ENV), 64)
    model = make_model(Experiment.model_validate(suggestion), env)
    env.seed(0)
    actions = np.concatenate([model.predict(env.reset())[0] for _ in range(20)])
    assert actions.mean() == pytest.approx(0.5, abs=0.03)


def test_one_sensor_a_step_bounds_the_initial_rate() -> None:
    suggestion = experiment().model_dump()
    suggestion["algorithm"]["initial_rate"] = 0.34
    env = FusionSB3VecEnv(make_task(ENV, access="single"), 8)
    with pytest.raises(ConfigurationError, match=r"initial_rate = 0.34 .* must be < 1/3"):
        make_model(Experiment.model_validate(suggestion), env)


@pytest.mark.parametrize(("algorithm", "value"), [("ppo", 0.0), ("ppo", 1.0), ("dqn", 0.1)])
def test_an_initial_rate_that_is_not_allowed(algorithm: str, value: float) -> None:
    content = experiment().model_dump()
    content["algorithm"] = {"name": algorithm, "initial_rate": value}
    with pytest.raises(ConfigurationError, match="initial_rate"):
        checked(Experiment, content, "config 'test'")
