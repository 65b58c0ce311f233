"""Trained agents, small and ready to use: ``zoo:NAME`` is a policy like any other.

Beside each ``NAME.zip`` stands ``NAME.json``: its environment and options, how it was trained, its
test numbers, and the SHA-256 of the model. The models are ordinary files of Stable-Baselines3;
``zoo:NAME`` reads their plain parts and weights alone.
"""

import hashlib
import json
from importlib import resources
from pathlib import Path
from typing import Any

from fusion_gym.validation import ConfigurationError, choice


def names() -> list[str]:
    """Names of the agents."""
    return sorted(Path(str(entry)).stem for entry in _folder().iterdir() if _is_model(entry))


def model_path(name: str) -> str:
    """Path of an agent's model, which is the one that its card describes.

    Raises:
        ConfigurationError: no agent of that name (the message lists all), or a file whose SHA-256
            is not the card's.
    """
    text, path = card(name)["sha256"], _folder().joinpath(f"{name}.zip")
    value = hashlib.sha256(path.read_bytes()).hexdigest()
    if value != text:
        raise ConfigurationError(
            f"zoo = {name!r} is not allowed: {path} has the SHA-256 {value}, its card says {text}; "
            "install fusion-gym anew"
        )
    return str(path)


def card(name: str) -> dict[str, Any]:
    """What an agent's JSON says: environment, options, training, test results.

    Raises:
        ConfigurationError: no agent of that name; the message lists all.
    """
    path = _folder().joinpath(f"{choice('zoo', name, names())}.json")
    content: dict[str, Any] = json.loads(path.read_text())
    return content


def _folder() -> Any:
    return resources.files(__name__)


def _is_model(entry: Any) -> bool:
    return str(entry.name).endswith(".zip")
