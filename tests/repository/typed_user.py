"""What a user writes with fusion-gym, for ``mypy --strict``: make, step, evaluate, rules.

Every ``type: ignore`` stands where the types must tell a mistake: mypy tells those that it does not
need. It runs as well, beside ``tests/helpers/linear_case.py``.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, assert_type

import gymnasium as gym
import numpy as np
from linear_case import build
from numpy.typing import NDArray

import fusion_gym
from fusion_gym.arrays import Array
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.core.task import Task
from fusion_gym.evaluation import (
    EpisodeResults,
    Interval,
    Trajectory,
    lower_envelope,
    mean_interval,
    paired_difference,
    record_episode,
    run_episodes,
    summarise,
    watch,
)
from fusion_gym.policies.base import Policy, Requests, Rule, parameter
from fusion_gym.systems.tobit.linear import LinearFusionOptions
from fusion_gym.systems.tobit.oscillator import TobitOscillatorOptions
from fusion_gym.validation import number

OSCILLATOR = "fusion_gym/TobitOscillator-v1"


def step_one() -> float:
    """One environment, by Gymnasium's own name and by the class behind it."""
    env = gym.make(OSCILLATOR, filter="tobit", token_rate=2.0)
    _, info = env.reset(seed=0)
    own = env.unwrapped
    assert isinstance(own, fusion_gym.FusionEnv)
    assert_type(own.task, Task)
    names: list[str] = [name.upper() for name in own.observation_names]
    observation, reward, terminated, truncated, info = own.step(np.array([1, 0, 0]))
    assert_type(observation, NDArray[np.float32])
    assert_type((terminated, truncated), tuple[bool, bool])
    granted: NDArray[np.bool_] = info["granted"]
    return float(reward) + len(names) + float(granted.sum())


def step_many() -> NDArray[np.float64]:
    """Many at once."""
    envs = gym.make_vec(OSCILLATOR, num_envs=8, horizon=5)
    own = envs.unwrapped
    assert isinstance(own, fusion_gym.FusionVectorEnv)
    observations, _ = own.reset(seed=1)
    assert_type(observations, NDArray[np.float32])
    total = np.zeros(own.num_envs)
    for _ in range(7):
        observations, rewards, terminated, truncated, _ = own.step(own.action_space.sample())
        total += rewards
        assert_type(terminated | truncated, NDArray[np.bool_])
    return total


def for_other_libraries() -> int:
    """Stable-Baselines3's face and PettingZoo's."""
    rows = fusion_gym.make_sb3_vec_env(OSCILLATOR, num_envs=2, local=True, horizon=5)
    rows.reset()
    parallel = fusion_gym.parallel_env(OSCILLATOR, horizon=5)
    observations, _ = parallel.reset(seed=0)
    actions = {agent: int(parallel.action_space(agent).sample()) for agent in parallel.agents}
    observations, rewards, *_ = parallel.step(actions)
    return rows.num_envs + len(observations) + len(rewards)


@dataclass
class OldNews(Rule):
    """A rule: request when the last delivery is at least ``steps`` old."""

    steps: float = parameter(5.0, number, at_least=1.0)
    knowledge: ClassVar[Knowledge] = "centre"

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        return signals["age"] >= self.steps


class Surprised:
    """The same interface without a base."""

    knowledge: Knowledge = "own"

    def __init__(self, threshold: float = 1.0) -> None:
        self.threshold = threshold

    def reset(self, runs: int, seed: int = 0) -> None:
        """Nothing to forget."""

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        size = np.abs(signals["innovation"]).max(axis=1)
        return np.asarray(size >= self.threshold, dtype=np.bool_)


def worst(error: Array, covariance: Array) -> Array:
    """A reward's error of one's own: from (n, N) and (n, n, N) to costs (N,)."""
    return np.asarray(np.abs(error).max(axis=0), dtype=np.float64)


def evaluate() -> tuple[Interval, Interval]:
    """Rules and plants of one's own, evaluated on the same noise."""
    fusion_gym.register("typed/Linear-v0", build)
    fusion_gym.register_policy("old_news", OldNews)
    task = fusion_gym.make_task("typed/Linear-v0", error=worst, horizon=20)
    assert_type(task, Task)
    policies: dict[str, Policy] = {
        "always": fusion_gym.make_policy("always", task),
        "old": OldNews(steps=3.0),
        "surprised": Surprised(),
    }
    results = {name: run_episodes(task, policy, 20, seed=0) for name, policy in policies.items()}
    assert_type(results, dict[str, EpisodeResults])
    report: dict[str, Any] = summarise(results["old"])
    assert lower_envelope(results)[-1].mse <= float(results["old"].mse.mean())
    trajectory = record_episode(task, policies["surprised"], seed=0)
    assert_type(trajectory, Trajectory)
    first, *_ = watch(task, policies, seed=0, steps=1)
    assert_type(first, NDArray[np.uint8])
    assert set(report) >= {"mse", "rate"}
    difference = paired_difference(results["surprised"], results["always"])
    return mean_interval(results["old"].mse), difference


def options_objects() -> list[Task]:
    """Options that an editor completes."""
    linear = LinearFusionOptions(transition=[[0.9]], process_covariance=[[0.1]],
                                 measurement_matrices=[[1.0], [1.0]], token_rate=2.0)  # fmt: skip
    oscillator = TobitOscillatorOptions(filter="tobit", censoring_threshold=[[0.0], [1.0], [2.0]])
    return [fusion_gym.make_task(linear), fusion_gym.make_task(oscillator)]


def mistakes(task: Task, policy: Policy) -> None:
    """What the types must tell."""
    fusion_gym.make_taks(OSCILLATOR)  # type: ignore[attr-defined]
    fusion_gym.make_policy(3, task)  # type: ignore[call-overload]
    run_episodes(task, policy, "many", 0)  # type: ignore[arg-type]
    run_episodes(policy, task, 3, 0)  # type: ignore[arg-type]
    LinearFusionOptions(token_rat=2.0)  # type: ignore[call-arg]
    LinearFusionOptions(error_weight="two")  # type: ignore[arg-type]
    print(run_episodes(task, policy, 3, 0).mean_squared_error)  # type: ignore[attr-defined]
    run_episodes(task, lambda signals: signals, 3, 0)  # type: ignore[arg-type]
    print(fusion_gym.evaluation.run_episode)  # type: ignore[attr-defined]


if __name__ == "__main__":
    print(step_one(), step_many().mean(), for_other_libraries(), evaluate(), options_objects()[0])
