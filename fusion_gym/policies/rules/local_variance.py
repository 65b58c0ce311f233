"""The variance trigger of the Markov jump paper."""

from dataclasses import dataclass
from typing import ClassVar

from fusion_gym import validation
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.policies.base import PerSensor, Requests, Rule, each_number, parameter


@dataclass
class LocalVariance(Rule):
    r"""Request where the trace of the node's error covariance is at least ``reference`` + ``m``.

    The traces depend only on time and deliveries, so the rule is a schedule that becomes periodic.
    It prefers the nodes of the largest trace.

    Args:
        m: distance to the reference, in squared units of the state, of any sign.
        reference: trace of the fusion of all nodes at full rate, by default from the environment.

    Equation:
        $$
        \delta_i(t)=1\iff \mathrm{tr}\,P_i(t)\ge P_{\mathrm{ref}}+m_i
        $$

        Pᵢ is the node's error covariance, P_ref ``reference``.

    Assumes: node covariances that do not depend on the data, as with linear filters, so centre and
    node both know them.

    Source: markov_jump, equation (33).

    Example: ``local_variance:m=0.9`` in ``fusion_gym/MarkovJumpTracking-v1``.
    """

    m: PerSensor = parameter(0.9, each_number)
    reference: float = parameter(0.0, validation.number, at_least=0.0)
    knowledge: ClassVar[Knowledge] = "centre"

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        variance = signals["local_variance"]
        return variance >= self.reference + self.column("m", len(variance))
