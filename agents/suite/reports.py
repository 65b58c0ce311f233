"""What readers of the commands' JSON need of it: a file of another shape is refused, by its field.

The files hold more than this; nothing is converted.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic
from pydantic import FiniteFloat, NonNegativeInt

from fusion_gym.core.system import Knowledge
from fusion_gym.deprecation import replace_value
from fusion_gym.evaluation.metrics import METRICS

from ..input.files import checked
from ..output.files import read_json

NAME = r"^[a-z0-9_]+$"  # of a setting: a part of a path
VERDICT = "verdict.json"  # in the folder of a setting, or of a class under perturbed cases

Known = Annotated[Knowledge, pydantic.BeforeValidator(replace_value)]  # of earlier files, too


class Shape(pydantic.BaseModel):
    """Part of a file."""

    model_config = pydantic.ConfigDict(strict=True)


class Mean(Shape):
    """The mean of an interval."""

    mean: float


class IntervalRecord(Mean):
    """A mean with its interval."""

    low: float
    high: float


NOTHING = IntervalRecord(mean=0.0, low=0.0, high=0.0)  # of a field that may be left out


class PolicyRecord(Shape):
    """A tested policy."""

    mse: IntervalRecord
    rate: list[FiniteFloat] = pydantic.Field(min_length=1)


class TestRecord(Shape):
    """Policies by name."""

    policies: dict[str, PolicyRecord]


class CurveRecord(Shape):
    """A baseline's policies."""

    policies: list[str] = pydantic.Field(min_length=1)


class HindsightRecord(Shape):
    """A lower bound, and what it assumes."""

    mse: Mean
    assumes: str


class Baselines(TestRecord):
    """A setting's ``baselines.json``."""

    env: str
    episodes: int
    seed: int
    curves: dict[str, CurveRecord] = pydantic.Field(min_length=1)
    genie: HindsightRecord = HindsightRecord(mse=Mean(mean=0.0), assumes="")


class Point(Shape):
    """An agent at one price, and what stands there."""

    price: float
    rate: FiniteFloat
    mse: FiniteFloat = pydantic.Field(ge=0.0)
    envelope: float = 0.0
    reference: float = 0.0
    hindsight: float = 0.0
    difference: IntervalRecord = NOTHING


class PriceRecord(Shape):
    """A policy on the envelope."""

    name: str
    rate: FiniteFloat
    mse: FiniteFloat = pydantic.Field(ge=0.0)


class Beside(Shape):
    """Rules and agents of a class at one rate, as far as they reach it."""

    rate: FiniteFloat
    rules: IntervalRecord = NOTHING
    agents: IntervalRecord = NOTHING
    difference: IntervalRecord = NOTHING


class FrontRecord(Shape):
    """A class of knowledge: its agents' points beside the envelope of its rules."""

    seeds: NonNegativeInt
    prices: NonNegativeInt = 0
    rates: list[FiniteFloat] = pydantic.Field(default_factory=list)
    points: list[Point] = pydantic.Field(min_length=1)
    envelope: list[PriceRecord]
    room: FiniteFloat = 0.0
    closed: FiniteFloat = 0.0
    hindsight_room: FiniteFloat = 0.0
    middle: IntervalRecord = NOTHING
    at: list[Beside]
    mode: Literal["centre", "local", "sensors"]
    memory: bool
    broadcast: str | None
    packet: str
    knows: Known

    @pydantic.model_validator(mode="after")
    def _closed(self) -> FrontRecord:
        if "room" in self.model_fields_set and "closed" not in self.model_fields_set:
            raise ValueError("room stands without closed")
        return self


class Worth(Shape):
    """What knowing more is worth: the relative difference of the error, of rules and of agents."""

    kind: str
    knows: str
    less: str
    rules: IntervalRecord = NOTHING
    agents: IntervalRecord = NOTHING


class Verdict(Shape):
    """A setting's ``verdict.json``; without classes before any agent is trained."""

    title: str
    always: FiniteFloat = pydantic.Field(gt=0.0)
    classes: dict[str, FrontRecord]
    worth: list[Worth]


class Best(Shape):
    """The best validation of a training."""

    value: FiniteFloat = pydantic.Field(alias="return")


class Validation(Shape):
    """On which episodes a training was validated."""

    episodes: int
    seed: int


class Training(Shape):
    """What a report needs of a training."""

    validation: Validation


class Agent(Shape):
    """One training seed's ``agent_CLASS_SEED.json``."""

    setting: str = pydantic.Field(pattern=NAME)
    mode: str = pydantic.Field(pattern=NAME)
    name: str = pydantic.Field(pattern=NAME, alias="class")
    class_options: dict[str, Any]
    training_seed: NonNegativeInt
    best_validation: Best
    training: Training
    env: str
    options: dict[str, Any]
    episodes: int
    seed: int
    prices: list[float]
    points: list[PolicyRecord]


class Quantiles(Shape):
    """Quantiles of the episodes' error."""

    median: float


# A policy in the JSON of an evaluation: an interval for a metric, or a list.
_Row = Annotated[list[float], pydantic.Field(min_length=1)]
_FIELDS: dict[str, Any] = {
    name: (_Row if metric.axis else IntervalRecord, ...) for name, metric in METRICS.items()
}
EVALUATED = pydantic.create_model("EVALUATED", __base__=Shape, **_FIELDS)


class Evaluation(Shape):
    """The JSON of an evaluation."""

    policies: dict[str, EVALUATED]  # type: ignore[valid-type]
    quantiles: dict[str, Quantiles]

    @pydantic.model_validator(mode="after")
    def _paired(self) -> Evaluation:
        if missing := sorted(self.policies.keys() - self.quantiles.keys()):
            raise ValueError(f"quantiles of {missing} are missing")
        return self


def read_shape(shape: type[Shape], path: Path, option: str) -> dict[str, Any]:
    """The JSON of a file, in which everything of the shape is there.

    Raises:
        ConfigurationError: it cannot be read, or is of another shape; names ``option``, the file
            and the first such field.
    """
    content = read_json(path, option)
    checked(shape, content, f"{option} = {str(path)!r}")
    return content
