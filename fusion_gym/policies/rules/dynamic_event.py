"""The dynamic event trigger of the token-bucket paper."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.policies.base import (
    LocalRule,
    PerSensor,
    Requests,
    each_number,
    not_negative_parameter,
    parameter,
    shape_of,
)


@dataclass
class DynamicEvent(LocalRule):
    r"""Request when |ε| >= η/χ + σ, with ε the last requested minus the current measurement.

    The dynamic variable follows η' = λ η + σ - |ε|, where ε is zero after a request. It is clipped
    at zero, because the paper's numbers violate the condition λ χ > 1 for a positive η. η depends
    on measurements without a request, and ε on requests that the network denied.

    Args:
        threshold: σ >= 0, in the unit of the measurement.
        decay: λ >= 0, without unit.
        divisor: χ > 0, without unit.
        initial: η₀ >= 0, in the unit of the measurement.
        scale: factor of σ and η₀, for sweeps.
        min_interval: least steps between two deliveries of a sensor, >= 1.
        max_interval: most steps between two deliveries of a sensor; None for no limit.

    Equation:
        $$
        \delta_i(t)=1\iff |\varepsilon_i|\ge\frac{\eta_i(t)}{\chi_i}+\sigma_i
        $$

        $$
        \eta_i(t+1)=\max\left(0,\ \lambda_i\,\eta_i(t)+\sigma_i
        -(1-\delta_i(t))\,|\varepsilon_i|\right),\qquad
        \eta_i(0)=\eta_{0,i}
        $$

        εᵢ is the last requested measurement minus the present measurement. σ is ``threshold``, λ
        ``decay``, χ ``divisor``, η₀ ``initial``; ``scale`` multiplies σ and η₀.

    Assumes: a centre that holds the last delivered value, and a network that grants all requests,
    since ε refers to the last request.

    Source: tobit_token_bucket, equations (11)-(15).

    Example: ``dynamic_event:scale=3`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2``.
    """

    threshold: PerSensor = parameter(0.2, not_negative_parameter)
    decay: PerSensor = parameter(0.1, not_negative_parameter)
    divisor: PerSensor = parameter(5.0, each_number, above=0.0)
    initial: PerSensor = parameter(1.5, not_negative_parameter)
    scale: float = parameter(1.0, validation.number, at_least=0.0)
    knowledge: ClassVar[Knowledge] = "own_memory"

    def reset(self, runs: int, seed: int = 0) -> None:
        """Clear the dynamic variable and the last requested measurements."""
        self._eta: Array | None = None
        self._requested: Array | None = None

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        sensors, runs = shape_of(signals)
        sigma = self.scale * self.column("threshold", sensors)
        initial = self.scale * self.column("initial", sensors)
        measurement, start = signals["measurement"], signals["start"]
        if self._eta is None or self._requested is None:
            self._eta, self._requested = np.empty((sensors, runs)), signals["held"]
            start = np.ones(runs, dtype=np.bool_)
        eta = np.where(start, initial, self._eta)
        requested = np.where(start, signals["held"], self._requested)
        difference = requested - measurement
        size = np.sqrt(linalg.dot(difference, difference))
        request = self.limit(size >= eta / self.column("divisor", sensors) + sigma, signals)
        error = np.where(request, 0.0, size)
        decay = self.column("decay", sensors)
        self._eta = np.maximum(decay * eta + sigma - error, 0.0)
        self._requested = np.where(request[:, None], measurement, requested)
        return request
