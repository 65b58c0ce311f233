"""The dynamic event trigger of the token-bucket paper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg, validation
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
class DynamicEvent(Trigger):
    """Request when |ε| >= η/χ + σ, with ε the last requested minus the current measurement.

    ``threshold`` σ and ``initial`` η₀ are in the unit of the measurement, ``decay`` λ and
    ``divisor`` χ without unit; ``scale`` multiplies σ and η₀, for sweeps. The dynamic variable
    follows η' = λ η + σ - |ε|, where ε is zero after a request, and is clipped at zero: the
    condition λ χ > 1 that would keep it positive is violated by the paper's own numbers.

    Source: tobit_token_bucket, equations (11)-(15).
    """

    threshold: PerSensor = (0.1, 0.2, 0.3)
    decay: PerSensor = (0.1, 0.2, 0.1)
    divisor: PerSensor = 5.0
    initial: PerSensor = 1.5
    scale: float = 1.0

    def __post_init__(self) -> None:
        for name in ("threshold", "decay", "initial"):
            check_not_negative(name, getattr(self, name))
        for divisor in np.atleast_1d(np.asarray(self.divisor, dtype=object)):
            validation.number("divisor", divisor, above=0.0)
        validation.number("scale", self.scale, at_least=0.0)
        self.reset(0)

    def reset(self, num_envs: int, seed: int = 0) -> None:
        """Forget the dynamic variable and the last requested measurements."""
        self._eta: NDArray[np.float64] | None = None
        self._requested: NDArray[np.float64] | None = None

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        sensors, runs = shape_of(signals)
        sigma = self.scale * column("threshold", self.threshold, sensors)
        initial = self.scale * column("initial", self.initial, sensors)
        measurement, start = signals["measurement"], signals["start"]
        if self._eta is None or self._requested is None:
            self._eta, self._requested = np.empty((sensors, runs)), signals["held"]
            start = np.ones(runs, dtype=np.bool_)
        eta = np.where(start, initial, self._eta)
        requested = np.where(start, signals["held"], self._requested)
        difference = requested - measurement
        size = np.sqrt(linalg.dot(difference, difference))
        request: Requests = size >= eta / column("divisor", self.divisor, sensors) + sigma
        error = np.where(request, 0.0, size)
        decay = column("decay", self.decay, sensors)
        self._eta = np.maximum(decay * eta + sigma - error, 0.0)
        self._requested = np.where(request[:, None], measurement, requested)
        return request
