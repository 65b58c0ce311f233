"""Calibrations of trained agents with the searched rule of their class."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from agents.benchmark.jobs import Job
from fusion_gym.entries import Options
from fusion_gym.envs.registration import make_task
from fusion_gym.output.progress import quietly
from fusion_gym.policies.saved import CalibrationPoint
from fusion_gym.training.calibration import calibrate


@dataclass(frozen=True)
class CalibrationJob(Job):
    """The calibration of the agent of a file, whose content has the hash ``agent``."""

    agent: str
    options: Options  # of its environment
    prices: tuple[float, ...]
    rule: str
    episodes: tuple[int, int]
    file: Path = field(metadata={"key": False})
    policy: Path = field(metadata={"key": False})
    weight: ClassVar[float] = 20.0


@dataclass(frozen=True)
class CalibrationResult:
    """Processor seconds, and the calibration.

    ``relative_cost`` is the mean over the prices of the cost over the rule's, minus 1, in tuning.
    """

    seconds: float
    relative_cost: float
    points: tuple[CalibrationPoint, ...]


def run_calibration(job: CalibrationJob) -> CalibrationResult:
    """Calibrate, write the policy, and return the costs."""
    torch.set_num_threads(1)
    began, task = time.process_time(), make_task(job.setting.environment, **job.options)
    with quietly():
        rows = calibrate(task, [job.file], job.prices, job.episodes, job.policy, job.rule)
    relative = float(np.mean([row.cost / row.rule_cost for row in rows])) - 1.0
    points = tuple(row.point for row in rows)
    return CalibrationResult(time.process_time() - began, relative, points)
