"""Checked YAML: all keys and values are validated before anything runs."""

import os
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, TypeVar

import pydantic

from fusion_gym import validation
from fusion_gym.errors import display
from fusion_gym.yaml_text import parsed

try:
    SHIPPED = Path(str(files("fusion_gym.configs")))
except ModuleNotFoundError:  # a source tree that is not installed
    SHIPPED = Path(__file__).parents[2] / "configs"

Model = TypeVar("Model", bound=pydantic.BaseModel)
Shape = TypeVar("Shape")
Positive = Annotated[int, pydantic.Field(gt=0, le=10**12)]
Several = Annotated[int, pydantic.Field(gt=1, le=10**12)]
Weight = Annotated[float, pydantic.Field(ge=0)]
Rate = Annotated[float, pydantic.Field(gt=0)]
Share = Annotated[float, pydantic.Field(ge=0, le=1)]


class Strict(pydantic.BaseModel):
    """A model without unknown keys, conversions, infinite numbers and later changes."""

    model_config = pydantic.ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False
    )

    @pydantic.model_validator(mode="before")
    @classmethod
    def _tuples(cls, content: Any) -> Any:
        """Convert lists to tuples, because YAML has only lists."""
        if not isinstance(content, Mapping):
            return content
        return {
            key: tuple(value) if isinstance(value, list) else value
            for key, value in content.items()
        }


def config_path(name: str | Path, option: str = "config") -> Path:
    """Return the file of a path, or the shipped config of a name (``tobit_oscillator_ppo``)."""
    path = Path(name)
    if os.path.isfile(path) or path.suffix or path.name != str(name):
        return path
    shipped = sorted(file.stem for file in SHIPPED.glob("*.yaml"))
    return SHIPPED / f"{validation.choice(option, str(name), shipped)}.yaml"


def load_checked(kind: type[Model], name: str | Path, option: str = "config") -> Model:
    """Return the checked config of a path or shipped name."""
    return checked(kind, read_yaml(name, option), f"{option} {str(name)!r}")


def read_yaml(name: str | Path, option: str = "config") -> Any:
    """Return the content of the config of a path or shipped name."""
    text = validation.read_text(option, config_path(name, option), str(name))
    return parsed(text, f"{option} {str(name)!r}")


def checked(shape: type[Shape], content: Any, source: str) -> Shape:
    """Return the content as an object of a type; an error names the first wrong field."""
    try:
        return pydantic.TypeAdapter(shape).validate_python(content)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "the whole file"
        text = "" if first["type"] == "missing" else f" = {display(first['input'])}"
        raise validation.ConfigurationError(
            f"{source}: {place}{text} is not allowed: {first['msg']}"
        ) from None
