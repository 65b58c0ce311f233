"""Always and never, the extreme rates."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.policies.base import Requests, Rule, shape_of


@dataclass
class Always(Rule):
    r"""Request every sensor at every step.

    Equation:
        $$
        \delta_i(t)=1
        $$

    Assumes: nothing.

    Source: none; the highest rate that the tokens allow.

    Example: ``always`` in ``fusion_gym/TobitOscillator-v1 filter=tobit random_start=True
    tokens=unlimited``.
    """

    knowledge: ClassVar[Knowledge] = "clock"

    def __call__(self, signals: Signals) -> Requests:
        """Return requests of all sensors (sensors, N)."""
        return np.ones(shape_of(signals), dtype=np.bool_)


@dataclass
class Never(Rule):
    r"""Request no sensor.

    Equation:
        $$
        \delta_i(t)=0
        $$

    Assumes: nothing.

    Source: none; the rate 0, at which the centre only predicts.

    Example: ``never`` in ``fusion_gym/TobitOscillator-v1 filter=tobit random_start=True
    token_rate=2``.
    """

    knowledge: ClassVar[Knowledge] = "clock"

    def __call__(self, signals: Signals) -> Requests:
        """Return no requests (sensors, N)."""
        return np.zeros(shape_of(signals), dtype=np.bool_)
