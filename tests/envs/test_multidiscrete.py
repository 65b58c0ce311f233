"""MultiDiscrete actions: requests, rewards and agents as with MultiBinary, in every interface."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import MultiDiscrete
from refusals import refused
from stable_baselines3 import A2C, PPO
from training_configs import ENV, small_config

import fusion_gym
from fusion_gym.envs.pages import page
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.training import run
from fusion_gym.training.config import TABLE, Experiment, load_checked
from fusion_gym.validation import ConfigurationError

LINEAR = "fusion_gym/LinearFusion-v2"
MULTI = {"action": "multidiscrete"}
MANY: dict[str, Any] = {  # 40 sensors of a plane
    "transition": [[0.9, 0.0], [0.1, 0.8]],
    "process_covariance": [[1.0, 0.0], [0.0, 1.0]],
    "measurement_matrices": np.random.default_rng(0).normal(size=(40, 2)).tolist(),
    "horizon": 8,
}


def test_a_multidiscrete_step_is_the_multibinary_step() -> None:
    """Bitwise: one environment, Gymnasium's vector environment, and that of SB3."""
    steps = np.random.default_rng(0).integers(0, 2, (20, 4, 3))
    single, twin = (gymnasium.make(ENV, **options) for options in (MULTI, {}))
    assert single.action_space == MultiDiscrete([2, 2, 2])
    np.testing.assert_array_equal(single.reset(seed=3)[0], twin.reset(seed=3)[0])
    rows, other = (fusion_gym.make_sb3_vec_env(ENV, 4, seed=3, **o) for o in (MULTI, {}))
    assert rows.action_space == single.action_space
    np.testing.assert_array_equal(rows.reset(), other.reset())
    entry: Any = {"vectorization_mode": "vector_entry_point"}
    many, same = (gymnasium.make_vec(ENV, 4, **entry, **options) for options in (MULTI, {}))
    assert many.single_action_space == single.action_space
    np.testing.assert_array_equal(many.reset(seed=3)[0], same.reset(seed=3)[0])
    for action in steps:
        for left, right, own in ((single, twin, action[0]), (rows, other, action)):
            for part, expected in zip(left.step(own)[:3], right.step(own)[:3], strict=True):
                np.testing.assert_array_equal(part, expected, strict=True)
        for part, expected in zip(many.step(action)[:4], same.step(action)[:4], strict=True):
            np.testing.assert_array_equal(part, expected, strict=True)
    assert single.step(np.array([0, 0, 1]))[4]["granted"].tolist() == [False, False, True]


@pytest.mark.parametrize("access", ["single", "local"])
def test_one_number_stays_where_an_action_is_one_number(access: str) -> None:
    options = {"access": access} if access == "single" else {"local": True}
    spaces = [fusion_gym.make_sb3_vec_env(ENV, 2, **options, **o).action_space for o in (MULTI, {})]
    assert spaces[0] == spaces[1]


@pytest.mark.parametrize(("kind", "bits"), [(PPO, MULTI), (A2C, MULTI), (PPO, {})])
def test_an_agent_of_forty_sensors_is_saved_and_loaded(
    tmp_path: Path, kind: Any, bits: dict[str, Any]
) -> None:
    """The file has no card, and the task that loads it may have bits of the other kind."""
    envs = fusion_gym.make_sb3_vec_env(LINEAR, 4, seed=0, **MANY, **bits)
    model = kind("MlpPolicy", envs, n_steps=16, seed=0, device="cpu").learn(128)
    model.save(tmp_path / "agent.zip")
    observation = envs.reset()
    expected = model.predict(observation, deterministic=True)[0]
    assert expected.shape == (4, 40)
    for options in (MULTI, {}):
        task = fusion_gym.make_task(LINEAR, **MANY, **options)
        for trust in (False, True):
            policy: Any = make_policy(f"model:{tmp_path / 'agent.zip'}", task, trust=trust)
            actions = policy.model.predict(observation, deterministic=True)[0]
            np.testing.assert_array_equal(actions, expected)
            assert policy.view.action.space == envs.action_space
    fewer = MANY | {"measurement_matrices": MANY["measurement_matrices"][:39]}
    other = fusion_gym.make_task(LINEAR, **fewer)
    refused(lambda: make_policy(f"model:{tmp_path / 'agent.zip'}", other))
    if bits:
        assert envs.action_space == MultiDiscrete([2] * 40)
        assert f"`MultiDiscrete([{'2 ' * 39}2])`" in page(LINEAR, envs.task)


LEARNERS = [kind for kind, row in TABLE.items() if "multidiscrete" in row.actions]


@pytest.mark.parametrize("kind", LEARNERS)
def test_every_learner_of_several_choices_trains(tmp_path: Path, kind: str) -> None:
    """And the agent's logits are those of the chances that it draws with."""
    options = {"filter": "tobit", "horizon": 20, **MULTI}
    config = small_config(tmp_path, kind, environment={"id": ENV, "options": options})
    experiment = load_checked(Experiment, config)
    assert run.train(experiment, quiet=True)["finished"]
    task = fusion_gym.make_task(ENV, **options)
    policy: Any = make_policy(f"model:{Path(experiment.output) / 'final_model.zip'}", task)
    assert policy.view.action.space == MultiDiscrete([2, 2, 2])
    assert np.isfinite(run_episodes(task, policy, 4, 0).mse).all()
    if kind == "recurrent_ppo":
        return
    policy.check_logits()
    batch = fusion_gym.core.batch.EpisodeBatch.seeded(task, 5, 0)
    logits, rows = policy.logits(batch.signals()), policy.rows(batch.signals())
    with torch.no_grad():
        drawn = policy.model.policy.get_distribution(torch.as_tensor(rows))
    parts = drawn.distributions if "maskable" in kind else drawn.distribution
    chances = np.stack([part.probs[:, 1].numpy() for part in parts])
    np.testing.assert_allclose(1.0 / (1.0 + np.exp(-logits)), chances, rtol=1e-5)
    lower = policy.with_threshold(0.5).logits(batch.signals())
    np.testing.assert_allclose(lower, logits - 0.5, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("kind", "action", "allowed"),
    [
        ("dqn", "multidiscrete", "action: discrete"),
        ("recurrent_ppo", "binary", "action: multidiscrete or discrete or assignment or threshold"),
    ],
)
def test_a_learner_of_other_actions_is_refused(
    tmp_path: Path, kind: str, action: str, allowed: str
) -> None:
    environment = {"id": ENV, "options": {"horizon": 20, "action": action}}
    experiment = load_checked(Experiment, small_config(tmp_path, kind, environment=environment))
    message = f"action = '{action}' is not allowed with algorithm '{kind}': .*{allowed}$"
    with pytest.raises(ConfigurationError, match=message):
        run.train(experiment, quiet=True)
    assert not Path(experiment.output).exists()
