"""Random requests at a rate."""

from dataclasses import dataclass
from typing import ClassVar

from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.policies.base import PerSensor, Requests, each_number, parameter, shape_of
from fusion_gym.policies.chance import ChanceRule


@dataclass
class Random(ChanceRule):
    r"""Request each sensor with probability ``rate``, independently at every step.

    Args:
        rate: r in [0, 1].

    Equation:
        $$
        \Pr\{\delta_i(t)=1\}=r_i
        $$

        r is ``rate``; all draws are independent.

    Assumes: nothing; requests are independent of everything.

    Source: none; a usual baseline of an event trigger.

    Example: ``random:rate=0.07`` in ``fusion_gym/TobitOscillator-v1 filter=tobit random_start=True
    token_rate=2``.
    """

    rate: PerSensor = parameter(0.2, each_number, at_least=0.0, at_most=1.0)
    knowledge: ClassVar[Knowledge] = "clock"
    stream: ClassVar[int] = 0x72616E646F6D  # independent of the noise of the same seed

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        sensors, runs = shape_of(signals)
        return self.draw(sensors, runs) < self.column("rate", sensors)
