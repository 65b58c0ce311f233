"""Trained agents of Stable-Baselines3, each available as the policy ``zoo:NAME``.

``NAME.json`` has the environment and its options, the training, the test results and the SHA-256
of ``NAME.zip``. ``zoo:NAME`` reads the plain parts and the weights of that file only.
"""

import hashlib
import json
from pathlib import Path

from fusion_gym.entries import Plain
from fusion_gym.errors import forbidden
from fusion_gym.validation import choice

_FOLDER = Path(__file__).parent


def names() -> list[str]:
    """Return the sorted names of the agents.

    Example:
        >>> from fusion_gym import zoo
        >>> zoo.names()[0]
        'biased_oscillator_centre'
    """
    return sorted(path.stem for path in _FOLDER.glob("*.zip"))


def model_path(name: str) -> str:
    """Return the path of an agent's model, whose SHA-256 agrees with its card.

    Args:
        name: Name of the agent.

    Raises:
        ConfigurationError: No agent has this name, or the SHA-256 differs from the card.

    Example:
        >>> from pathlib import Path
        >>> from fusion_gym import zoo
        >>> Path(zoo.model_path("tobit_oscillator_local")).name
        'tobit_oscillator_local.zip'
    """
    text, path = card(name)["sha256"], _FOLDER / f"{name}.zip"
    value = hashlib.sha256(path.read_bytes()).hexdigest()
    if value != text:
        reason = f"{path} has the SHA-256 {value}, its card says {text}; reinstall fusion-gym"
        raise forbidden("zoo", name, reason)
    return str(path)


def card(name: str) -> Plain:
    """Return an agent's card: environment, options, training and test results.

    Args:
        name: Name of the agent.

    Raises:
        ConfigurationError: No agent has this name.

    Example:
        >>> from fusion_gym import zoo
        >>> zoo.card("tobit_oscillator_local")["env"]
        'fusion_gym/TobitOscillator-v1'
    """
    path = _FOLDER / f"{choice('zoo', name, names())}.json"
    content: Plain = json.loads(path.read_text())
    return content
