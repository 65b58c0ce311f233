"""A vector of single environments, exchanged for one batch: same episodes, same options."""

import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import yaml
from gymnasium.wrappers import TransformReward
from paths import ROOT
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

import fusion_gym
from fusion_gym.envs.one_batch import one_batch
from fusion_gym.training.config import Experiment, load_checked
from fusion_gym.validation import ConfigurationError

TOBIT = "fusion_gym/TobitOscillator-v1"


def play(envs: Any, steps: int) -> list[Any]:
    """Observations, rewards, ends, last observations, returns and lengths of all episodes."""
    random, result = np.random.default_rng(0), [envs.reset().tolist()]
    for _ in range(steps):
        actions = random.integers(0, 2, (envs.num_envs, *envs.action_space.shape))
        observation, reward, done, infos = envs.step(actions)
        result += [observation.tolist(), reward.tolist(), done.tolist()]
        for info in (infos[run] for run in np.flatnonzero(done)):
            episode = info["episode"]
            result += [info["terminal_observation"].tolist(), info["TimeLimit.truncated"]]
            result += [round(episode["r"], 6), episode["l"]]
    return result


@pytest.mark.parametrize("limit", [None, 3])
def test_episodes_are_those_of_single_environments(limit: int | None, tmp_path: Path) -> None:
    options = {"filter": "tobit", "horizon": 5, "token_rate": 1.5}
    options |= {} if limit is None else {"max_episode_steps": limit}
    plain, other = (make_vec_env(TOBIT, 3, seed=8, env_kwargs=options, monitor_dir=str(tmp_path))
                    for _ in range(2))  # fmt: skip
    batch = one_batch(other)
    assert isinstance(batch, fusion_gym.FusionSB3VecEnv)
    assert batch.num_envs == 3
    assert play(batch, 13) == play(plain, 13)


def test_what_environments_were_made_with_comes_before_options() -> None:
    envs = make_vec_env(TOBIT, 2, env_kwargs={"filter": "tobit", "token_rate": 1.5})
    batch = one_batch(envs, token_rate=2.0, cost_weight=0.05, horizon=300, stagger=True)
    settings = batch.task.settings
    assert (settings["filter"], settings["token_rate"]) == ("tobit", 1.5)
    assert (settings["cost_weight"], batch.task.horizon, batch.stagger) == (0.05, 300, True)
    rows = one_batch(make_vec_env(TOBIT, 2), local=True)
    assert rows.num_envs == 6


def test_what_one_batch_would_lose_is_refused() -> None:
    def wrapped(**options: Any) -> Any:
        return TransformReward(gym.make(TOBIT, **options), abs)

    for envs, message in (
        (make_vec_env("CartPole-v1", 2), "environment 'CartPole-v1' is not allowed"),
        (make_vec_env(wrapped, 2), r"wrappers \['TransformReward'\] are not allowed"),
        (make_vec_env(TOBIT, 1, env_kwargs={"render_mode": "human"}), "render_mode = 'human'"),
        (DummyVecEnv([lambda: gym.make(TOBIT), lambda: gym.make(TOBIT, horizon=3)]), "be the same"),
        (DummyVecEnv([lambda: gym.make(TOBIT).unwrapped.__class__()]), "gym.make must"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            one_batch(envs)
        envs.close()
    with pytest.raises(ConfigurationError, match="unknown option 'tokne_rate'"):
        one_batch(make_vec_env(TOBIT, 1), tokne_rate=1.0)


FILE = ROOT / "configs" / "rl_zoo3" / "ppo.yml"
EXCHANGE = "fusion_gym.envs.one_batch.one_batch"


def test_the_file_of_hyper_parameters_says_what_the_configs_say() -> None:
    """Of rl-zoo3's names each has its value in the config that the line before its entry names."""
    text = FILE.read_text()
    entries = yaml.safe_load(text)
    named = dict(re.findall(r"^# configs/(\w+)\.yaml\n(\S+):$", text, re.MULTILINE))
    assert list(named.values()) == list(entries)
    assert len(entries) == 7
    for config, env_id in named.items():
        experiment = load_checked(Experiment, config)
        entry, algorithm = entries[env_id], experiment.algorithm
        ((name, options),) = entry.pop("vec_env_wrapper")[0].items()
        assert (name, env_id) == (EXCHANGE, experiment.environment.id)
        assert options == experiment.environment.options
        settings = experiment.training
        assert entry.pop("n_envs") == settings.num_envs
        assert entry.pop("n_timesteps") == settings.timesteps
        assert entry.pop("policy") == "MlpPolicy"
        assert entry.pop("learning_rate") == f"lin_{algorithm.learning_rate}"
        written = experiment.model_dump(exclude_unset=True)["algorithm"]
        assert written.keys() - entry.keys() == {"name", "learning_rate", "learning_rate_end"}
        assert entry == {key: written[key] for key in entry}
        one_batch(make_vec_env(env_id, 2), **options)
