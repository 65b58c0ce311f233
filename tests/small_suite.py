"""A benchmark that takes seconds."""

from pathlib import Path
from typing import Any

import yaml

ENV = "fusion_gym/TobitOscillator-v1"
SMALL: dict[str, Any] = {
    "episodes": 12,
    "training_seeds": 2,
    "timesteps": 256,
    "num_envs": 4,
    "prices": 3,
    "tuning": {"trials": 4, "prices": 2, "episodes": 4, "seeds": 2},
    "algorithm": {"name": "ppo", "n_steps": 8, "batch_size": 32, "n_epochs": 1},
    "families": [
        {
            "label": "innovation",
            "policy": "innovation_threshold",
            "parameters": {"threshold": {"low": 0.2, "high": 3, "per_sensor": True}},
        },
        {
            "label": "gain",
            "policy": "information_gain",
            "parameters": {
                "threshold": {"low": 0.001, "high": 0.3},
                "at_most": {"values": [None, 1]},
            },
        },
    ],
    "settings": [
        {
            "name": "small",
            "title": "a small setting",
            "environment": {"id": ENV, "options": {"filter": "tobit", "horizon": 10}},
            "price_range": [0.001, 0.1],
            "broadcasts": ["estimate", "packets"],
            "agents": ["centre", "local_estimate", "local_packets_memory", "sensors"],
            "informed": ["lookahead:steps=1,price=0.01", "lookahead:steps=1,price=1e9"],
            "references": ["periodic:period=7"],
            "genie": {"options": {"tokens": "unlimited"}, "assumes": "everything arrives"},
            "hindsight": {"prices": [0.001, 0.1], "width": 4},
        }
    ],
    "hindsight_episodes": 5,
}


def small_suite(folder: Path, **changes: Any) -> Path:
    path = folder / "suite.yaml"
    path.write_text(yaml.safe_dump(SMALL | changes))
    return path
