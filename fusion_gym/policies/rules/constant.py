"""Always and never: the ends of the trade-off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_gym.core.system import Signals
from fusion_gym.policies.base import Requests, Trigger, shape_of


@dataclass
class Always(Trigger):
    """Every sensor requests at every step."""

    def __call__(self, signals: Signals) -> Requests:
        """All true, (sensors, N)."""
        return np.ones(shape_of(signals), dtype=np.bool_)


@dataclass
class Never(Trigger):
    """No sensor ever requests."""

    def __call__(self, signals: Signals) -> Requests:
        """All false, (sensors, N)."""
        return np.zeros(shape_of(signals), dtype=np.bool_)
