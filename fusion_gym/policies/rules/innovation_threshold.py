"""Transmit when the innovation is large."""

from dataclasses import dataclass

from fusion_gym import validation
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.policies.base import (
    LocalRule,
    PerSensor,
    Requests,
    check_at_most,
    not_negative_parameter,
    parameter,
    strongest,
    surprise,
)


@dataclass
class InnovationThreshold(LocalRule):
    r"""Request when the Euclidean norm of the innovation is at least ``threshold``.

    Args:
        threshold: θ >= 0, in the unit of the measurement, or without a unit.
        whitened: take the innovation in predicted standard deviations.
        at_most: most requests in a step, by the largest norm; None for no limit.
        min_interval: least steps between two deliveries of a sensor, >= 1.
        max_interval: most steps between two deliveries of a sensor; None for no limit.

    Equation:
        $$
        \delta_i(t)=1\iff \lVert z_i(t)\rVert\ge\theta_i,\qquad z_i=y_i-\hat y_i
        $$

        ŷᵢ is the predicted measurement, θ is ``threshold``; with ``whitened`` each component of z
        is divided by its predicted standard deviation. With ``at_most``, the sensors of the largest
        norms are requested.

    Assumes: a prediction of the measurement at the sensor; with ``whitened`` also that its
    predicted deviation is true. The filters treat silence as no information.

    Source: after J. Wu, Q.-S. Jia, K. H. Johansson and L. Shi, "Event-based sensor data
    scheduling: trade-off between communication rate and estimation quality", IEEE Trans.
    Automatic Control 58, 2013 (there with the maximum norm of the whitened innovation).

    Example: ``innovation_threshold:threshold=1.2`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2``.
    """

    threshold: PerSensor = parameter(1.0, not_negative_parameter)
    whitened: bool = parameter(False, validation.boolean)
    at_most: int | None = parameter(None, check_at_most)

    @property
    def knowledge(self) -> Knowledge:
        """The class of a sensor, or with ``at_most``, which compares sensors, of a scheduler."""
        return "own" if self.at_most is None else "scheduler"

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        norm = surprise(signals, self.whitened) ** 0.5
        requests = self.limit(norm >= self.column("threshold", len(norm)), signals)
        return strongest(norm, requests, self.at_most, signals["age"])
