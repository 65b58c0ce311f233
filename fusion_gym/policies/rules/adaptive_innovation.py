"""The adaptive innovation trigger of the correlated-noise paper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.core.system import Signals
from fusion_gym.policies.base import (
    PerSensor,
    Requests,
    Trigger,
    check_not_negative,
    column,
    shape_of,
)


@dataclass
class AdaptiveInnovation(Trigger):
    """Request when |ε|² >= a exp(-(b + c |ε at the last request|)), with ε the innovation.

    ``threshold`` a is in squared units of the measurement, ``offset`` b without unit,
    ``sensitivity`` c in the inverse unit of the measurement: after a large innovation a sensor
    becomes easier to provoke. Before an episode's first request the remembered innovation is zero.
    ``sensitivity=0`` is a fixed threshold, ``threshold=0`` requests always.

    The rule decides at the sensor, so a request moves the threshold whether or not the network
    grants it; in the paper every request is granted. The printed exponent -b + c |ε| contradicts
    the text, which wants a decreasing function.

    Source: adaptive_innovation, equations (9)-(11), defaults of Section 6.
    """

    threshold: PerSensor = 0.6
    offset: PerSensor = 0.2
    sensitivity: PerSensor = 0.9

    def __post_init__(self) -> None:
        for name in ("threshold", "offset", "sensitivity"):
            check_not_negative(name, getattr(self, name))
        self.reset(0)

    def reset(self, num_envs: int, seed: int = 0) -> None:
        """Forget the last requested innovations."""
        self._last: NDArray[np.float64] | None = None

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        sensors, runs = shape_of(signals)
        innovation = signals["innovation"]
        squared = linalg.dot(innovation, innovation)
        if self._last is None:
            self._last = np.zeros((sensors, runs))
        last = np.where(signals["start"], 0.0, self._last)
        exponent = column("sensitivity", self.sensitivity, sensors) * last
        exponent += column("offset", self.offset, sensors)
        threshold = column("threshold", self.threshold, sensors) * np.exp(-exponent)
        request: Requests = squared >= threshold
        self._last = np.where(request, np.sqrt(squared), last)
        return request
