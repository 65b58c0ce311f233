"""Environments, policies and rewards of one's own, by their names in a module."""

import importlib
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from command_runs import refusal, succeed
from parts import Parts
from paths import ROOT
from refusals import refused
from rules import make_rule
from stable_baselines3.common.env_util import make_vec_env

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.envs.one_batch import one_batch
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.training.config import EnvironmentConfig

TOBIT = "fusion_gym/TobitOscillator-v1"
VARIANT = "own_variants:mine/Tobit-v0"


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, registries: None) -> Path:
    """A folder; the modules ``own_names`` and ``own_variants`` are on Python's path."""
    monkeypatch.chdir(tmp_path)
    for name in ("own_names", "own_variants"):
        sys.modules.pop(name, None)  # it registers anew
    importlib.import_module("own_variants")
    return tmp_path


def test_an_environment_by_module_and_id(own: Path) -> None:
    name = "own_names:me/OwnCart-v0"
    task = fusion_gym.make_task(name, horizon=20)
    assert task.settings["token_rate"] == 2.0
    env: Any = gym.make(name, horizon=20)
    for other in (env.unwrapped.task, fusion_gym.make_sb3_vec_env(name, 2, horizon=20).task):
        assert other.settings == task.settings


def test_a_policy_by_module_and_class(own: Path) -> None:
    task = fusion_gym.make_task(TOBIT, filter="tobit")
    policy = make_policy("own_names:Oldest:steps=5", task)
    same = make_policy("periodic:period=6", task)
    rates = [run_episodes(task, rule, 4, 0).rate.mean() for rule in (policy, same)]
    assert rates[0] == pytest.approx(rates[1], abs=0.02)
    assert make_rule("own_names:Oldest").knowledge == "centre"  # type: ignore[comparison-overlap]
    assert run_episodes(task, make_policy("own_names:Tasked", task), 2, 0).requests.mean() == 1.0


def test_an_error_of_ones_own(own: Path) -> None:
    """A function, its name in a module, and the named kinds, on one episode's errors."""

    def total(error: Any, covariance: Any) -> Any:
        return np.trace(covariance)

    for error, expected in (
        ("own_names:worst", lambda e, p, w: np.abs(e).max(0)),
        (total, lambda e, p, w: np.trace(p)),
        ("maximum", lambda e, p, w: (w * e**2).max(0)),
        ("squared", lambda e, p, w: (w * e**2).sum(0)),
        ("trace", lambda e, p, w: (w * np.diagonal(p).T).sum(0)),
    ):
        weights = np.array([[2.0], [0.5]])
        options: Any = {"error_weight": 3.0, "state_weights": weights[:, 0], "filter": "tobit"}
        task = fusion_gym.make_task(TOBIT, error=error, **options)
        batch = EpisodeBatch.seeded(task, 5, 0)
        outcome = batch.step(np.ones((3, 5), dtype=np.bool_))
        covariance = Parts.of(task).fused(batch.delivered)[1]
        loss = 3.0 * expected(outcome.error, covariance, weights)
        np.testing.assert_allclose(-outcome.reward_error, loss, rtol=1e-12)
        json.dumps(task.settings)
    assert fusion_gym.make_task(TOBIT, error=total).settings["error"].endswith("total")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda task: fusion_gym.make_task("own_names:me/Other-v0"), "me/Other-v0"),
        (lambda task: fusion_gym.make_task("absent_names:me/OwnCart-v0"), "'absent_names' cannot"),
        (lambda task: fusion_gym.make_task("mine/Foreign-v0"), "cartpole:CartPoleEnv'; it must be"),
        (lambda task: fusion_gym.make_task("mine/Wrapped-v0"), "additional wrappers; it must be"),
        (lambda task: make_policy("own_names:worst", task), "a class with knowledge"),
        (lambda task: make_policy("subprocess:Popen:args=true", task), "a class with knowledge"),
        (lambda task: make_policy("own_names:Oldest:step=5", task), "did you mean 'steps'"),
        (lambda task: fusion_gym.make_task(TOBIT, error="own_names:wrong"), "of shape"),
        (lambda task: fusion_gym.make_task(TOBIT, error="own_names:below"), ">= 0"),
        *(
            (lambda task, name=name: fusion_gym.make_task(TOBIT, error=name), f"error = '{name}'")
            for name in ("os.path:join", "math:sqrt", "json:loads", "own_names:wrong")
        ),
    ],
)
def test_what_cannot_be_had_is_reported_in_one_line(own: Path, make: Any, message: str) -> None:
    task = fusion_gym.make_task(TOBIT, filter="tobit")
    refused(lambda: make(task), message)


def test_a_command_finds_the_module_beside_it(own: Path) -> None:
    words = ["--env", "own_names:me/OwnCart-v0", "--set", "error=own_names:worst", "horizon=10"]
    policies = ["--policies", "own_names:Oldest:steps=2", "always", "--episodes", "8"]
    shutil.copy(Path(__file__).with_name("own_names.py"), own)
    line = [sys.executable, "-m", "fusion_gym.commands", "evaluate", *words, *policies]
    env = {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin", "HOME": ".", "OMP_NUM_THREADS": "1"}
    subprocess.run([*line, "--json", "found.json"], cwd=own, env=env, check=True)
    assert "own_names:Oldest" in (own / "found.json").read_text()


def test_an_own_environment_has_a_page_and_a_comparison(own: Path) -> None:
    name = "own_names:me/OwnCart-v0"
    page = succeed("info", [name]).out
    assert "me/OwnCart-v0 (environments)" in page
    assert f"{VARIANT} is {TOBIT} with" in succeed("info", [VARIANT]).out
    words = ["--env", name, "--set", "horizon=20", "--episodes", "4", "--output", "compared"]
    printed = succeed("compare", [*words, "--policies", "own_names:Oldest", "send_on_delta"]).out
    assert "own_names:Oldest" in printed
    assert "me/Other-v0" in refusal("info", ["own_names:me/Other-v0"])


def test_a_variant_is_its_environment_with_the_options_of_its_registration(own: Path) -> None:
    options = {"filter": "tobit", "token_rate": 3.0, "max_episode_steps": 7}
    expected = fusion_gym.make_task(TOBIT, **options)
    for name in (VARIANT, "mine/OfClass-v0"):
        single: Any = gym.make(name, token_rate=3.0)
        vector: Any = gym.make_vec(name, 2, token_rate=3.0)
        assert single.spec.max_episode_steps == vector.task.horizon == 7
        assert single.unwrapped.task.settings == vector.task.settings == expected.settings
        assert "token_rate: ArrayLike = 3  (default: " in single.unwrapped.spec.pprint(True)
        tasks = [
            fusion_gym.make_task(name, token_rate=3.0),
            fusion_gym.make_sb3_vec_env(name, 2, token_rate=3.0).task,
            fusion_gym.parallel_env(name, token_rate=3.0).task,
            one_batch(make_vec_env(name, 2, env_kwargs={"token_rate": 3.0})).task,
        ]
        for task in tasks:
            assert (task.settings, task.horizon) == (expected.settings, 7)
        assert fusion_gym.make_task(name, max_episode_steps=9).horizon == 9


def test_a_registration_goes_before_a_file_of_options(own: Path) -> None:
    """As Gymnasium joins the options: registered beneath given ones, a file beneath both."""
    (own / "file.yaml").write_text("{filter: kalman, token_rate: 1.5, cost_weight: 0.2}")
    arguments = {"system": "file.yaml", "token_rate": 3.0}
    single: Any = gym.make(VARIANT, **arguments)
    settings = single.unwrapped.task.settings
    assert [settings[key] for key in ("filter", "token_rate", "cost_weight")] == ["tobit", 3.0, 0.2]
    assert fusion_gym.make_task(VARIANT, **arguments).settings == settings
    config = EnvironmentConfig(id=VARIANT, options=arguments)
    assert "system" not in config.options
    assert fusion_gym.make_task(VARIANT, **config.options).settings == settings


def test_commands_train_and_evaluate_in_a_variant(own: Path) -> None:
    (own / "training.yaml").write_text(
        f"""
        environment: {{id: "{VARIANT}", options: {{memory: true}}}}
        algorithm: {{name: ppo, n_steps: 8, batch_size: 16}}
        training: {{timesteps: 32, num_envs: 4}}
        validation: {{every: 32, episodes: 4}}
        output: trained
        """
    )
    error = refusal("train", ["--config", "training.yaml"])
    assert "names code" in error
    assert "--trust" in error
    del sys.modules["own_variants"], gym.registry["mine/Tobit-v0"]  # the command imports them
    succeed("train", ["--config", "training.yaml", "--trust"])
    policies = ["--policies", "always", "model:trained/best_model.zip", "--episodes", "8"]
    given = ["--config", "trained/config.yaml", "--trust", *policies]
    succeed("evaluate", [*given, "--json", "variant.json"])
    base = ["filter=tobit", "token_rate=2", "max_episode_steps=7", "memory=true"]
    succeed("evaluate", ["--env", TOBIT, "--set", *base, *policies, "--json", "base.json"])
    variant, same = (json.loads((own / f"{name}.json").read_text()) for name in ("variant", "base"))
    assert variant.pop("env") == VARIANT
    assert same.pop("env") == TOBIT
    assert variant == same
