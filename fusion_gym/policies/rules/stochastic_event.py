"""A stochastic trigger: the probability of silence falls with the size of the innovation."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fusion_gym import validation
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.policies.base import (
    LocalRule,
    PerSensor,
    Requests,
    not_negative_parameter,
    parameter,
    surprise,
)
from fusion_gym.policies.chance import ChanceRule


@dataclass
class StochasticEvent(ChanceRule, LocalRule):
    r"""Keep each sensor silent with probability exp(-w |z|² / 2), with z its innovation.

    The weight w is the paper's Z, here a multiple of the identity for each sensor. Given silence
    the posterior stays Gaussian. ``filter="stochastic"`` is the exact filter, for the innovation
    without ``whitened``.

    Args:
        weight: w >= 0, in the inverse squared unit of the measurement, or without a unit; 0 never
            requests.
        whitened: take the innovation in predicted standard deviations.
        min_interval: least steps between two deliveries of a sensor, >= 1.
        max_interval: most steps between two deliveries of a sensor; None for no limit.

    Equation:
        $$
        \Pr\{\delta_i(t)=0\}=\exp\left(-\frac{1}{2}\,w_i\,\lVert z_i(t)\rVert^2\right),\qquad
        z_i=y_i-\hat y_i
        $$

        w is ``weight``; with ``whitened`` each component of z is divided by its predicted standard
        deviation.

    Assumes: a prediction of the measurement at the sensor; for the exact posterior a linear
    Gaussian system, uncensored sensors and a network that grants all requests.

    Source: D. Han, Y. Mo, J. Wu, S. Weerakkody, B. Sinopoli and L. Shi, "Stochastic
    event-triggered sensor schedule for remote state estimation", IEEE Trans. Automatic Control
    60(10), 2015, the closed-loop schedule.

    Example: ``stochastic_event:weight=0.3`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2``.
    """

    weight: PerSensor = parameter(1.0, not_negative_parameter)
    whitened: bool = parameter(False, validation.boolean)
    knowledge: ClassVar[Knowledge] = "own"
    stream: ClassVar[int] = 0x73746F6368  # independent of the noise of the same seed

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        squared = surprise(signals, self.whitened)
        silence = np.exp(-0.5 * self.column("weight", len(squared)) * squared)
        return self.limit(self.draw(*squared.shape) >= silence, signals)
