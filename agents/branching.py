"""Train branching_ppo in classes of the model zoo, and compare it with the searched rule.

    python -m agents.branching                    # runs/branching/branching.csv

Each training takes about 20 minutes of a processor, starts at the rule of the zoo's agent, and is
calibrated with it. Rule, zoo agent and calibrated agent run the same fresh episodes. Finished
classes and checkpoints of trainings stay in the work folder.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
import pandas as pd
import torch

from agents.benchmark.jobs import Runner
from agents.workers import Pool
from fusion_gym import seeds, zoo
from fusion_gym.arrays import Array
from fusion_gym.commands.command_line import OUTPUT_FOLDER, Long, whole
from fusion_gym.entries import Plain
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import run_priced
from fusion_gym.output.files import replacing
from fusion_gym.output.tables import console, table_tables
from fusion_gym.policies.registry import make_policy
from fusion_gym.policies.saved import read_calibration
from fusion_gym.training.calibration import calibrate
from fusion_gym.training.config import Experiment
from fusion_gym.training.run import holds_training, train

EPISODES, CALIBRATION, FIRST = 2000, (16, 400), seeds.TEST[10_000_000]
TIMESTEPS = {  # of about 20 minutes of a processor
    "tobit_oscillator_scheduler": 160_000_000,
    "biased_tracking_scheduler": 160_000_000,
    "biased_tracking_centre": 160_000_000,
    "linear_fusion_centre": 300_000_000,
    "linear_fusion_scheduler": 100_000_000,
    "markov_jump_scheduler": 160_000_000,
    "remote_estimation_scheduler": 300_000_000,
    "correlated_tracking_centre": 60_000_000,
}


class GainRow(NamedTuple):
    """Relative cost of a policy beyond the rule's, in percent, and its 95 % half-width."""

    name: str
    policy: str
    price: float
    gain: float
    half_width: float
    seconds: float  # of the processor in the training


@dataclass(frozen=True)
class BranchingJob:
    """The training of a class and its comparison; the training is in the folder."""

    name: str
    timesteps: int
    seed: int
    folder: Path
    weight: ClassVar[float] = 1200.0

    @property
    def inputs(self) -> Plain:
        """Return the key of the result."""
        return {"name": self.name, "timesteps": self.timesteps, "seed": self.seed}


def run_branching(job: BranchingJob) -> list[tuple[Any, ...]]:
    """Train or continue, calibrate, and return the entries of the rows of both agents."""
    torch.set_num_threads(1)
    card, zoo_file = zoo.card(job.name), Path(zoo.model_path(job.name))
    rule, folder = read_calibration(zoo_file)[0], job.folder / f"{job.name}_{job.seed}"
    experiment = Experiment.model_validate(
        {
            "environment": card["training"]["environment"],
            "algorithm": {"name": "branching_ppo", "rule": rule},
            "training": {"timesteps": job.timesteps, "num_envs": 128, "seed": job.seed},
            "validation": {"every": job.timesteps // 10, "episodes": 512},
            "calibration": None,
            "output": str(folder),
        }
    )
    seconds = train(experiment, resume=holds_training(folder), quiet=True)["seconds"]
    trained = sum(own for activity, own in seconds.items() if activity != "validation")
    environment, prices = experiment.environment, card["test"]["prices"]
    task = make_task(environment.id, **environment.options)
    files, output = [folder / "best_model.zip", folder / "final_model.zip"], folder / "policy.zip"
    calibrate(task, files, prices, CALIBRATION, output, rule)
    each, numbers = np.repeat(prices, EPISODES), FIRST + np.tile(range(EPISODES), len(prices))

    def costs(text: str) -> Array:
        means = run_priced(task, make_policy(text, task), numbers, each)
        return means.cost(each).reshape(len(prices), -1)

    base, rows = costs(rule), []
    for policy, text in (("branching", f"model:{output}"), ("zoo", f"zoo:{job.name}")):
        difference, mean = costs(text) - base, base.mean(1)
        reach = 1.96 * difference.std(1, ddof=1) / EPISODES**0.5
        columns = prices, 100 * difference.mean(1) / mean, 100 * reach / mean
        rows += [(job.name, policy, *row, trained) for row in zip(*columns, strict=True)]
    return rows


def gain_text(rows: Sequence[GainRow]) -> str:
    """Return the mean over prices with its half-width, in percent."""
    widths = np.array([row.half_width for row in rows])
    return (
        f"{np.mean([row.gain for row in rows]):+.2f} ± {np.sqrt((widths**2).sum()) / len(rows):.2f}"
    )


@dataclass(frozen=True)
class Branching(Long):
    """Train branching_ppo in classes of the zoo, and compare it with the searched rule."""

    program = "python -m agents.branching"

    work: Annotated[Path, OUTPUT_FOLDER] = Path("runs/branching")
    """Folder of trainings and of the table."""
    workers: Annotated[int, whole(1, 512)] = 2
    """Number of parallel processes."""
    names: tuple[str, ...] = tuple(TIMESTEPS)
    """Names of zoo agents."""
    share: float = 1.0
    """Share of the trainings' time steps."""
    seed: int = 0
    """Seed of the trainings."""

    def run(self) -> None:
        """Run unfinished classes, and write and print the table."""
        runner, began = Runner(self.work.absolute(), Pool(self.workers)), time.perf_counter()
        jobs = [
            BranchingJob(name, round(self.share * TIMESTEPS[name]), self.seed, runner.folder)
            for name in self.names
        ]
        entries = runner.run(run_branching, jobs, "classes")
        results = [[GainRow(*row) for row in rows] for rows in entries]
        with replacing(self.work / "branching.csv") as partial:
            pd.DataFrame([row for rows in results for row in rows]).to_csv(
                partial, index=False, float_format="%.4g"
            )
        cells = []
        for rows in results:
            own, published = ([r for r in rows if r.policy == p] for p in ("branching", "zoo"))
            prices = " ".join(f"{row.gain:+.1f}" for row in own)
            cells.append([rows[0].name, gain_text(own), prices, gain_text(published)])
        title = "Cost beyond the searched rule's, %"
        heads = "class", "branching_ppo", "by price, lowest first", "zoo"
        console().print(table_tables(title, heads, cells))
        console().print(f"{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    Branching.main()
