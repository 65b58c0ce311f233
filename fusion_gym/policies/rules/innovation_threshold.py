"""Transmit when the measurement surprises the filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_gym import validation
from fusion_gym.core.system import Knowledge, Signals
from fusion_gym.policies.base import (
    PerSensor,
    Requests,
    Rule,
    check_at_most,
    not_negative,
    parameter,
    strongest,
    surprise,
)


@dataclass
class InnovationThreshold(Rule):
    """Request when the innovation's norm is at least ``threshold``.

    The norm is Euclidean in the unit of the measurement, or, with ``whitened``, of the innovation
    in predicted standard deviations. ``at_most`` limits a step to the sensors with the largest
    norms (None: no limit).

    Assumes: a prediction of the measurement at the sensor; with ``whitened`` also that its
    predicted deviation is true. Silence is taken for no information by the filters here.

    Source: after J. Wu, Q.-S. Jia, K. H. Johansson and L. Shi, "Event-based sensor data
    scheduling: trade-off between communication rate and estimation quality", IEEE Trans.
    Automatic Control 58, 2013 (there with the maximum norm of the whitened innovation).
    """

    threshold: PerSensor = parameter(1.0, not_negative)
    whitened: bool = parameter(False, validation.boolean)
    at_most: int | None = parameter(None, check_at_most)

    @property
    def knowledge(self) -> Knowledge:
        """A sensor's own measurement; with ``at_most`` all of them, for the largest is sent."""
        return "own" if self.at_most is None else "coordinator"

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        norm = np.sqrt(surprise(signals, self.whitened))
        wanted = norm >= self.column("threshold", len(norm))
        return strongest(norm, wanted, self.at_most, signals["age"])
