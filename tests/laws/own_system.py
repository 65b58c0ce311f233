"""An environment as a user would write one: a random walk, seen through noise by one sensor."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.core.options import CommonOptions, Scenario
from fusion_gym.core.system import Block, Signal, SignalArray, System, age_block

OWN_ID = "mine/RandomWalk-v0"


@dataclass(slots=True)
class WalkState:
    """One number a run each, (1, N); ``age`` (1, N)."""

    truth: Array
    measurement: Array
    held: Array
    age: Array
    prior: Array
    prior_variance: Array
    mean: Array
    variance: Array


@dataclass(frozen=True)
class RandomWalk(System[WalkState]):
    """x' = x + w, y = x + v, w ~ N(0, q), v ~ N(0, r): a Kalman filter at the centre."""

    q: float
    r: float

    sensor_count = 1
    state_names = ("x",)
    noise_channels = 2
    start_channels = 1
    signals = (
        Signal("measurement", "own", "(sensors, 1, N)", "the new measurement"),
        Signal("innovation", "own", "(sensors, 1, N)", "that minus its expectation"),
        Signal("innovation_deviation", "centre", "(sensors, 1, N)", "its deviation"),
        Signal("held", "centre", "(sensors, 1, N)", "the last delivered measurement"),
        Signal("age", "centre", "(sensors, N)", "steps since the last delivery"),
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

    def start(self, noise: Array) -> WalkState:
        zero, ones = np.zeros_like(noise), np.ones_like(noise)
        return WalkState(noise.copy(), zero, zero, zero, zero, ones, zero, ones)

    def sense(self, state: WalkState, noise: Array) -> WalkState:
        truth = state.truth + np.sqrt(self.q) * noise[:1]
        return replace(
            state,
            truth=truth,
            measurement=truth + np.sqrt(self.r) * noise[1:],
            age=state.age + 1.0,
            prior=state.mean,
            prior_variance=state.variance + self.q,
        )

    def deliver(self, state: WalkState, granted: NDArray[np.bool_]) -> WalkState:
        gain = np.where(granted, state.prior_variance / (state.prior_variance + self.r), 0.0)
        return replace(
            state,
            held=np.where(granted, state.measurement, state.held),
            age=np.where(granted, 0.0, state.age),
            mean=np.where(
                granted, state.prior + gain * (state.measurement - state.prior), state.prior
            ),
            variance=(1.0 - gain) * state.prior_variance,
        )

    def read(self, state: WalkState) -> Mapping[str, SignalArray | Callable[[], SignalArray]]:
        return {
            "measurement": state.measurement[:, None],
            "innovation": lambda: (state.measurement - state.prior)[:, None],
            "innovation_deviation": lambda: np.sqrt(state.prior_variance + self.r)[:, None],
            "held": state.held[:, None],
            "age": state.age,
            "prior_mean": state.prior,
            "prior_covariance": state.prior_variance[:, None],
        }

    def visible(self, state: WalkState) -> WalkState:
        return replace(state, truth=np.full_like(state.truth, np.nan))

    def truth(self, state: WalkState) -> Array:
        return state.truth

    def fused(self, state: WalkState) -> tuple[Array, Array]:
        return state.mean, state.variance[:, None]

    def local_means(self, state: WalkState) -> Array:
        return state.mean[None]

    def open_loop(self, horizon: int) -> Array:
        return np.array([1.0 + self.q * (horizon + 1) / 2])

    def _surprise(self, state: WalkState) -> Array:
        return (state.measurement - state.prior) / np.sqrt(state.prior_variance + self.r)

    def _spread(self, state: WalkState) -> Array:
        return 0.1 * np.log(state.prior_variance[0] / self.q)


@dataclass(frozen=True)
class WalkOptions(CommonOptions):
    """Every option of the environment."""

    q: float = 0.5
    r: float = 2.0
    horizon: int = 40


def build(options: WalkOptions) -> Scenario:
    """The scenario of these options."""
    return Scenario(options, RandomWalk(options.q, options.r))
