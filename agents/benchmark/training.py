"""Agents of a class at random prices of its range, each calibrated with the searched rule."""

from __future__ import annotations

import io
import json
import math
import time
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from agents.benchmark.jobs import Job
from fusion_gym.entries import Plain
from fusion_gym.envs.registration import make_task
from fusion_gym.output.files import replacing
from fusion_gym.output.progress import quietly
from fusion_gym.policies.calibrated import CalibrationPoint
from fusion_gym.training.calibration import EPISODES, calibrate
from fusion_gym.training.checkpoint import DAMAGED
from fusion_gym.training.config import Experiment
from fusion_gym.training.run import holds_training, train
from fusion_gym.validation import ConfigurationError

CALIBRATION = 0.3  # seconds of a calibration over a training's


@dataclass(frozen=True)
class TrainingJob(Job):
    """One agent and its calibration; checkpoints and models are in the folder."""

    experiment: Experiment
    prices: tuple[float, ...]
    rule: str
    episodes: tuple[int, int] = EPISODES
    folder: Path = field(default=Path(), metadata={"key": False})

    @property
    def weight(self) -> float:  # type: ignore[override]
        """Return about the seconds on one core, of training and calibration."""
        return (1.0 + CALIBRATION) * self.setting.seconds[self.name]

    @property
    def agent(self) -> Path:
        """Return the file of the agent, without its optimiser's state."""
        return self.folder / "agent.zip"

    @property
    def policy(self) -> Path:
        """Return the file of the calibrated agent, or of the agent that cannot be calibrated."""
        return self.folder / "calibrated_model.zip" if self.setting.calibrated else self.agent


@dataclass(frozen=True)
class TrainingResult:
    """Processor seconds of training and calibration, and the calibration.

    ``relative_cost`` is the mean over the prices of the cost over the rule's, minus 1, in tuning,
    NaN without a calibration.
    """

    seconds: float
    calibration_seconds: float
    relative_cost: float
    points: tuple[CalibrationPoint, ...]


def run_training(job: TrainingJob) -> TrainingResult:
    """Train or continue, calibrate, and return the costs of both."""
    torch.set_num_threads(1)
    experiment = job.experiment.model_copy(update={"output": str(job.folder)})
    summary = train(experiment, resume=holds_training(job.folder), quiet=True)
    if not summary["finished"]:
        raise KeyboardInterrupt
    with replacing(job.agent) as partial:
        partial.write_bytes(small_model(job.folder / "best_model.zip"))
    seconds = sum(value for name, value in summary["seconds"].items() if name != "validation")
    if not job.setting.calibrated:
        return TrainingResult(seconds, 0.0, math.nan, ())
    environment, began = experiment.environment, time.process_time()
    task = make_task(environment.id, **environment.options)
    with quietly():
        rows = calibrate(task, [job.agent], job.prices, job.episodes, job.policy, job.rule)
    return TrainingResult(
        seconds,
        time.process_time() - began,
        float(np.mean([row.cost / row.rule_cost for row in rows])) - 1.0,
        tuple(row.point for row in rows),
    )


OPTIMISER = "policy.optimizer.pth"
_OF_RUNS = ("_last_obs", "_last_episode_starts", "_last_original_obs", "ep_info_buffer")
_BEGINNING = (1980, 1, 1, 0, 0, 0)  # of an archive's time: equal content gives equal bytes


def small_model(path: Path) -> bytes:
    """Return the compressed archive without runs, with the optimiser before its first step."""
    packed = io.BytesIO()
    try:
        with zipfile.ZipFile(path) as old, zipfile.ZipFile(packed, "w") as new:
            for part in old.namelist():
                content = old.read(part)
                if part == OPTIMISER:
                    content = _unused(content)
                if part == "data":
                    content = _without_runs(content)
                info = zipfile.ZipInfo(part, _BEGINNING)
                info.compress_type = zipfile.ZIP_DEFLATED
                new.writestr(info, content)
    except DAMAGED as error:
        raise ConfigurationError(f"model = {str(path)!r} cannot be read: {error}") from None
    return packed.getvalue()


def _without_runs(content: bytes) -> bytes:
    """Return the settings without the last observations of the training's runs."""
    data: Plain = json.loads(content)
    return json.dumps(
        {key: None if key in _OF_RUNS else item for key, item in data.items()}
    ).encode()


def _unused(content: bytes) -> bytes:
    """Return the optimiser's settings without its state."""
    import torch

    data: Plain = torch.load(io.BytesIO(content), "cpu", weights_only=True)
    written = io.BytesIO()
    torch.save({**data, "state": {}}, written)
    return written.getvalue()
