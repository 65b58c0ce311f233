"""The variance trigger of the Markov jump paper: transmit when the node itself is uncertain."""

from __future__ import annotations

from dataclasses import dataclass

from fusion_gym import validation
from fusion_gym.core.system import Signals
from fusion_gym.policies.base import PerSensor, Requests, Trigger, column


@dataclass
class LocalVariance(Trigger):
    """Request where the trace of the node's own error covariance is at least ``reference`` + ``m``.

    Both are in squared units of the state; ``m`` may have any sign. ``reference`` is the trace
    that the fusion of all nodes reaches at full rate, which the environment supplies; without it
    ``m`` is the threshold. The traces depend on time alone, so the rule is a schedule that becomes
    periodic, whatever is measured, and it prefers the worst node.

    Source: markov_jump, equation (33).
    """

    m: PerSensor = 0.9
    reference: float = 0.0

    def __post_init__(self) -> None:
        if isinstance(self.m, (tuple, list)):
            validation.array("m", self.m, (None,))
        else:
            validation.number("m", self.m)
        validation.number("reference", self.reference, at_least=0.0)

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        variance = signals["local_variance"]
        result: Requests = variance >= self.reference + column("m", self.m, len(variance))
        return result
