"""Options of an environment from a file."""

import os
from pathlib import Path
from typing import Any

from fusion_gym.errors import refusal
from fusion_gym.validation import ConfigurationError, read_text


def read_options(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the options of a YAML file by name."""
    if not isinstance(path, (str, os.PathLike)):
        raise refusal("system", path, "the path of a YAML file")
    source = f"system = {os.fspath(path)!r}"
    try:
        from fusion_gym.yaml_text import parsed
    except ModuleNotFoundError:
        raise ConfigurationError(f"{source} needs PyYAML: pip install pyyaml") from None
    content = parsed(read_text("system", Path(path)), source)
    if not (isinstance(content, dict) and all(isinstance(key, str) for key in content)):
        raise ConfigurationError(f"{source} is not allowed: it must hold a mapping of options")
    return content
