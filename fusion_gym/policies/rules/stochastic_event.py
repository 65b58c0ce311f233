"""Stay silent by chance, the less likely the more the measurement surprises the filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_gym import linalg, validation
from fusion_gym.core.system import Signals
from fusion_gym.policies.base import (
    PerSensor,
    Requests,
    Trigger,
    check_not_negative,
    column,
    shape_of,
)
from fusion_gym.policies.chance import Chance

_STREAM = 0x73746F6368  # keeps the draws apart from the noise of the same seed


@dataclass
class StochasticEvent(Trigger):
    """Each sensor stays silent with probability exp(-weight · |z|² / 2), z its innovation.

    ``weight`` >= 0 is the paper's Z, here a multiple of the identity for each sensor, in the
    inverse squared unit of the measurement. With ``whitened`` the innovation is taken in predicted
    standard deviations and the weight has no unit. Weight 0 never requests.

    The silence is a soft event: given silence the posterior stays Gaussian, and
    ``filter="stochastic"`` is the exact filter for it (of the plain
    innovation, not of the whitened one).

    Source: D. Han, Y. Mo, J. Wu, S. Weerakkody, B. Sinopoli and L. Shi, "Stochastic
    event-triggered sensor schedule for remote state estimation", IEEE Trans. Automatic Control
    60(10), 2015, the closed-loop schedule.
    """

    weight: PerSensor = 1.0
    whitened: bool = False

    def __post_init__(self) -> None:
        check_not_negative("weight", self.weight)
        validation.boolean("whitened", self.whitened)
        self._chance = Chance(_STREAM)

    def reset(self, num_envs: int, seed: int = 0) -> None:
        """Begin again: run i draws from a stream of its own, that of ``seed + i``."""
        self._chance.reset(num_envs, seed)

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        sensors, runs = shape_of(signals)
        innovation = signals["innovation"]
        if self.whitened:
            innovation = innovation / signals["innovation_deviation"]
        weight = column("weight", self.weight, sensors)
        silence = np.exp(-0.5 * weight * linalg.dot(innovation, innovation))
        return self._chance.draw(sensors, runs) >= silence
