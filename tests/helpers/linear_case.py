"""A nonlinear system whose functions are linear, so that its optimal filter is known."""

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.core.task import CommonOptions, Scenario
from fusion_gym.systems.nonlinear import NonlinearSystem

Array = NDArray[np.float64]
A, W = np.array([[0.9, 0.2], [-0.1, 0.95]]), np.diag([0.04, 0.09])
C, DEVIATION = np.array([[1.0, 0.0], [1.0, 1.0]]), np.array([0.5, 0.3])
MEAN, START = np.array([1.0, -1.0]), np.array([[0.5, 0.1], [0.1, 0.4]])


class Linear(NonlinearSystem):
    """A linear case, whose optimal filter is known."""

    def __init__(self) -> None:
        super().__init__(
            ("a", "b"), sensors=2, process_channels=2, initial_mean=MEAN, initial_covariance=START
        )

    def move(self, state: Array, noise: Array) -> Array:
        return A @ state + np.sqrt(W) @ noise

    def measure(self, state: Array, noise: Array) -> Array:
        return (C @ state)[:, None] + DEVIATION[:, None, None] * noise

    def predict(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        return A @ mean, linalg.congruence(A[..., None], covariance) + W[..., None]

    def update(
        self, mean: Array, covariance: Array, sensor: int, measurement: Array
    ) -> tuple[Array, Array]:
        row = C[sensor][:, None]
        cross = linalg.matvec(covariance, np.broadcast_to(row, mean.shape))
        gain = cross / (linalg.dot(row, cross) + DEVIATION[sensor] ** 2)
        changed = covariance - linalg.outer(gain, cross)
        return mean + gain * (measurement[0] - linalg.dot(row, mean)), changed


def build(options: CommonOptions) -> Scenario:
    system = Linear()
    return Scenario(options, system.plant, system.estimator)
