"""State and signals of the Markov jump system, and the motion that its systems share.

Source: markov_jump (event-triggered distributed fusion estimation for asynchronous Markov jump
systems with correlated noises and fading measurements).
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.core.nature import Nature, true_noise
from fusion_gym.core.reward import equal_weights
from fusion_gym.core.system import Block, Signal, System, common_signals, numbered
from fusion_gym.systems.markov_jump.lag_errors import JointPrediction, LagCovariances
from fusion_gym.systems.markov_jump.linear_minimum_variance import AugmentedModel, Times
from fusion_gym.systems.markov_jump.plant import MarkovJumpPlant, Modes, draw_mode
from fusion_gym.systems.markov_jump.sensors import FadingSensors


class Motion(NamedTuple):
    """The plant at the next time: ``truth`` (n, N), ``mode`` (N,), ``process_noise`` w (r, N).

    ``measurement`` (l, N) holds the measurements of all sensors, sampled or not.
    """

    truth: Array
    mode: Modes
    process_noise: Array
    measurement: Array


@dataclass(slots=True)
class MarkovJumpState:
    """The state of N runs at one time k; n states, a = modes · n, r noises, l sensors.

    ``time`` k (N,) · ``truth`` (n, N), ``mode`` θ (N,), ``process_noise`` w(k) (r, N), which moves
    the plant next · ``innovation`` ε (l, N), zero where a sensor does not sample · ``node_mean``
    ζ̂(k|k) (l, a, N), ``node_noise`` ŵ (l, r, N), the nodes' · ``copy_mean`` (l, a, N),
    ``copy_noise`` (l, r, N), the centre's: a prediction until delivery · ``held`` (l, n, N), the
    last delivered estimates · ``age`` (l, N), steps since then · ``sent`` (l, N) bool, the last
    deliveries · ``lags`` and ``prediction``, covariances · ``prior_mean`` (n, N),
    ``prior_covariance`` (n, n, N), fused without a transmission · ``mean`` (n, N), ``covariance``
    (n, n, N), fused after the delivery · ``departure`` (4, N) of the truth from the model, if any.
    """

    time: Times
    truth: Array
    mode: Modes
    process_noise: Array
    innovation: Array
    node_mean: Array
    node_noise: Array
    copy_mean: Array
    copy_noise: Array
    held: Array
    age: Array
    sent: NDArray[np.bool_]
    lags: LagCovariances
    prediction: JointPrediction | None
    prior_mean: Array
    prior_covariance: Array
    mean: Array
    covariance: Array
    departure: Array | None = None


_PER_SENSOR = "(sensors, N)"
# What both systems of the family offer beside the common signals.
OF_FAMILY = (
    Signal("centre_variance", "centre", "(N,)", "plain trace of the covariance without a delivery"),
    Signal(
        "greedy_variance",
        "centre",
        _PER_SENSOR,
        "trace if only the sensors before this one in the greedy order transmit",
        joint=True,
    ),
    Signal("sampled", "centre", _PER_SENSOR, "whether the sensor samples at this step"),
)
SIGNALS = (
    *common_signals(
        "(sensors, n, N)",
        measurement="the node's new estimate",
        innovation="the node's new estimate minus the centre's copy",
        held="the last delivered estimate",
        expected_measurement="the centre's copy, predicted",
    ),
    *OF_FAMILY,
    Signal("local_variance", "centre", _PER_SENSOR, "plain trace of the node's covariance"),
)


def sampling_blocks(sensors: FadingSensors) -> tuple[Block, Block]:
    """Return the blocks of the observation with the sensors' sampling phases."""
    own = partial(Block, labels=(numbered(sensors.count),), node="own")
    since = "steps since the sensor's last sampling time over its period"
    return (
        own(
            "sampled", "whether the sensor samples at this step", lambda s: sensors.sampled(s.time)
        ),
        own("phase", since, lambda s: (s.time % sensors.period) / sensors.period),
    )


AnyState = TypeVar("AnyState", bound=Any)


class MarkovJumpFamily(System[AnyState]):
    """The common part of the systems of the Markov jump plant."""

    plant: MarkovJumpPlant
    sensors: FadingSensors
    model: AugmentedModel

    @staticmethod
    def _common_fields(
        plant: MarkovJumpPlant,
        sensors: FadingSensors,
        state_names: tuple[str, ...],
        state_weights: Array | None,
        horizon: int,
        nature: Nature,
    ) -> dict[str, Any]:
        """Return the common fields; weights of ``None`` set the open-loop cost to one."""
        model = AugmentedModel.create(plant, sensors)
        reference, magnitude = model.scales(horizon)
        equal = equal_weights(reference)
        return {
            "plant": plant,
            "sensors": sensors,
            "model": model,
            "state_names": state_names,
            "state_weights": equal if state_weights is None else state_weights,
            "magnitude": magnitude,
            "reference": reference,
            "nature": nature,
        }

    @property
    def sensor_count(self) -> int:
        """Number of sensors."""
        return self.sensors.count

    @property
    def noise_channels(self) -> int:
        """Normals of one step: process noise, mode, sensors."""
        return self.plant.noise_channels + 1 + self.sensors.noise_channels

    @property
    def start_channels(self) -> int:
        """Normals of a start: state, mode, first process noise, nature's."""
        return self.plant.size + 1 + self.plant.noise_channels + self.nature.channels

    def _start(self, noise: Array) -> tuple[Array, Modes, Array, Array | None]:
        """Return truth (n, N), mode (N,) and process noise (r, N) of time 0, and the departure."""
        noise, departure = self.nature.begin(noise)
        first = self.plant.size + 1
        truth, mode = self.plant.start(noise[:first])
        process = true_noise(departure, noise[first:], noise[:0])[0]
        return truth, mode, self.plant.process_noise(process), departure

    def _move(self, state: AnyState, noise: Array) -> Motion:
        """Move the plant, and measure with all sensors.

        ``noise`` (channels, N) holds the normals of process noise, mode and sensors. The state's
        process noise is the actual one.

        Source: markov_jump, equations (3), (4).
        """
        plant, sensors, moving = self.plant, self.sensors, self.plant.noise_channels
        fading, own = np.split(noise[moving + 1 :], (sensors.count,))
        process, own = true_noise(state.departure, noise[:moving], own)
        following = plant.advance(state.truth, state.mode, state.process_noise, state.departure)
        jumped = plant.jump(state.mode, noise[moving])
        drawn = plant.process_noise(process)
        measurement = sensors.measure(following, jumped, drawn, np.concatenate((fading, own)))
        return Motion(following, jumped, drawn, measurement)

    def visible(self, state: AnyState) -> AnyState:
        """Return the state without the truth, the mode and the noise that moves the plant next."""
        return replace(
            state,
            truth=np.full_like(state.truth, np.nan),
            mode=np.zeros_like(state.mode),
            process_noise=np.full_like(state.process_noise, np.nan),
            departure=None,
        )

    @property
    def imagination_channels(self) -> int:
        """Normals of truth, mode and process noise."""
        return self.plant.size + 1 + self.plant.noise_channels

    def imagine(self, state: AnyState, mean: Array, covariance: Array, noise: Array) -> AnyState:
        """Draw the truth from N(mean, covariance), the mode and the process noise from their laws.

        The draws of mode and process noise do not use the measurements.
        """
        plant, n = self.plant, self.plant.size
        law = np.empty((plant.modes, len(state.time)))
        for time in np.unique(state.time):
            moved = np.linalg.matrix_power(plant.mode_transition, int(time))
            law[:, state.time == time] = (plant.initial_probabilities @ moved)[:, None]
        return replace(
            state,
            truth=linalg.draw_normal(mean, covariance, noise[:n]),
            mode=draw_mode(np.cumsum(law, 0)[:-1], noise[n]),
            process_noise=plant.process_noise(noise[n + 1 :]),
            departure=None,
        )

    def open_loop(self, horizon: int) -> Array:
        """Return the mean error variance (n,) over t = 1..horizon without any delivery."""
        return self.model.open_loop(horizon)
