"""Always and never: the ends of the trade-off."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fusion_gym.core.system import Knowledge, Signals
from fusion_gym.policies.base import Requests, Rule, shape_of


@dataclass
class Always(Rule):
    """Every sensor requests at every step.

    Assumes: nothing.

    Source: none; the end of the trade-off at which everything is sent that the tokens pay for.
    """

    knowledge: ClassVar[Knowledge] = "clock"

    def __call__(self, signals: Signals) -> Requests:
        """All true, (sensors, N)."""
        return np.ones(shape_of(signals), dtype=np.bool_)


@dataclass
class Never(Rule):
    """No sensor ever requests.

    Assumes: nothing.

    Source: none; the end of the trade-off at which the centre only predicts.
    """

    knowledge: ClassVar[Knowledge] = "clock"

    def __call__(self, signals: Signals) -> Requests:
        """All false, (sensors, N)."""
        return np.zeros(shape_of(signals), dtype=np.bool_)
