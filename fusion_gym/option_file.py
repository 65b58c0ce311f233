"""Files of options, whose reader is an optional package."""

from pathlib import Path
from typing import Any

from fusion_gym.validation import ConfigurationError, read_text


def load_yaml(field: str, path: Path) -> Any:
    """Return the content of a YAML file."""
    source = f"{field} = {str(path)!r}"
    try:
        from fusion_gym.yaml_text import parsed
    except ModuleNotFoundError:
        raise ConfigurationError(f"{source} needs PyYAML: pip install pyyaml") from None
    return parsed(read_text(field, path), source)
