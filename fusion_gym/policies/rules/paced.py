"""Requests at an even pace, at any rate."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fusion_gym import validation
from fusion_gym.core.system import Knowledge, Signals
from fusion_gym.policies.base import PerSensor, Requests, Rule, each_number, parameter, shape_of

# A pace that comes up at a step may be computed a rounding below it: 49 · (1/49) < 1.
_ROUNDING = 1e-9


@dataclass
class Paced(Rule):
    r"""Request each sensor at ``rate``, its requests spread as evenly as possible.

    A sensor requests at step t, counted from 0, where ⌊(t + 1) r + φ⌋ > ⌊t r + φ⌋ with its rate r.
    In every window of n steps it makes less than one request more or
    fewer than n r. The phases φ are i/sensors for sensor i if ``staggered``, and 0 otherwise.

    For r = 1/period this is ``periodic`` but for the phase. It is what an event trigger of the same
    rate has to beat.

    Args:
        rate: r in [0, 1], any real number.
        staggered: spread sensors of one rate evenly among each other too.

    Equation:
        $$
        \delta_i(t)=1\iff \lfloor (t+1)\,r_i+\varphi_i\rfloor>\lfloor
        t\,r_i+\varphi_i\rfloor,\qquad \varphi_i=i/l
        $$

        r is ``rate``, l the number of sensors, i counts from 0; all φ are 0 without ``staggered``.

    Assumes: nothing; it looks at the clock alone.

    Source: none; the balanced sequence of a rate r, ⌊(t + 1) r + φ⌋ - ⌊t r + φ⌋.

    Example: ``paced:rate=0.07`` in ``fusion_gym/TobitOscillator-v1 filter=tobit random_start=True
    token_rate=2``.
    """

    rate: PerSensor = parameter(0.2, each_number, at_least=0.0, at_most=1.0)
    staggered: bool = parameter(True, validation.boolean)
    knowledge: ClassVar[Knowledge] = "clock"

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        sensors, _ = shape_of(signals)
        rate, step = self.column("rate", sensors), signals["step"]
        phase = np.full((sensors, 1), _ROUNDING)
        if self.staggered:
            phase += np.arange(sensors)[:, None] / sensors
        return np.floor((step + 1) * rate + phase) > np.floor(step * rate + phase)
