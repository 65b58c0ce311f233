"""The adaptive threshold trigger of the unknown-input paper."""

from dataclasses import dataclass

import numpy as np

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.policies.base import LocalRule, PerSensor, Requests, parameter, shape_of


@dataclass
class AdaptiveThreshold(LocalRule):
    r"""Request when |σ|² > ρ, with σ the measurement minus the last delivered measurement.

    The threshold follows ρ' = ρ̄ + |σ|²/(λ + |σ|²) (ρ - ρ̄) in every step, with σ before the
    transmission. It rises from ρ₀ at an episode's start towards ρ̄.

    While every request is granted, |σ|² <= ρ̄ at every step without a transmission. σ refers to the
    last delivery, not to the last request, so the bound holds again after the grant of a repeated
    request. The measurement at time 0 counts as delivered.

    Args:
        rho_bar: ρ̄, the limit of the threshold, in squared units of the measurement.
        rho_initial: ρ₀ <= ρ̄, the threshold at an episode's start.
        adaptation: λ > 0, in squared units of the measurement.
        scale: factor of ρ̄ and ρ₀, for sweeps.
        min_interval: least steps between two deliveries of a sensor, >= 1.
        max_interval: most steps between two deliveries of a sensor; None for no limit.

    Raises:
        ConfigurationError: not 0 <= ρ₀ <= ρ̄ <= 1, or λ <= 0, or a negative scale.

    Equation:
        $$
        \delta_i(t)=1\iff |\sigma_i(t)|^2>\rho_i(t),\qquad \sigma_i=y_i-\bar y_i
        $$

        $$
        \rho_i(t+1)=\bar\rho_i+\frac{|\sigma_i|^2}{\lambda_i+|\sigma_i|^2}
        \,(\rho_i(t)-\bar\rho_i),\qquad
        \rho_i(0)=\rho_{0,i}
        $$

        ȳᵢ is the last delivered measurement. ρ̄ is ``rho_bar``, ρ₀ ``rho_initial``, λ
        ``adaptation``; ``scale`` multiplies ρ̄ and ρ₀.

    Assumes: a centre that holds the last delivered value, and for the bound ρ̄ a network that
    grants every request.

    Source: unknown_input, equations (5)-(7), defaults of Section 4.

    Example: ``adaptive_threshold`` in ``fusion_gym/UnknownInput-v1``.
    """

    rho_bar: PerSensor = 0.05
    rho_initial: PerSensor = 0.01
    adaptation: PerSensor = 0.01
    scale: float = parameter(1.0, validation.number, at_least=0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        validation.adaptive_thresholds(self.rho_bar, self.rho_initial, self.adaptation)

    @property
    def knowledge(self) -> Knowledge:
        """A sensor's measurement, with memory unless the threshold is constant."""
        initial, limit = np.asarray(self.rho_initial), np.asarray(self.rho_bar)
        return "own" if self.scale == 0.0 or bool(np.all(initial == limit)) else "own_memory"

    def reset(self, runs: int, seed: int = 0) -> None:
        """Clear the thresholds."""
        self._rho: Array | None = None

    def threshold_after(self, rho: Array, squared: Array) -> Array:
        """Return the next threshold (sensors, N).

        Source: unknown_input, equation (7).

        Args:
            rho: present threshold ρ (sensors, N).
            squared: |σ|² before the transmission (sensors, N).
        """
        limit = self.scale * self.column("rho_bar", len(rho))
        share = squared / (self.column("adaptation", len(rho)) + squared)
        return limit + share * (rho - limit)

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        sensors, runs = shape_of(signals)
        initial = self.scale * self.column("rho_initial", sensors)
        start = signals["start"]
        if self._rho is None:
            self._rho, start = np.empty((sensors, runs)), np.ones(runs, dtype=np.bool_)
        rho = np.where(start, initial, self._rho)
        difference = signals["measurement"] - signals["held"]
        squared = linalg.dot(difference, difference)
        request = self.limit(squared > rho, signals)
        self._rho = self.threshold_after(rho, squared)
        return request
