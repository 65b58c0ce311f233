"""A pendulum, a gyroscope, a camera, and an extended Kalman filter: a system of one's own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import fusion_gym
from fusion_gym import CommonOptions, NonlinearSystem, Scenario, linalg

STEP, GRAVITY, FRICTION = (
    0.05,
    9.81,
    0.2,
)  # seconds; per second², for a rod of one metre; per second
PUSH, NOISE = 1.0, (0.2, 0.05)  # deviations: rad/s per √s; rad/s of the gyroscope, m of the camera


class Pendulum(NonlinearSystem):
    """Angle and angular velocity; sensor 0 measures the velocity, sensor 1 the bob's position."""

    def __init__(self) -> None:
        super().__init__(
            ("angle", "velocity"), sensors=2, process_channels=1,
            initial_mean=[0.5, 0.0], initial_covariance=0.1 * np.eye(2),
        )  # fmt: skip

    def move(self, state, noise):
        """Euler's step."""
        angle, velocity = state
        push = -GRAVITY * np.sin(angle) - FRICTION * velocity
        return np.stack(
            [angle + STEP * velocity, velocity + STEP * push + PUSH * STEP**0.5 * noise[0]]
        )

    def measure(self, state, noise):
        """Velocity, and horizontal position."""
        return (
            np.stack([state[1], np.sin(state[0])])[:, None] + np.array(NOISE)[:, None, None] * noise
        )

    def predict(self, mean, covariance):
        """Linearised at the mean."""
        ones = np.ones_like(mean[0])
        slope = np.array(
            [
                [ones, STEP * ones],
                [-STEP * GRAVITY * np.cos(mean[0]), (1.0 - STEP * FRICTION) * ones],
            ]
        )
        covariance = linalg.congruence(slope, covariance)
        return self.move(mean, np.zeros((1, 1))), linalg.add_diagonal(
            covariance, np.array([[0.0], [PUSH**2 * STEP]])
        )

    def update(self, mean, covariance, sensor, measurement):
        """Linearised at the mean."""
        zero = np.zeros_like(mean[0])
        row = np.stack([np.cos(mean[0]), zero] if sensor else [zero, zero + 1.0])
        expected = np.sin(mean[0]) if sensor else mean[1]
        cross = linalg.matvec(covariance, row)
        gain = cross / (linalg.dot(row, cross) + NOISE[sensor] ** 2)
        return mean + gain * (measurement[0] - expected), covariance - linalg.outer(gain, cross)


@dataclass(frozen=True)
class PendulumOptions(CommonOptions):
    """A pendulum that is pushed at random, seen by a gyroscope and a camera.

    Starting state: N((0.5, 0), 0.1 I).
    """

    token_rate: float = 1.0


def build(options: PendulumOptions) -> Scenario:
    """The scenario of these options."""
    pendulum = Pendulum()
    return Scenario(options, pendulum.plant, pendulum.estimator)


fusion_gym.register("examples/Pendulum-v0", build)

if __name__ == "__main__":
    task = fusion_gym.make_task("examples/Pendulum-v0")
    for name in ("always", "periodic:period=8", "innovation_threshold:threshold=2,whitened=true",
                 "value_of_information:threshold=0.01,at_most=1"):  # fmt: skip
        policy = fusion_gym.make_policy(name, task)
        found = fusion_gym.evaluation.run_episodes(task, policy, 500, seed=0)
        said = f"rate {found.rate.mean():.3f}  MSE {found.mse.mean():.4f}"
        print(f"{name:48s} {said}  NEES {found.nees.mean():.2f}")
