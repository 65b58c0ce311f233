"""Configs of trainings that take a second."""

import json
from pathlib import Path
from typing import Any

import yaml

from fusion_gym.training.config import TABLE

ENV = "fusion_gym/TobitOscillator-v1"
_SIZES = {"n_steps": 16, "batch_size": 128, "n_epochs": 1, "memory": 8}
_SIZES |= {"buffer_size": 2000, "learning_starts": 100}
SMALL: dict[str, dict[str, Any]] = {
    kind: {"name": kind} | {k: v for k, v in _SIZES.items() if k in row.config.model_fields}
    for kind, row in TABLE.items()
}
SMALL["a2c"]["n_steps"] = 8
SMALL["dqn"] |= {"batch_size": 32, "learning_rate_end": 1e-4}


def small_config(folder: Path, kind: str = "ppo", **changes: Any) -> Path:
    content: dict[str, Any] = {
        "environment": {"id": ENV, "options": {"filter": "tobit", "horizon": 20}},
        "algorithm": SMALL[kind],
        "training": {"timesteps": 1024, "num_envs": 8},
        "validation": {"every": 512, "episodes": 4},
        "calibration": None,
        "output": str(folder / "run"),
    }
    if "binary" not in TABLE[kind].actions:
        content["environment"]["options"]["action"] = "discrete"
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump(content | changes))
    return path


def read_records(folder: Path) -> list[dict[str, Any]]:
    """The validations that a training wrote."""
    return [json.loads(line) for line in (folder / "validation.jsonl").read_text().splitlines()]
