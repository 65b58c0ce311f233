"""Kalman filter on the state together with its input, which it takes for a random walk."""

from __future__ import annotations

from dataclasses import dataclass

from fusion_gym import linalg
from fusion_gym.filters.input_state import InputModel, InputSensors
from fusion_gym.validation import Array


@dataclass(frozen=True)
class RandomWalkInputFilter:
    """The Kalman filter of z = [x(k); d(k - 1)] under an :class:`InputModel`.

    Unlike the unbiased filters it uses what it knew of the input before, and it is optimal if the
    input does follow the model. The actual input does not, so its covariance is a claim, not a
    bound; how good a claim depends on the model's numbers.

    Source: B. Friedland, "Treatment of bias in recursive filtering", IEEE Trans. Automatic
    Control 14, 1969, for the augmented state.
    """

    model: InputModel
    sensors: InputSensors

    def update(self, prior: Array, noise: Array) -> tuple[Array, Array]:
        """Gain (l, s, m, N) and covariance (l, s, s, N) from prior (l, s, s, N) and noise.

        ``noise`` (l, m, m, N or 1) is the covariance of what is taken for the measurement.
        """
        n = self.model.size
        matrix = self.sensors.matrix
        cross = linalg.matmul(prior[:, :, :n], linalg.transpose(matrix))
        innovation = linalg.matmul(matrix, cross[:, :n]) + noise
        if self.sensors.size == 1:
            gain = cross / innovation
        else:
            gain = linalg.transpose(linalg.solve(innovation, linalg.transpose(cross)))
        covariance = prior - linalg.matmul(gain, linalg.transpose(cross))
        return gain, linalg.symmetrise(covariance)
