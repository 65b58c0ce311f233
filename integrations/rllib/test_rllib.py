"""RLlib, with the Gymnasium that Ray pins: one scheduler, workers, sensors as agents."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import requires, version
from typing import Any

import numpy as np
import pytest
import ray
import torch
from ray.rllib.algorithms.ppo import PPOConfig

from integrations.page import run

NAME = "fusion_gym:fusion_gym/TobitOscillator-v1"
OPTIONS = {"filter": "tobit", "horizon": 20}
SMALL = {"train_batch_size": 256, "minibatch_size": 64, "num_epochs": 1}


@pytest.fixture(scope="module", autouse=True)
def cluster() -> Iterator[None]:
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    yield
    ray.shutdown()


def check(result: dict[str, Any], module: str) -> None:
    """Episodes end at the horizon, returns are negative, losses are numbers."""
    episodes, learned = result["env_runners"], result["learners"][module]
    assert episodes["episode_len_mean"] == 20.0
    assert episodes["episode_return_max"] < 0.0
    assert np.isfinite(learned["total_loss"])
    assert learned["num_trainable_parameters"] > 1_000


def weights(algorithm: Any, module: str) -> torch.Tensor:
    return torch.cat([torch.as_tensor(v).ravel()
                      for v in algorithm.get_weights()[module].values()])  # fmt: skip


def test_the_pins_are_what_the_page_says() -> None:
    assert 'gymnasium==1.2.2; extra == "rllib"' in (requires("ray") or [])
    assert version("gymnasium") == "1.2.2"


def test_the_page() -> None:
    names = run("RLlib")
    check(names["result"], "default_policy")
    check(names["local"], "shared")
    for algorithm, module in ((names["algorithm"], "default_policy"), (names["shared"], "shared")):
        before = weights(algorithm, module)
        algorithm.train()
        after = weights(algorithm, module)
        assert torch.isfinite(after).all()
        assert not torch.equal(before, after)
        algorithm.stop()


def test_a_worker_finds_the_environment_by_its_module() -> None:
    config = (
        PPOConfig()
        .environment(NAME, env_config={**OPTIONS, "action": "multidiscrete"})
        .env_runners(num_env_runners=1, num_envs_per_env_runner=2)
        .training(**SMALL)
    )
    algorithm = config.build_algo()
    check(algorithm.train(), "default_policy")
    algorithm.stop()


def test_what_rllib_refuses() -> None:
    config = PPOConfig().environment(NAME, env_config=OPTIONS).env_runners(num_env_runners=0)
    with pytest.raises(NotImplementedError, match=r"Unsupported action space: `MultiBinary\(3\)`"):
        config.build_algo()
