"""An inverted pendulum that a motor balances by an estimate: a closed loop of one's own."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import fusion_gym
from fusion_gym import CommonOptions, NonlinearSystem, Scenario, linalg

STEP, GRAVITY, FRICTION = 0.05, 9.81, 0.2  # s; 1/s², for a rod of one metre; 1/s
PUSH, NOISE = 0.6, (0.05, 0.02)  # deviations: rad/s per √s; rad/s of the gyroscope, m of the camera
GAIN = np.array([GRAVITY + 16.0, 8.0])  # both poles of the linear loop at -4 per second
FALL = 1.0  # rad, beyond which the motor is too weak


class InvertedPendulum(NonlinearSystem):
    """Angle from upright and velocity; a gyroscope measures the velocity, a camera the position."""

    def __init__(self) -> None:
        super().__init__(
            ("angle", "velocity"), sensors=2, process_channels=1, inputs=1,
            initial_mean=[0.0, 0.0], initial_covariance=0.01 * np.eye(2),
        )  # fmt: skip

    def control(self, mean):
        """The motor's acceleration, at most 30 rad/s²."""
        return np.clip(-GAIN @ mean, -30.0, 30.0)[None]

    def cost(self, state, control):
        """Of angle, velocity and effort."""
        return 10.0 * state[0] ** 2 + state[1] ** 2 + 0.01 * control[0] ** 2

    def terminated(self, state):
        """A fall ends the episode."""
        return abs(state[0]) > FALL

    def move(self, state, noise, control):
        """Euler's step."""
        angle, velocity = state
        push = GRAVITY * np.sin(angle) - FRICTION * velocity + control[0]
        moved = velocity + STEP * push + PUSH * STEP**0.5 * noise[0]
        return np.stack([angle + STEP * velocity, moved])

    def measure(self, state, noise):
        """Velocity, and horizontal position."""
        exact = np.stack([state[1], np.sin(state[0])])
        return exact[:, None] + np.array(NOISE)[:, None, None] * noise

    def predict(self, mean, covariance, control):
        """Linearised at the mean."""
        ones = np.ones_like(mean[0])
        fall = STEP * GRAVITY * np.cos(mean[0])
        slope = np.array([[ones, STEP * ones], [fall, (1.0 - STEP * FRICTION) * ones]])
        covariance = linalg.congruence(slope, covariance)
        noise = np.array([[0.0], [PUSH**2 * STEP]])
        moved = self.move(mean, np.zeros((1, 1)), control)
        return moved, linalg.add_diagonal(covariance, noise)

    def update(self, mean, covariance, sensor, measurement):
        """Linearised at the mean."""
        zero = np.zeros_like(mean[0])
        row = np.stack([np.cos(mean[0]), zero] if sensor else [zero, zero + 1.0])
        expected = np.sin(mean[0]) if sensor else mean[1]
        cross = linalg.matvec(covariance, row)
        gain = cross / (linalg.dot(row, cross) + NOISE[sensor] ** 2)
        return mean + gain * (measurement[0] - expected), covariance - linalg.outer(gain, cross)


@dataclass(frozen=True)
class InvertedPendulumOptions(CommonOptions):
    """An inverted pendulum that is pushed at random, seen by a gyroscope and a camera.

    Starting state: N(0, 0.01 I).
    """

    token_rate: float = 2.0
    token_cost: float = 1.0
    cost_weight: float = 0.5
    reward_scale: float | str | None = "auto"
    horizon: int = 200


def build(options: InvertedPendulumOptions) -> Scenario:
    """The scenario of these options."""
    system = InvertedPendulum()
    return Scenario(options, system.plant, system.estimator, controller=system.controller)


fusion_gym.register("examples/InvertedPendulum-v0", build)


class Periods:
    """Request each sensor with a period of its own, half a period apart."""

    knowledge = "clock"

    def __init__(self, gyroscope: int, camera: int) -> None:
        self.periods = np.array([[gyroscope], [camera]])

    def reset(self, runs, seed=0):
        """Keep nothing."""

    def __call__(self, signals):
        """Requests (sensors, N)."""
        return (signals["step"] + [[0], [1]] * self.periods // 2) % self.periods == 0


TRAINING = {
    "environment": {"id": "examples/InvertedPendulum-v0"},
    "algorithm": {
        "name": "ppo",
        "learning_rate": 0.002,
        "learning_rate_end": 0.00001,
        "n_steps": 32,
        "batch_size": 2048,
        "n_epochs": 4,
        "gamma": 0.97,
        "gae_lambda": 0.9,
    },
    "training": {"timesteps": 2_000_000, "num_envs": 256},
    "validation": {"every": 200_000, "episodes": 256},
    "output": "runs/inverted_pendulum",
}

if __name__ == "__main__":
    task = fusion_gym.make_task("examples/InvertedPendulum-v0")
    price = float(task.options.cost_weight)

    def total(policy, episodes=200, seed=10_000):
        """The cost of an episode's steps."""
        return fusion_gym.evaluation.run_episodes(task, policy, episodes, seed).cost(price).mean()

    policies = {name: fusion_gym.make_policy(name, task) for name in ("always", "never")}
    periods = itertools.product((1, 2, 3, 4, 5, 6), (1, 2, 3, 4, 6, 8, 12, 16))
    best = min((Periods(*pair) for pair in periods), key=total)
    policies["periods of {} and {} steps".format(*best.periods[:, 0])] = best
    texts = [
        f"value_of_information:threshold={x:.3g},at_most=none" for x in np.geomspace(1e-3, 0.1, 15)
    ]
    best = min((fusion_gym.make_policy(text, task) for text in texts), key=total)
    policies[f"value of information above {best.threshold:.3g}"] = best
    folder = Path(TRAINING["output"])
    experiment = fusion_gym.Experiment.model_validate(TRAINING)
    fusion_gym.train(experiment, resume=(folder / "latest.zip").exists())
    policies["agent"] = fusion_gym.make_policy(f"model:{folder}/best_model.zip", task)
    print(f"{'policy':50s}  tokens  control cost   cost at price {price:g}")
    for name, policy in policies.items():
        results = fusion_gym.evaluation.run_episodes(task, policy, 1000, seed=0)
        cost = results.cost(price)
        half = 1.96 * cost.std(ddof=1) / len(cost) ** 0.5
        print(
            f"{name:50s}  {results.tokens.mean():6.2f}  {results.control_cost.mean():12.4f}  ",
            end="",
        )
        print(f"{cost.mean():6.3f} ± {half:.3f}")
