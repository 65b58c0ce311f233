"""Trained agents, small and ready to use: ``zoo:NAME`` is a policy like any other.

Beside each ``NAME.zip`` stands ``NAME.json``: its environment and options, how it was trained, and
its test numbers. Loading runs Stable-Baselines3's loader, which unpickles parts of the file. That
is safe for the files of this package, and for no file from elsewhere that you do not trust.
"""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path
from typing import Any

from fusion_gym.validation import choice


def names() -> list[str]:
    """Names of the agents."""
    return sorted(Path(str(entry)).stem for entry in _folder().iterdir() if _is_model(entry))


def model_path(name: str) -> str:
    """Path of an agent's model.

    Raises:
        ConfigurationError: no agent of that name; the message lists all.
    """
    return str(_folder().joinpath(f"{choice('zoo', name, names())}.zip"))


def card(name: str) -> dict[str, Any]:
    """What an agent's JSON says: environment, options, training, test results.

    Raises:
        ConfigurationError: no agent of that name; the message lists all.
    """
    path = _folder().joinpath(f"{choice('zoo', name, names())}.json")
    found: dict[str, Any] = json.loads(path.read_text())
    return found


def _folder() -> Any:
    return resources.files(__name__)


def _is_model(entry: Any) -> bool:
    return str(entry.name).endswith(".zip")
