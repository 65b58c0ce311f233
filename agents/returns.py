"""Measure what policies return in every environment with its defaults.

    python -m agents.returns                         # fusion_gym/envs/returns.csv

The best threshold and the searched rule are tuned at the environment's price, PPO has the lines of
README. Each policy runs the same 1,000 test episodes. Gymnasium's ``reward_threshold`` is the
return of the better one of both rules. Finished environments stay in the work folder.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
import pandas as pd
import torch
from stable_baselines3 import PPO

from agents.benchmark.jobs import Runner
from agents.benchmark.rules import COUNT
from agents.benchmark.settings import load_suite
from agents.workers import Pool
from fusion_gym import seeds
from fusion_gym.commands.command_line import OUTPUT_FOLDER, Long, whole
from fusion_gym.core.knowledge import covers
from fusion_gym.core.task import Task
from fusion_gym.entries import Plain
from fusion_gym.envs import registration
from fusion_gym.envs.privileged import make_sb3_vec_env
from fusion_gym.envs.returns import FILE, ReturnRow
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.evaluation.rule_search import search_of_class, search_rule, try_thresholds
from fusion_gym.output.files import replacing
from fusion_gym.policies.base import Policy
from fusion_gym.policies.registry import make_policy
from fusion_gym.solvers.silence import cost_bound
from fusion_gym.validation import ConfigurationError

EPISODES = 1000
GENERATIONS = 15
TIMESTEPS = 300_000
CLASS: Literal["scheduler"] = "scheduler"  # of an agent without memory


@dataclass(frozen=True)
class ReturnJob:
    """All policies in one environment; PPO writes its agent into the folder."""

    environment: str
    folder: Path
    weight: ClassVar[float] = 120.0

    @property
    def inputs(self) -> Plain:
        """Return the key of the result."""
        return {"environment": self.environment}


def run_returns(job: ReturnJob) -> list[ReturnRow]:
    """Return a row for each policy of an environment, and for the bound of all."""
    torch.set_num_threads(1)
    task, rows = registration.make_task(job.environment), []
    for kind, text, policy in _policies(job, task):
        results = run_episodes(task, policy, EPISODES, seeds.TEST.start)
        reach = 1.96 * float(results.returns.std(ddof=1)) / EPISODES**0.5
        means = (float(item.mean()) for item in (results.mse, results.rate, results.tokens))
        row = job.environment, kind, text, float(results.returns.mean()), reach, *means
        rows.append(ReturnRow(*row))
    try:
        bound = cost_bound(task, float(task.reward.price.fixed or 0.0)).lower
        rows.append(ReturnRow(job.environment, "bound", "", -task.horizon * bound))
    except ConfigurationError:
        pass
    return rows


def _policies(job: ReturnJob, task: Task) -> Iterator[tuple[str, str, Policy]]:
    """Yield kind, text and policy."""
    price = float(task.reward.price.fixed or 0.0)
    texts = {"random": "random", "always": "always", "never": "never"}
    trials = []
    for rule in load_suite().rules:
        try:
            knowledge = make_policy(rule.policy.format(value=rule.ends[0]), task).knowledge
            values = np.geomspace(*rule.ends, COUNT).tolist()
            if covers(CLASS, knowledge):
                trials += try_thresholds(task, rule.policy, values, 96, seeds.TUNING.start)
        except ConfigurationError:  # a rule of another family
            continue
    texts["best threshold"] = min(trials, key=lambda trial: trial.cost(price)).policy
    search = search_of_class(CLASS, task, (max(price, 1e-4),), generations=GENERATIONS)
    texts["searched rule"] = search_rule(search).policies[0]
    for kind, text in texts.items():
        yield kind, text, make_policy(text, task)
    envs = make_sb3_vec_env(job.environment, num_envs=128, seed=0)
    model = PPO("MlpPolicy", envs, 1e-3, n_steps=32, batch_size=512, gamma=0.95, seed=0)
    file = job.folder / job.environment.rpartition("/")[2]
    model.learn(TIMESTEPS).save(file)
    yield "PPO", "", make_policy(f"model:{file}", task)


@dataclass(frozen=True)
class Returns(Long):
    """Measure what policies return in every environment with its defaults."""

    program = "python -m agents.returns"

    work: Annotated[Path, OUTPUT_FOLDER] = Path("runs/returns")
    """Folder of finished environments and agents."""
    workers: Annotated[int, whole(1, 512)] = 2
    """Number of parallel processes."""

    def run(self) -> None:
        """Run unfinished environments, and write the table."""
        runner = Runner(self.work.absolute(), Pool(self.workers))
        jobs = [ReturnJob(name, runner.folder) for name in registration.ENVIRONMENTS]
        rows = [row for own in runner.run(run_returns, jobs, "environments") for row in own]
        with replacing(FILE) as partial:
            pd.DataFrame(rows).to_csv(partial, index=False, float_format="%.5g")


if __name__ == "__main__":
    Returns.main()
