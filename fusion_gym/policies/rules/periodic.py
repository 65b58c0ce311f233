"""Time-triggered policies, which use the clock and the order of the last grants."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fusion_gym import validation
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.policies.base import Requests, Rule, parameter, shape_of


@dataclass
class Periodic(Rule):
    r"""Request every sensor once in ``period`` steps.

    Args:
        period: steps between two requests of a sensor, >= 1.
        staggered: spread the sensors over the period; otherwise all sensors request together.

    Equation:
        $$
        \delta_i(t)=1\iff t\equiv\varphi_i\ (\mathrm{mod}\ p),\qquad \varphi_i=\lfloor
        i\,p/l\rfloor
        $$

        p is ``period``, l the number of sensors, i counts from 0; all φ are 0 without
        ``staggered``.

    Assumes: nothing; it uses only the clock.

    Source: none; the usual baseline of an event trigger.

    Example: ``periodic:period=15`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2``.
    """

    period: int = parameter(4, validation.integer, at_least=1, at_most=validation.MOST_PERIOD)
    staggered: bool = parameter(True, validation.boolean)
    knowledge: ClassVar[Knowledge] = "clock"

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        sensors, _ = shape_of(signals)
        phase = np.arange(sensors) * self.period // sensors if self.staggered else np.zeros(sensors)
        return (signals["step"] - phase[:, None]) % self.period == 0


@dataclass
class RoundRobin(Rule):
    r"""Request one sensor every ``period`` steps, and the next sensor after a grant.

    Args:
        period: steps between two requests, >= 1.

    Equation:
        $$
        \delta_i(t)=1\iff t\equiv 0\ (\mathrm{mod}\ p)\ \ \text{and}\ \ k(t)\equiv i\ (\mathrm{mod}\
        l)
        $$

        p is ``period``, k(t) the number of grants before step t, l the number of sensors, i counts
        from 0.

    Assumes: nothing; it uses the clock and the network's answers to its requests.

    Source: round_robin_tobit, equation (4), a protocol in which one sensor per step may transmit.

    Example: ``round_robin:period=5`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2``.
    """

    period: int = parameter(1, validation.integer, at_least=1, at_most=validation.MOST_PERIOD)
    knowledge: ClassVar[Knowledge] = "clock"

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        return (signals["queue"] == 0) & (signals["step"] % self.period == 0)
