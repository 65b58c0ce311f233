"""The adaptive innovation trigger of the correlated-noise paper."""

from dataclasses import dataclass

import numpy as np

from fusion_gym.arrays import Array
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.policies.base import (
    LocalRule,
    PerSensor,
    Requests,
    not_negative_parameter,
    parameter,
    surprise,
)


@dataclass
class AdaptiveInnovation(LocalRule):
    r"""Request when |ε|² >= a exp(-(b + c |ε at the last request|)), with ε the innovation.

    A large innovation lowers the threshold. Before the first request of an episode the stored
    innovation is zero.

    The rule decides at the sensor, so a request changes the threshold even if the network denies
    it. In the paper every request is granted. The printed exponent -b + c |ε| contradicts the
    paper's text, which requires a decreasing function.

    Args:
        threshold: a >= 0, in squared units of the measurement; 0 always requests.
        offset: b >= 0, without unit.
        sensitivity: c >= 0, in the inverse unit of the measurement; 0 is a fixed threshold.
        min_interval: least steps between two deliveries of a sensor, >= 1.
        max_interval: most steps between two deliveries of a sensor; None for no limit.

    Equation:
        $$
        \delta_i(t)=1\iff |\varepsilon_i(t)|^2\ge
        a_i\exp\left(-b_i-c_i\,|\varepsilon_i(l_i)|\right)
        $$

        ε is the innovation, lᵢ the step of the sensor's last request; before the first request
        ε(lᵢ) is 0. a is ``threshold``, b ``offset``, c ``sensitivity``.

    Assumes: a prediction of the measurement at the sensor, and a network that grants all requests.

    Source: adaptive_innovation, equations (9)-(11), defaults of Section 6.

    Example: ``adaptive_innovation`` in ``fusion_gym/CorrelatedTracking-v1``.
    """

    threshold: PerSensor = parameter(0.6, not_negative_parameter)
    offset: PerSensor = parameter(0.2, not_negative_parameter)
    sensitivity: PerSensor = parameter(0.9, not_negative_parameter)

    @property
    def knowledge(self) -> Knowledge:
        """A sensor's measurement, with memory of its last request unless the sensitivity is 0."""
        return "own_memory" if np.any(np.asarray(self.sensitivity) > 0.0) else "own"

    def reset(self, runs: int, seed: int = 0) -> None:
        """Clear the last requested innovations."""
        self._last: Array | None = None

    def threshold_after(self, last: Array) -> Array:
        """Return the threshold on |ε|² after requests at innovations of size ``last``.

        Source: adaptive_innovation, equation (10), with the sign of the paper's text.

        Args:
            last: size of the innovation at the last request (sensors, N).
        """
        sensors = len(last)
        exponent = self.column("sensitivity", sensors) * last
        exponent += self.column("offset", sensors)
        return self.column("threshold", sensors) * np.exp(-exponent)

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        squared = surprise(signals)
        if self._last is None:
            self._last = np.zeros(squared.shape)
        last = np.where(signals["start"], 0.0, self._last)
        threshold = self.threshold_after(last)
        request = self.limit(squared >= threshold, signals)
        self._last = np.where(request, np.sqrt(squared), last)
        return request
