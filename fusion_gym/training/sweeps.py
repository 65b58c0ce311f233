"""Sweeps of rules and rows of a comparison as typed YAML."""

from __future__ import annotations

import pydantic

from fusion_gym.core.reward import Price
from fusion_gym.entries import Options
from fusion_gym.training.checked import Strict


class SweepCurve(Strict):
    """A baseline with one swept parameter, whose place in ``policy`` is ``{value}`` or ``{price}``.

    With ``{price}`` the values are multiples of the task's price, or of the middle of its range.
    """

    label: str
    policy: str
    values: tuple[float | int, ...] = pydantic.Field(min_length=1)

    def policies(self, price: Price) -> list[str]:
        """Return one policy text per value."""
        name = "{price}" if "{price}" in self.policy else "{value}"
        middle = price.middle if name == "{price}" else 1.0
        return [self.policy.replace(name, f"{middle * value:g}") for value in self.values]

    @pydantic.field_validator("policy")
    @classmethod
    def _has_place(cls, policy: str) -> str:
        if ("{value}" in policy) == ("{price}" in policy):
            raise ValueError("must hold {value} or {price} where the swept parameter stands")
        return policy


class Sweep(Strict):
    """Baselines with their swept parameters, and single policies."""

    curves: tuple[SweepCurve, ...]
    points: tuple[str, ...] = ()

    def policies(self, price: Price) -> list[str]:
        """Return every policy text of the sweep once, in order."""
        texts = [text for curve in self.curves for text in curve.policies(price)]
        return list(dict.fromkeys([*self.points, *texts]))


class ComparisonRow(Strict):
    """One policy in one setting of the comparison's environment, or of another environment."""

    label: str
    policy: str
    environment: str | None = None
    options: Options = pydantic.Field(default_factory=dict)


class SweepSettings(Strict):
    """Settings and policies of one environment, row by row."""

    environment: str
    rows: tuple[ComparisonRow, ...] = pydantic.Field(min_length=1)
