"""What readers of the commands' JSON need of it: a file of another shape is refused, by its field.

The files hold more than this; nothing is converted.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pydantic
from pydantic import FiniteFloat, NonNegativeInt

from fusion_gym.validation import ConfigurationError

from ..input.files import checked
from ..output.files import read_json

NAME = r"^[a-z0-9_]+$"  # of a setting: a part of a path


class Shape(pydantic.BaseModel):
    """Part of a file."""

    model_config = pydantic.ConfigDict(strict=True)


class Mean(Shape):
    """The mean of an interval."""

    mean: float


class Interval(Mean):
    """A mean with its interval."""

    low: float
    high: float


class Policy(Shape):
    """A tested policy."""

    mse: Interval
    rate: list[FiniteFloat] = pydantic.Field(min_length=1)


class Tested(Shape):
    """Policies by name."""

    policies: dict[str, Policy]


class Curve(Shape):
    """A baseline's policies."""

    policies: list[str] = pydantic.Field(min_length=1)


class Genie(Shape):
    """A lower bound, and what it assumes."""

    mse: Mean
    assumes: str


class Baselines(Tested):
    """A setting's ``baselines.json``."""

    env: str
    episodes: int
    seed: int
    curves: dict[str, Curve] = pydantic.Field(min_length=1)
    genie: Genie = Genie(mse=Mean(mean=0.0), assumes="")


class Point(Shape):
    """An agent at one price, and what stands there."""

    price: float
    rate: FiniteFloat
    mse: FiniteFloat = pydantic.Field(ge=0.0)
    envelope: float = 0.0
    reference: float = 0.0
    hindsight: float = 0.0
    difference: Interval = Interval(mean=0.0, low=0.0, high=0.0)


class Named(Shape):
    """A policy on the envelope."""

    name: str


class Front(Shape):
    """An agent's points in one mode."""

    seeds: int
    prices: NonNegativeInt = 0
    rates: list[FiniteFloat] = pydantic.Field(default_factory=list)
    points: list[Point] = pydantic.Field(min_length=1)
    envelope: list[Named]
    room: float = 0.0
    closed: float = 0.0
    hindsight_room: float = 0.0
    middle: Interval = Interval(mean=0.0, low=0.0, high=0.0)

    @pydantic.model_validator(mode="after")
    def _closed(self) -> Front:
        if "room" in self.model_fields_set and "closed" not in self.model_fields_set:
            raise ValueError("room stands without closed")
        return self


class Verdict(Shape):
    """A setting's ``verdict.json``."""

    title: str
    modes: dict[str, Front] = pydantic.Field(min_length=1)


class Best(Shape):
    """The best validation of a training."""

    value: FiniteFloat = pydantic.Field(alias="return")


class Agent(Shape):
    """One training seed's ``agent_MODE_SEED.json``."""

    setting: str = pydantic.Field(pattern=NAME)
    mode: str = pydantic.Field(pattern=NAME)
    training_seed: NonNegativeInt
    best_validation: Best
    training: dict[str, Any]
    env: str
    options: dict[str, Any]
    episodes: int
    seed: int
    prices: list[float]
    points: list[Policy]


class Quantiles(Shape):
    """Quantiles of the episodes' error."""

    median: float


class Evaluated(Policy):
    """A policy in the JSON of an evaluation."""

    requests: list[float] = pydantic.Field(min_length=1)
    armse: list[float]
    tokens: Mean
    denied: Mean
    bound_trace: Mean
    nees: Mean
    total: Interval = pydantic.Field(alias="return")


class Evaluation(Shape):
    """The JSON of an evaluation."""

    policies: dict[str, Evaluated]
    quantiles: dict[str, Quantiles]

    @pydantic.model_validator(mode="after")
    def _paired(self) -> Evaluation:
        if missing := sorted(self.policies.keys() - self.quantiles.keys()):
            raise ValueError(f"quantiles of {missing} are missing")
        return self


def read(shape: type[Shape], path: Path, option: str) -> dict[str, Any]:
    """The JSON of a file, in which everything of the shape is there.

    Raises:
        ConfigurationError: it cannot be read, or is of another shape; names ``option``, the file
            and the first such field.
    """
    content = read_json(path, option)
    checked(shape, content, f"{option} = {str(path)!r}")
    return content


def read_setting(folder: Path) -> dict[str, Any]:
    """Verdict, baselines and informed references of one setting.

    Raises:
        ConfigurationError: as :func:`read`, or the files do not fit together.
    """
    informed = folder / "informed.json"
    found = {
        "verdict": read(Verdict, folder / "verdict.json", "results"),
        "baselines": read(Baselines, folder / "baselines.json", "results"),
        "informed": read(Tested, informed, "results")["policies"] if informed.exists() else {},
    }
    baselines = found["baselines"]
    named = [name for curve in baselines["curves"].values() for name in curve["policies"]]
    for front in found["verdict"]["modes"].values():
        named += [point["name"] for point in front["envelope"]]
    for name in named:
        if name not in baselines["policies"]:
            raise ConfigurationError(
                f"results = {str(folder)!r} do not fit together: baselines.json has no policy "
                f"{name!r}, of which it or verdict.json speaks"
            )
    return found
