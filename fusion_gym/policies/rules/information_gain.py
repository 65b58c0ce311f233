"""Greedy choice by predicted reduction of variance per token."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from fusion_gym import validation
from fusion_gym.core.system import Knowledge, Signals
from fusion_gym.policies.base import Requests, Rule, check_at_most, parameter, strongest


@dataclass
class InformationGain(Rule):
    """Request where the relative reduction of the fused trace per token is >= ``threshold``.

    The reduction is that of a delivery from this sensor alone, relative to the trace without any
    delivery; it does not depend on the measurement. Greedily, the ``at_most`` sensors that gain
    most per token are taken (None: all that reach the threshold).

    Assumes: claimed covariances that are true, and that what counts is the next step alone.

    Source: none; the greedy choice of sensors by predicted variance, here in proportion to the
    tokens that it costs.
    """

    threshold: float = parameter(0.05, validation.number, at_least=0.0)
    at_most: int | None = parameter(1, check_at_most)
    knowledge: ClassVar[Knowledge] = "centre"

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        relative = signals["variance_reduction"] / signals["silent_variance"]
        gain = relative / signals["token_cost"]
        return strongest(gain, gain >= self.threshold, self.at_most, signals["age"])
