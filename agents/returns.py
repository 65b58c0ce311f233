"""Measure what policies return in every environment with its defaults.

    python -m agents.returns

The table is ``fusion_gym/envs/returns.csv``. The best threshold and the searched rule are tuned at
the environment's price. PPO has the lines of README, and the defaults of Stable-Baselines3. Where
SAC sets thresholds, it has the processor time of README's PPO. Each policy runs the same 1,000
test episodes. Gymnasium's ``reward_threshold`` is the return of the better one of both rules.
Finished jobs stay in the work folder.
"""

import itertools
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
import pandas as pd
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm

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
from fusion_gym.envs.returns import FILE, NAIVE, ReturnRow, read_returns, share_text
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.evaluation.rule_search import search_of_class, search_rule, try_thresholds
from fusion_gym.output.files import replacing
from fusion_gym.output.tables import console, table_tables
from fusion_gym.policies.base import Policy
from fusion_gym.policies.registry import make_policy
from fusion_gym.solvers.silence import cost_bound
from fusion_gym.validation import ConfigurationError

EPISODES = 1000
GENERATIONS = 15
SEEDS = 3
CLASS: Literal["scheduler"] = "scheduler"  # of an agent without memory


class Learner(NamedTuple):
    """An algorithm, its arguments, its runs and options, and its steps at most."""

    algorithm: type[BaseAlgorithm]
    arguments: Mapping[str, Any]
    num_envs: int
    timesteps: int
    options: Mapping[str, Any] = {}


README, DEFAULTS, THRESHOLDS = "PPO", "PPO, defaults", "SAC, thresholds"
LEARNERS = {
    README: Learner(
        PPO,
        {"learning_rate": 1e-3, "n_steps": 32, "batch_size": 512, "gamma": 0.95},
        128,
        300_000,
    ),
    DEFAULTS: Learner(PPO, {"n_steps": 32}, 64, 300_000),
    THRESHOLDS: Learner(SAC, {"gamma": 0.95}, 16, 10**8, {"action": "threshold", "score": "value"}),
}
ON_THRESHOLDS = "fusion_gym/LinearFusion-v2", "fusion_gym/RemoteEstimation-v1"


@dataclass(frozen=True)
class RuleJob:
    """The rules and the bound of an environment."""

    environment: str
    weight: ClassVar[float] = 60.0

    @property
    def inputs(self) -> Plain:
        """Return the key of the result."""
        return {"environment": self.environment}


@dataclass(frozen=True)
class LearnerJob:
    """A learner in an environment; ``seconds`` of processor time end it."""

    environment: str
    kind: str
    seed: int
    folder: Path
    seconds: float = float("inf")
    weight: ClassVar[float] = 120.0

    @property
    def inputs(self) -> Plain:
        """Return the key of the result."""
        names = "environment", "kind", "seed", "seconds"
        return {name: getattr(self, name) for name in names}


def run_rules(job: RuleJob) -> list[ReturnRow]:
    """Return a row for each rule of an environment, and for the bound of all."""
    task = registration.make_task(job.environment)
    policies = [(kind, text, make_policy(text, task)) for kind, text in _rules(task)]
    rows = [_row(job.environment, task, *policy) for policy in policies]
    try:
        bound = cost_bound(task, float(task.reward.price.fixed or 0.0)).lower
        rows.append(ReturnRow(job.environment, "bound", "", -task.horizon * bound))
    except ConfigurationError:
        pass
    return rows


def run_learner(job: LearnerJob) -> ReturnRow:
    """Train the learner, write its agent into the folder, and return its row."""
    torch.set_num_threads(1)
    learner = LEARNERS[job.kind]
    envs = make_sb3_vec_env(
        job.environment, num_envs=learner.num_envs, seed=job.seed, **learner.options
    )
    model = learner.algorithm("MlpPolicy", envs, seed=job.seed, **learner.arguments)
    begin = time.process_time()
    model.learn(learner.timesteps, lambda *_: time.process_time() < begin + job.seconds)
    seconds = time.process_time() - begin
    name = job.environment.rpartition("/")[2], job.kind.replace(", ", "_"), str(job.seed)
    file = job.folder / "_".join(name)
    model.save(file)
    task = registration.make_task(job.environment)
    policy = make_policy(f"model:{file}", task)
    row = _row(job.environment, task, job.kind, f"seed={job.seed}", policy)
    return row._replace(seconds=seconds)


def _row(environment: str, task: Task, kind: str, text: str, policy: Policy) -> ReturnRow:
    results = run_episodes(task, policy, EPISODES, seeds.TEST.start)
    reach = 1.96 * float(results.returns.std(ddof=1)) / EPISODES**0.5
    means = (float(item.mean()) for item in (results.mse, results.rate, results.tokens))
    return ReturnRow(environment, kind, text, float(results.returns.mean()), reach, *means)


def _rules(task: Task) -> Iterator[tuple[str, str]]:
    """Yield kind and text."""
    yield from ((name, name) for name in NAIVE)
    price = float(task.reward.price.fixed or 0.0)
    trials = []
    for rule in load_suite().rules:
        try:
            knowledge = make_policy(rule.policy.format(value=rule.ends[0]), task).knowledge
            values = np.geomspace(*rule.ends, COUNT).tolist()
            if covers(CLASS, knowledge):
                trials += try_thresholds(task, rule.policy, values, 96, seeds.TUNING.start)
        except ConfigurationError:  # a rule of another family
            continue
    yield "best threshold", min(trials, key=lambda trial: trial.cost(price)).policy
    search = search_of_class(CLASS, task, (max(price, 1e-4),), generations=GENERATIONS)
    yield "searched rule", search_rule(search).policies[0]


@dataclass(frozen=True)
class Returns(Long):
    """Measure what policies return in every environment with its defaults."""

    program = "python -m agents.returns"

    work: Annotated[Path, OUTPUT_FOLDER] = Path("runs/returns")
    """Folder of finished environments and agents."""
    workers: Annotated[int, whole(1, 512)] = 2
    """Number of parallel processes."""

    def run(self) -> None:
        """Run unfinished jobs, write the table, and print the shares of the gap."""
        runner = Runner(self.work.absolute(), Pool(self.workers))
        ids = list(registration.ENVIRONMENTS)
        grid = itertools.product(ids, (README, DEFAULTS), range(SEEDS))
        own = runner.run(run_learner, [LearnerJob(*key, runner.folder) for key in grid], "PPO")
        equal = [
            LearnerJob(row.environment, THRESHOLDS, seed, runner.folder, row.seconds)
            for seed in range(SEEDS)
            for row in own
            if row.environment in ON_THRESHOLDS and row[1:3] == (README, f"seed={seed}")
        ]
        own += runner.run(run_learner, equal, "SAC")
        every = runner.run(run_rules, [RuleJob(name) for name in ids], "rules")
        rows = [*itertools.chain.from_iterable(every), *own]
        rows.sort(key=lambda row: ids.index(row.environment))
        with replacing(FILE) as partial:
            pd.DataFrame(rows).to_csv(partial, index=False, float_format="%.5g")
        read_returns.cache_clear()
        cells = ([name, *(share_text(name, kind) for kind in LEARNERS)] for name in ids)
        title = "Share of the gap between naive policies and the best threshold"
        console().print(table_tables(title, ("environment", *LEARNERS), cells))


if __name__ == "__main__":
    Returns.main()
