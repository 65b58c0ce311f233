"""Train plain PPO of Stable-Baselines3 in nine settings, and compare it with rules.

    python -m benchmarks.plain_ppo [SETTING …] [--output runs/plain_ppo] [--resume]

The settings are the registered environments with their defaults, and the Tobit oscillator of
``agents/benchmark/settings.yaml``. No parameter is tuned to a setting. Rewards are normalised, and
their error is the mismatch. Rules and agents have no memory and run the same episodes. An agent's
share is 0 at the return of the best simple rule, which uses only the clock or random numbers, and 1
at the return of the best rule of the environment's sweep. A training and the rules of a setting are
pieces with a file each: ``--resume`` skips finished ones.

In the biased oscillator the error diverges in about one episode of a thousand: a share there has a
standard error of about .3, and of .75 with 300 episodes.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rich.table import Table
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from fusion_gym.core.task import Task
from fusion_gym.envs.privileged import make_sb3_vec_env
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.output import tables
from fusion_gym.output.ending import report_errors
from fusion_gym.output.files import write
from fusion_gym.policies.base import Policy
from fusion_gym.policies.model import ModelPolicy
from fusion_gym.policies.registry import make_policy
from fusion_gym.training.checked import load_checked
from fusion_gym.training.sweeps import Sweep
from fusion_gym.validation import choice

Returns = dict[str, float]
RATES = 0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.7
SIMPLE = ["always", "never", "round_robin", *(f"random:rate={rate}" for rate in RATES)]
WAYS = "likeliest", "drawn"
VALUE = {"belief_features": ["value"]}
# The trainings of a setting: what the observation shows beside the defaults, and the seed.
TRAININGS: dict[str, tuple[dict[str, Any], int]] = {
    "value_0": (VALUE, 0),
    "value_1": (VALUE, 1),
    "default_0": ({}, 0),
}


@dataclass(frozen=True)
class Setting:
    """An environment with options, and the sweep of its rules."""

    environment: str
    sweep: str
    options: dict[str, Any] = field(default_factory=dict)

    def task(self, **changes: Any) -> Task:
        """Return the task with these options changed."""
        return make_task(self.environment, **self.options | changes)


_TOBIT = "fusion_gym/TobitOscillator-v1"
_BENCHMARK = {"filter": "tobit", "random_start": True, "token_rate": 2.0, "cost_weight": 0.01}
SETTINGS = {
    "biased_oscillator": Setting("fusion_gym/BiasedOscillator-v1", "biased_sweep"),
    "tobit_benchmark": Setting(_TOBIT, "tobit_oscillator_sweep", _BENCHMARK),
    "linear_fusion": Setting("fusion_gym/LinearFusion-v2", "scale_free_sweep"),
    "tobit_oscillator": Setting(_TOBIT, "tobit_oscillator_sweep"),
    "biased_tracking": Setting("fusion_gym/BiasedTracking-v1", "biased_sweep"),
    "correlated_tracking": Setting("fusion_gym/CorrelatedTracking-v1", "correlated_tracking_sweep"),
    "markov_jump": Setting("fusion_gym/MarkovJumpTracking-v1", "markov_jump_sweep"),
    "unknown_input": Setting("fusion_gym/UnknownInput-v1", "unknown_input_sweep"),
    "remote_estimation": Setting("fusion_gym/RemoteEstimation-v1", "scale_free_sweep"),
}


@dataclass(frozen=True)
class Row:
    """A setting: processor seconds, the best rules' returns, and the shares of each training.

    The first share is of an agent with its likeliest actions, the second with random draws.
    """

    setting: str
    seconds: float
    simple: tuple[str, float]
    best: tuple[str, float]
    shares: dict[str, tuple[float, float]]

    def cells(self) -> list[str]:
        """Return the cells of the table."""
        ends = (f"{rule} ({value:.4g})" for rule, value in (self.simple, self.best))
        shares = (f"{likeliest:.2f} · {drawn:.2f}" for likeliest, drawn in self.shares.values())
        return [self.setting, *ends, *shares, f"{self.seconds:.0f}"]


def main() -> None:
    """Run the settings that the command line names, or all, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("settings", nargs="*", metavar="SETTING", help="all by default")
    parser.add_argument("--output", type=Path, default=Path("runs/plain_ppo"))
    parser.add_argument("--episodes", type=int, default=2000)
    parser.add_argument("--timesteps", type=int, default=300_000)
    parser.add_argument("--gamma", type=float, default=0.9)
    parser.add_argument("--n-steps", type=int, default=32)
    parser.add_argument("--resume", action="store_true", help="continue from the existing results")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    heads = "setting", "best simple rule", "best rule", *TRAININGS, "CPU s"
    table = Table(*heads, title="shares; likeliest · drawn actions")
    with report_errors():
        for name in arguments.settings or SETTINGS:
            choice("setting", name, SETTINGS)
            table.add_row(*judge(name, arguments).cells())
            tables.console().print(table)


def judge(name: str, arguments: argparse.Namespace) -> Row:
    """Return the row of a setting, from stored pieces or a run."""
    setting, folder = SETTINGS[name], arguments.output / name
    inputs = {"episodes": arguments.episodes}
    run = partial(run_rules, setting, **inputs)
    rules, seconds = piece(folder / "rules.json", arguments.resume, run, inputs)
    simple, best = (max(names, key=rules.__getitem__) for names in (SIMPLE, rules))
    inputs |= {name: getattr(arguments, name) for name in ("timesteps", "gamma", "n_steps")}
    shares = {}
    for title, (cells, seed) in TRAININGS.items():
        run = partial(train, setting, cells, seed, **inputs)
        agent, more = piece(folder / f"{title}.json", arguments.resume, run, inputs)
        likeliest, drawn = (
            (agent[way] - rules[simple]) / (rules[best] - rules[simple]) for way in WAYS
        )
        shares[title] = likeliest, drawn
        seconds += more
    return Row(name, seconds, (simple, rules[simple]), (best, rules[best]), shares)


def piece(
    path: Path, resume: bool, run: Callable[[], Returns], inputs: dict[str, Any]
) -> tuple[Returns, float]:
    """Return the result of ``run``, or a stored one, and its processor seconds."""
    stored = json.loads(path.read_text()) if resume and path.exists() else {}
    if stored.get("asked") != inputs:
        before = time.process_time()
        stored = {"asked": inputs, "returns": run(), "seconds": time.process_time() - before}
        write(path, stored)
    return stored["returns"], stored["seconds"]


def run_rules(setting: Setting, episodes: int) -> Returns:
    """Return the mean return of every simple rule and every rule of the sweep."""
    task = setting.task()
    sweep = load_checked(Sweep, setting.sweep, "sweep").policies(task.reward.price)
    rules = dict.fromkeys([*SIMPLE, *sweep])
    return {rule: mean_return(task, make_policy(rule, task), episodes) for rule in rules}


def train(
    setting: Setting, cells: dict[str, Any], seed: int, *, episodes: int, timesteps: int,
    gamma: float, n_steps: int,
) -> Returns:  # fmt: skip
    """Return the mean return of a training's agent, for likeliest and drawn actions."""
    options = setting.options | cells
    env = make_sb3_vec_env(
        setting.environment, num_envs=64, seed=seed, training_error="mismatch", **options
    )
    scaled = VecNormalize(env, norm_obs=False, norm_reward=True, gamma=gamma)
    model = PPO("MlpPolicy", scaled, n_steps=n_steps, gamma=gamma, seed=seed, device="cpu")
    model.learn(timesteps)
    return {
        way: mean_return(env.task, ModelPolicy(model, env.task, way == "likeliest"), episodes)
        for way in WAYS
    }


def mean_return(task: Task, policy: Policy, episodes: int) -> float:
    """Return the mean over the episodes with the seeds from 0."""
    return float(run_episodes(task, policy, episodes, 0).returns.mean())


if __name__ == "__main__":
    main()
