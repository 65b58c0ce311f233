"""Send on delta: transmit when the measurement has changed enough."""

from dataclasses import dataclass
from typing import ClassVar

from fusion_gym import linalg
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.policies.base import (
    LocalRule,
    PerSensor,
    Requests,
    not_negative_parameter,
    parameter,
    shape_of,
)


@dataclass
class SendOnDelta(LocalRule):
    r"""Request when the measurement differs from the last delivered one by ``threshold`` or more.

    Args:
        threshold: θ >= 0, in the unit of the measurement.
        min_interval: least steps between two deliveries of a sensor, >= 1.
        max_interval: most steps between two deliveries of a sensor; None for no limit.

    Equation:
        $$
        \delta_i(t)=1\iff \lVert y_i(t)-\bar y_i\rVert\ge\theta_i
        $$

        ȳᵢ is the last delivered measurement of sensor i, θ is ``threshold``.

    Assumes: a centre that holds the last delivered value. The threshold then bounds the error of
    the held value.

    Source: M. Miskowicz, "Send-on-delta concept: an event-based data reporting strategy",
    Sensors 6, 2006.

    Example: ``send_on_delta:threshold=3`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2``.
    """

    threshold: PerSensor = parameter(1.0, not_negative_parameter)
    knowledge: ClassVar[Knowledge] = "own"

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        moved = signals["measurement"] - signals["held"]
        threshold = self.column("threshold", shape_of(signals)[0])
        return self.limit(linalg.dot(moved, moved) >= threshold * threshold, signals)
