"""Transmit when the measurement surprises the filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_gym import linalg, validation
from fusion_gym.core.system import Signals
from fusion_gym.policies.base import (
    PerSensor,
    Requests,
    Trigger,
    check_at_most,
    check_not_negative,
    column,
    shape_of,
    strongest,
)


@dataclass
class InnovationThreshold(Trigger):
    """Request when the innovation's norm is at least ``threshold``.

    The norm is Euclidean in the unit of the measurement, or, with ``whitened``, of the innovation
    in predicted standard deviations. ``at_most`` limits a step to the sensors with the largest
    norms (None: no limit).

    Source: after J. Wu, Q.-S. Jia, K. H. Johansson and L. Shi, "Event-based sensor data
    scheduling: trade-off between communication rate and estimation quality", IEEE Trans.
    Automatic Control 58, 2013 (there with the maximum norm of the whitened innovation).
    """

    threshold: PerSensor = 1.0
    whitened: bool = False
    at_most: int | None = None

    def __post_init__(self) -> None:
        check_not_negative("threshold", self.threshold)
        validation.boolean("whitened", self.whitened)
        check_at_most(self.at_most)

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        innovation = signals["innovation"]
        if self.whitened:
            innovation = innovation / signals["innovation_deviation"]
        norm = np.sqrt(linalg.dot(innovation, innovation))
        wanted = norm >= column("threshold", self.threshold, shape_of(signals)[0])
        return strongest(norm, wanted, self.at_most, signals["age"])
