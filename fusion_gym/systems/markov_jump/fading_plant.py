"""The true Markov jump plant with fading sensors.

Source: markov_jump (event-triggered distributed fusion estimation for asynchronous Markov jump
systems with correlated noises and fading measurements).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.core.nature import AS_ASSUMED, Nature, true_noise
from fusion_gym.namespace import namespace
from fusion_gym.systems.markov_jump.linear_minimum_variance import AugmentedModel, Times
from fusion_gym.systems.markov_jump.plant import MarkovJumpPlant, Modes, draw_mode
from fusion_gym.systems.markov_jump.sensors import FadingSensors
from fusion_gym.systems.parts import SensorPlant, Truth


@dataclass(slots=True)
class MarkovJumpTruth(Truth):
    """The true state of N runs at one time k, measured as if all sensors sampled.

    ``time`` k (N,) · ``mode`` θ (N,) · ``process_noise`` w(k) (r, N), which moves the plant next.
    """

    time: Times
    mode: Modes
    process_noise: Array


@dataclass(frozen=True)
class FadingPlant(SensorPlant[MarkovJumpTruth]):
    """A Markov jump plant with fading sensors, and the augmented model of its moments.

    ``nature`` is the departure of the truth from this model.
    """

    dynamics: MarkovJumpPlant
    sensors: FadingSensors
    model: AugmentedModel
    state_names: tuple[str, ...]
    nature: Nature = AS_ASSUMED

    @property
    def noise_channels(self) -> int:
        """Normals of one step: process noise, mode, sensors."""
        return super().noise_channels + 1

    @property
    def start_channels(self) -> int:
        """Normals of a start: state, mode, first process noise, nature's."""
        return self.draw_channels + self.nature.channels

    def start(self, noise: Array) -> tuple[MarkovJumpTruth, None]:
        """Draw the initial state; nothing is measured."""
        noise, departure = self.nature.begin(noise)
        first, runs = self.dynamics.size + 1, noise.shape[-1]
        truth, mode = self.dynamics.start(noise[:first])
        process = true_noise(departure, noise[first:], noise[:0])[0]
        drawn = self.dynamics.process_noise(process)
        time, nothing = np.zeros(runs, np.int64), np.full((self.sensors.count, 1, runs), np.nan)
        return MarkovJumpTruth(truth, nothing, departure, time, mode, drawn), None

    def sense(self, state: MarkovJumpTruth, noise: Array) -> MarkovJumpTruth:
        """Move the plant, and measure with all sensors.

        The state's process noise is the actual one.

        Source: markov_jump, equations (3), (4).
        """
        plant, sensors, moving = self.dynamics, self.sensors, self.dynamics.noise_channels
        xp = namespace(noise)
        fading, own = xp.split(noise[moving + 1 :], (sensors.count,))
        process, own = true_noise(state.departure, noise[:moving], own)
        following = plant.advance(state.truth, state.mode, state.process_noise, state.departure)
        jumped = plant.jump(state.mode, noise[moving])
        drawn = plant.process_noise(process)
        measurement = sensors.measure(following, jumped, drawn, xp.concatenate((fading, own)))
        return MarkovJumpTruth(
            following, measurement[:, None], state.departure, state.time + 1, jumped, drawn
        )

    @property
    def draw_channels(self) -> int:
        """Normals of truth, mode and process noise."""
        return self.dynamics.size + 1 + self.dynamics.noise_channels

    def draw(
        self, measurement: Array, mean: Array, covariance: Array, noise: Array, time: Array
    ) -> MarkovJumpTruth:
        """Draw the truth from N(mean, covariance), the mode and the process noise from their laws.

        The draws of mode and process noise do not use the measurements.
        """
        plant, n, times = self.dynamics, self.dynamics.size, time.astype(np.int64)
        law = np.empty((plant.modes, len(times)))
        for each in np.unique(times):
            moved = np.linalg.matrix_power(plant.mode_transition, each)
            law[:, times == each] = (plant.initial_probabilities @ moved)[:, None]
        truth = linalg.draw_normal(mean, covariance, noise[:n])
        mode = draw_mode(np.cumsum(law, 0)[:-1], noise[n])
        process_noise = plant.process_noise(noise[n + 1 :])
        return MarkovJumpTruth(truth, measurement, None, times, mode, process_noise)

    def open_loop(self, horizon: int) -> Array:
        """Return the mean error variance (n,) over t = 1..horizon without any delivery."""
        return self.model.open_loop(horizon)
