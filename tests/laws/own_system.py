"""Environments as users would write them: a walk seen by one sensor, and sensors that drop out."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fusion_gym import (
    Block,
    CommonOptions,
    Estimator,
    NonlinearSystem,
    Plant,
    Reception,
    Scenario,
    Signal,
)
from fusion_gym.arrays import Array
from fusion_gym.core.estimator import SignalValues
from fusion_gym.core.knowledge import age_block

OWN_ID = "mine/RandomWalk-v0"


@dataclass(slots=True)
class Walk:
    """The truth (1, N) and its measurement (1, 1, N)."""

    truth: Array
    measurement: Array


@dataclass(frozen=True)
class RandomWalk(Plant[Walk]):
    """x' = x + w, y = x + v, w ~ N(0, q), v ~ N(0, r)."""

    q: float
    r: float

    state_names = ("x",)
    sensor_count = 1
    noise_channels = 2
    start_channels = 1

    def start(self, noise: Array) -> tuple[Walk, None]:
        return Walk(noise.copy(), np.zeros_like(noise)[None]), None

    def sense(self, state: Walk, noise: Array) -> Walk:
        truth = state.truth + np.sqrt(self.q) * noise[:1]
        return Walk(truth, (truth + np.sqrt(self.r) * noise[1:])[None])

    def open_loop(self, horizon: int) -> Array:
        return np.array([1.0 + self.q * (horizon + 1) / 2])


@dataclass(slots=True)
class WalkEstimate:
    """``measurement`` and ``held`` (1, 1, N), ``age`` (1, N), means (1, N) and variances (1, N)."""

    measurement: Array
    held: Array
    age: Array
    prior: Array
    prior_variance: Array
    mean: Array
    variance: Array


@dataclass(frozen=True)
class WalkFilter(Estimator[WalkEstimate]):
    """A Kalman filter at the centre."""

    q: float
    r: float

    signals = (
        Signal("measurement", "own", "(sensors, 1, N)", "the new measurement"),
        Signal("innovation", "own", "(sensors, 1, N)", "that minus its expectation"),
        Signal("innovation_deviation", "centre", "(sensors, 1, N)", "its deviation", "own"),
        Signal("held", "centre", "(sensors, 1, N)", "the last delivered measurement", "own"),
        Signal("age", "centre", "(sensors, N)", "steps since the last delivery", "own"),
        Signal("prior_mean", "centre", "(n, N)", "the centre's prediction"),
        Signal("prior_covariance", "centre", "(n, n, N)", "its covariance"),
    )

    @property
    def observation(self) -> tuple[Block, ...]:
        return (
            Block("surprise", "whitened innovation", self._surprise, (("0",),), "own", "own", 5.0),
            age_block(("0",)),
            Block("spread", "ln(P/q) over ten", self._spread, node="broadcast", limit=5.0),
        )

    def start(self, measurement: Array, announcement: None) -> WalkEstimate:
        zero = np.zeros_like(measurement[0])
        return WalkEstimate(measurement, measurement, zero, zero, zero + 1.0, zero, zero + 1.0)

    def predict(self, state: WalkEstimate) -> WalkEstimate:
        variance = state.variance + self.q
        return replace(state, age=state.age + 1.0, prior=state.mean, prior_variance=variance)

    def observe(self, state: WalkEstimate, measurement: Array) -> WalkEstimate:
        return replace(state, measurement=measurement)

    def update(self, state: WalkEstimate, reception: Reception) -> WalkEstimate:
        arrived, surprise = reception.arrived, state.measurement[0] - state.prior
        gain = np.where(arrived, state.prior_variance / (state.prior_variance + self.r), 0.0)
        return replace(
            state,
            held=np.where(arrived, state.measurement, state.held),
            age=np.where(arrived, 0.0, state.age),
            mean=np.where(arrived, state.prior + gain * surprise, state.prior),
            variance=(1.0 - gain) * state.prior_variance,
        )

    def read(self, state: WalkEstimate, failure: Array | None = None) -> SignalValues:
        return {
            "measurement": state.measurement,
            "innovation": lambda: state.measurement - state.prior,
            "innovation_deviation": lambda: np.sqrt(state.prior_variance + self.r)[:, None],
            "held": state.held,
            "age": state.age,
            "prior_mean": state.prior,
            "prior_covariance": state.prior_variance[:, None],
        }

    def covariance(self, state: WalkEstimate) -> Array:
        return state.variance[:, None]

    def local_means(self, state: WalkEstimate) -> Array:
        return state.mean[None]

    def _surprise(self, state: WalkEstimate) -> Any:
        return (state.measurement[0] - state.prior) / np.sqrt(state.prior_variance + self.r)

    def _spread(self, state: WalkEstimate) -> Any:
        return 0.1 * np.log(state.prior_variance[0] / self.q)


@dataclass(frozen=True)
class WalkOptions(CommonOptions):
    """Every option of the environment."""

    q: float = 0.5
    r: float = 2.0
    horizon: int = 40


def build(options: WalkOptions) -> Scenario:
    """The scenario of these options."""
    return Scenario(options, RandomWalk(options.q, options.r), WalkFilter(options.q, options.r))


class Dropouts(NonlinearSystem):
    """x' = 0.9 x + w, y = x + v of two sensors, without readings at random and at large x."""

    def __init__(self) -> None:
        start: Any = {"initial_mean": [0.0], "initial_covariance": [[1.0]]}
        super().__init__(("x",), sensors=2, process_channels=1, **start)

    def move(self, state: Array, noise: Array) -> Array:
        return 0.9 * state + 0.5 * noise

    def measure(self, state: Array, noise: Array) -> Array:
        return state[None] + 0.7 * noise

    def available(self, state: Array, noise: Array) -> Any:
        return (noise < 0.5) & (np.abs(state) < 1.5)

    def predict(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        return 0.9 * mean, 0.81 * covariance + 0.25

    def update(
        self, mean: Array, covariance: Array, sensor: int, measurement: Array
    ) -> tuple[Array, Array]:
        gain = covariance[0] / (covariance[0] + 0.49)
        return mean + gain * (measurement - mean), (1.0 - gain) * covariance


@dataclass(frozen=True)
class DropoutOptions(CommonOptions):
    """Every option of the sensors that drop out."""

    horizon: int = 40


def build_dropouts(options: DropoutOptions) -> Scenario:
    """The scenario of these options."""
    system = Dropouts()
    return Scenario(options, system.plant, system.estimator)


OWN_IDS = {OWN_ID: build, "mine/Dropouts-v0": build_dropouts}
