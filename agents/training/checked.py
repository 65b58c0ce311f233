"""Checked YAML: every key is known, and every value is allowed, before anything runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, TypeVar

import pydantic
import yaml

from fusion_gym import validation
from fusion_gym.validation import ConfigurationError

# Beside the folder of the commands, in a clone as in an installed package.
SHIPPED = Path(__file__).parents[2] / "configs"

Model = TypeVar("Model", bound=pydantic.BaseModel)
Positive = Annotated[int, pydantic.Field(gt=0)]
Rate = Annotated[float, pydantic.Field(gt=0)]
Share = Annotated[float, pydantic.Field(ge=0, le=1)]


class Strict(pydantic.BaseModel):
    """No unknown keys, and nothing changes afterwards."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


def config_path(name: str | Path) -> Path:
    """The file of that path, or the shipped config of that name (``tobit_oscillator_ppo``).

    Raises:
        ConfigurationError: a bare name that is neither; the message lists the shipped configs.
    """
    path = Path(name)
    if path.is_file() or path.suffix or path.name != str(name):
        return path
    shipped = sorted(file.stem for file in SHIPPED.glob("*.yaml"))
    return SHIPPED / f"{validation.choice('config', str(name), shipped)}.yaml"


def load(kind: type[Model], name: str | Path) -> Model:
    """The config of a path or shipped name, checked.

    Raises:
        ConfigurationError: unreadable, an unknown key, or a value that is not allowed; names the
            file and the first such field.
    """
    return parse(kind, read_yaml(name), str(name))


def read_yaml(name: str | Path) -> Any:
    """What the config of a path or shipped name holds.

    Raises:
        ConfigurationError: no such file, or no YAML.
    """
    try:
        return yaml.safe_load(config_path(name).read_text())
    except OSError as error:
        raise ConfigurationError(
            f"config {str(name)!r} cannot be read: {error.strerror or error}"
        ) from None
    except yaml.YAMLError as error:
        raise ConfigurationError(f"config {str(name)!r} is no YAML: {error}") from None


def parse(kind: type[Model], content: Any, source: str) -> Model:
    """The content as a checked model.

    Raises:
        ConfigurationError: an unknown key or a value that is not allowed; names ``source`` and
            the first such field.
    """
    try:
        return kind.model_validate(content)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "the whole file"
        given = "" if first["type"] == "missing" else f" = {first['input']!r}"
        raise ConfigurationError(
            f"config {source!r}: {place}{given} is not allowed: {first['msg']}"
        ) from None
