"""Policies beside each other as typed YAML: a sweep of thresholds, or rows of settings."""

from typing import Any

import pydantic

from ..training.checked import Strict


class SweepCurve(Strict):
    """A baseline swept over one parameter: ``policy`` holds ``{value}`` in its place."""

    label: str
    policy: str
    values: tuple[float | int, ...] = pydantic.Field(min_length=1)

    @property
    def policies(self) -> list[str]:
        """One policy text a value."""
        return [self.policy.replace("{value}", f"{value:g}") for value in self.values]

    @pydantic.field_validator("policy")
    @classmethod
    def _has_place(cls, policy: str) -> str:
        if "{value}" not in policy:
            raise ValueError("must hold {value} where the swept parameter stands")
        return policy


class Sweep(Strict):
    """Baselines over their thresholds, and the single policies that stand beside them."""

    curves: tuple[SweepCurve, ...]
    points: tuple[str, ...] = ()

    @property
    def policies(self) -> list[str]:
        """Every policy text of the sweep, each once, in order."""
        texts = [text for curve in self.curves for text in curve.policies]
        return list(dict.fromkeys([*self.points, *texts]))


class ComparisonRow(Strict):
    """One policy in one setting of the comparison's environment, or of another."""

    label: str
    policy: str
    environment: str | None = None
    options: dict[str, Any] = pydantic.Field(default_factory=dict)


class SweepSettings(Strict):
    """Settings and policies of one environment, row by row."""

    environment: str
    rows: tuple[ComparisonRow, ...] = pydantic.Field(min_length=1)
