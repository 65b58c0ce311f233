"""Agents of the benchmark, each trained at random prices of a range.

This module imports no other part of the benchmark, so that its changes train nothing again.
"""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch

from fusion_gym.entries import Plain
from fusion_gym.output.files import replacing
from fusion_gym.training.callbacks import DAMAGED
from fusion_gym.training.config import Experiment
from fusion_gym.training.run import holds_training, train
from fusion_gym.validation import ConfigurationError


@dataclass(frozen=True)
class TrainingJob:
    """A training; checkpoints and models are in the folder."""

    experiment: Experiment
    folder: Path
    weight: ClassVar[float] = 100.0

    @property
    def inputs(self) -> Plain:
        """Return the key of the result."""
        return {"experiment": self.experiment.model_dump(mode="json")}

    @property
    def agent(self) -> Path:
        """Return the file of the agent, without its optimiser's state."""
        return self.folder / "agent.zip"


def run_training(job: TrainingJob) -> float:
    """Train or continue, and return the processor seconds."""
    torch.set_num_threads(1)
    experiment = job.experiment.model_copy(update={"output": str(job.folder)})
    summary = train(experiment, resume=holds_training(job.folder), quiet=True)
    if not summary["finished"]:
        raise KeyboardInterrupt
    with replacing(job.agent) as partial:
        partial.write_bytes(small_model(job.folder / "best_model.zip"))
    seconds = (value for name, value in summary["seconds"].items() if name != "validation")
    return float(sum(seconds))


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
