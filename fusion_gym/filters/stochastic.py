"""The Kalman filter that knows what silence means under the stochastic event trigger."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import linalg, validation
from fusion_gym.filters.base import Expectation, Plan, linear_update
from fusion_gym.filters.kalman import KalmanFilter
from fusion_gym.sensors import CensoredSensors
from fusion_gym.validation import Array, ConfigurationError


@dataclass(frozen=True)
class StochasticEventFilter:
    """A delivery is a Kalman update; silence is a measurement too, of variance R + Z⁻¹.

    A sensor that stays silent with probability exp(-zᵀ Z z / 2), z its innovation and
    Z = ``weight`` · I, says by its silence that z was small: as if z = 0 had been measured with
    the additional noise variance Z⁻¹. So the silent mean is the prior's, and
    P' = P - P Cᵀ (C P Cᵀ + R + Z⁻¹)⁻¹ C P. Under federated fusion several nodes together give the
    exact posterior, whatever mixture of deliveries and silences occurred, because z is taken
    against the centre's prediction, which all nodes share.

    Exact if the policy is ``stochastic_event`` with this weight, every request is granted and the
    sensors are uncensored. Otherwise silence is over-interpreted: after a denial, under censoring
    or with a more silent policy the claimed covariance is too small.

    ``weight`` has shape (sensors, 1), in the inverse squared unit of the measurement, >= 0; with
    weight 0 silence says nothing. Build one with :meth:`create`.

    Source: D. Han, Y. Mo, J. Wu, S. Weerakkody, B. Sinopoli and L. Shi, "Stochastic
    event-triggered sensor schedule for remote state estimation", IEEE Trans. Automatic Control
    60(10), 2015, the estimator of the closed-loop schedule.
    """

    sensors: CensoredSensors
    weight: Array

    @classmethod
    def create(cls, sensors: CensoredSensors, weight: ArrayLike | None) -> StochasticEventFilter:
        """Check the weight, one number > 0 or one a sensor.

        Raises:
            ConfigurationError: no weight, another number of entries, or an entry <= 0.
        """
        if weight is None:
            raise ConfigurationError(
                "stochastic_weight = None is not allowed with filter='stochastic': it must be the "
                "weight of the policy 'stochastic_event', a number > 0 or one a sensor"
            )
        checked = validation.positive("stochastic_weight", weight, (sensors.count,))
        return cls(sensors, checked[:, None])

    def expect(self, mean: Array) -> Expectation:
        """See :class:`fusion_gym.filters.NodeFilter`; censoring is ignored."""
        return KalmanFilter(self.sensors).expect(mean)

    def plan(
        self, mean: Array, covariance: Array, expectation: Expectation, held: Array, time: Array
    ) -> Plan:
        """See :class:`fusion_gym.filters.NodeFilter`; ``held`` and ``time`` do not matter here."""
        matrix = self.sensors.measurement_matrix
        innovation = linalg.congruence(matrix, covariance)
        innovation = linalg.add_diagonal(innovation, self.sensors.variance)
        correction, delivered = linear_update(covariance, matrix, innovation)
        # Both sides times √Z, so that weight 0 is no exception: √Z C measured with √Z S √Z + I.
        weight = self.weight[:, None, None]
        scaled = linalg.add_diagonal(weight * innovation, np.ones((matrix.shape[-3], 1)))
        _, silent = linear_update(covariance, np.sqrt(weight) * matrix, scaled)
        return Plan(correction, delivered, mean, silent)
