"""Requests at an even pace, at any rate."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fusion_gym import validation
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.policies.base import PerSensor, Requests, Rule, each_number, parameter, shape_of

# Rounding may delay a request by a step: 49 · (1/49) < 1.
_ROUNDING = 1e-9


@dataclass
class Paced(Rule):
    r"""Request each sensor at ``rate``, with its requests spread as evenly as possible.

    A sensor of rate r requests at the steps t = 0, 1, … with ⌊(t + 1) r + φ⌋ > ⌊t r + φ⌋. Its
    number of requests in n successive steps differs from n r by less than one. The phase φ of
    sensor i is i/sensors if ``staggered``, and 0 otherwise.

    For r = 1/period the rule equals ``periodic`` up to the phase. It is the baseline for an event
    trigger of the same rate.

    Args:
        rate: r in [0, 1], any real number.
        staggered: spread the phases of the sensors evenly.

    Equation:
        $$
        \delta_i(t)=1\iff \lfloor (t+1)\,r_i+\varphi_i\rfloor>\lfloor
        t\,r_i+\varphi_i\rfloor,\qquad \varphi_i=i/l
        $$

        r is ``rate``, l the number of sensors, i counts from 0; all φ are 0 without ``staggered``.

    Assumes: nothing; it uses only the clock.

    Source: none; the balanced sequence of a rate r, ⌊(t + 1) r + φ⌋ - ⌊t r + φ⌋.

    Example: ``paced:rate=0.07`` in ``fusion_gym/TobitOscillator-v1 filter=tobit random_start=True
    token_rate=2``.
    """

    rate: PerSensor = parameter(0.2, each_number, at_least=0.0, at_most=1.0)
    staggered: bool = parameter(True, validation.boolean)
    knowledge: ClassVar[Knowledge] = "clock"

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        sensors, _ = shape_of(signals)
        rate, step = self.column("rate", sensors), signals["step"]
        phase = np.full((sensors, 1), _ROUNDING)
        if self.staggered:
            phase += np.arange(sensors)[:, None] / sensors
        return np.floor((step + 1) * rate + phase) > np.floor(step * rate + phase)
