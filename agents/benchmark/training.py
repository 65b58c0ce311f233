"""Agents of a class: one training per seed, at random prices of the class's range."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import torch

from agents.benchmark.jobs import Job
from fusion_gym.training.config import Experiment
from fusion_gym.training.run import holds_training, train


@dataclass(frozen=True)
class TrainingJob(Job):
    """One agent; its checkpoints and model are in the experiment's folder."""

    experiment: Experiment
    folder: Path = field(metadata={"key": False})
    weight: ClassVar[float] = 70.0

    @property
    def model(self) -> Path:
        """Return the file of the finished agent."""
        return self.folder / "best_model.zip"


def run_training(job: TrainingJob) -> float:
    """Train or continue, and return the processor seconds."""
    torch.set_num_threads(1)
    experiment = job.experiment.model_copy(update={"output": str(job.folder)})
    summary = train(experiment, resume=holds_training(job.folder), quiet=True)
    if not summary["finished"]:
        raise KeyboardInterrupt
    return float(sum(summary["seconds"].values()))
