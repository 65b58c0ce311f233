"""Scalar sources, each with a noise-free sensor, over a channel that may lose packets.

Source: J. Chakravorty and A. Mahajan, "Remote estimation over a packet-drop channel with Markovian
state", IEEE Trans. Automatic Control 65, 2020 (arXiv 1807.09706).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.core.channel import STATES, Channel
from fusion_gym.core.nature import AS_ASSUMED, Nature, true_motion, true_noise
from fusion_gym.core.system import (
    Block,
    Signal,
    SignalArray,
    System,
    age_block,
    common_signals,
    numbered,
)
from fusion_gym.namespace import namespace
from fusion_gym.systems.silence import Silence

_RANGE = 5.0  # scaled errors are clipped here
_FLOOR = 1e-12  # variance after a delivery, in process variances: zero could not be inverted


@dataclass(slots=True)
class RemoteEstimationState:
    """The state of N runs at one time; n sources, one sensor each.

    ``truth`` x and ``prior`` a x̂(t-1) (n, N) · ``estimate`` x̂ (n, N), after the delivery ·
    ``prior_variance`` and ``variance`` (n, N), of the errors by age · ``held`` (n, N), the last
    delivered value · ``age`` (n, N), steps since then · ``channel`` (n, N), the state S(t-1) that
    was fed back · ``next_channel`` (n, N), S(t) · ``lost`` (n, N) bool, the loss of a packet sent
    now · ``departure`` (4, N) of the truth from the model, if any · ``possible`` (n, N) bool, the
    sensors that the network would have granted.
    """

    truth: Array
    prior: Array
    estimate: Array
    prior_variance: Array
    variance: Array
    held: Array
    age: Array
    channel: NDArray[np.int64]
    next_channel: NDArray[np.int64]
    lost: NDArray[np.bool_]
    departure: Array | None = None
    possible: NDArray[np.bool_] | None = None


SIGNALS = (
    *common_signals(
        "(sensors, 1, N)",
        measurement="the source's value",
        innovation="error without a delivery: value minus prediction",
        innovation_deviation="standard deviation of the innovation by age",
        prior_covariance="covariance of the prediction by age",
        variance_reduction="expected reduction of this trace by this sensor's packet",
    ),
    Signal(
        "channel_state",
        "centre",
        "(sensors, N)",
        "state of the channel at the step before: 0 bad, 1 good",
    ),
)


@dataclass(frozen=True)
class RemoteEstimationSystem(System[RemoteEstimationState]):
    r"""n independent sources x(t+1) = a x(t) + w(t), w ~ N(0, σ²), and the optimal estimator.

    x̂ = x on a delivery and a x̂ otherwise, which is optimal under every rule that is symmetric in
    the error. Silence then carries no information on the error's sign; the variances by age ignore
    its information on the error's size. With ``silence`` both use it. The centre feeds back the
    channel's state and the arrival of a packet, so that the sensor knows x̂.

    Shapes: ``coefficient`` a, ``deviation`` σ, ``initial_deviation`` of x(0), ``error_scale`` that
    divides observed errors, and ``state_weights``: (n,). Where the truth departs by ``nature``, a
    source moves by c a, because I + c (a - I) would not change a random walk.

    Equation:
        $$
        \text{delivered:}\quad \hat x^{+}=x,\quad P^{+}=0,\qquad
        \text{silent:}\quad \hat x^{+}=a\,\hat x,\quad P^{+}=a^2P+\sigma^2
        $$

    Assumes: Gaussian noise, exact measurements, and a rule that is symmetric in the error.

    Source: J. Chakravorty and A. Mahajan, "Remote estimation over a packet-drop channel with
    Markovian state", IEEE Trans. Automatic Control 65, 2020.
    """

    state_names: tuple[str, ...]
    coefficient: Array
    deviation: Array
    initial_deviation: Array
    channel: Channel
    error_scale: Array
    state_weights: Array
    nature: Nature = AS_ASSUMED
    silence: Silence | None = None
    signals = SIGNALS

    @property
    def numpy_only(self) -> str | None:
        """See :class:`System`."""
        return None if self.silence is None else "filter"

    @property
    def sensor_count(self) -> int:
        """Number of sensors, one per source."""
        return len(self.coefficient)

    @property
    def noise_channels(self) -> int:
        """Normals of one step: sources, channel states and losses."""
        extra = (self.channel.states > 1) + self.channel.loses
        return self.sensor_count * (1 + extra)

    @property
    def start_channels(self) -> int:
        """Normals of a start: x(0), the channel's state, nature's."""
        return self.sensor_count * (1 + (self.channel.states > 1)) + self.nature.channels

    def offers(self, capability: str) -> bool:
        """See :class:`System`; without losses every packet arrives."""
        if capability == "arrival_probability":
            return self.channel.loses
        if capability == "with_possible":
            return self.silence is not None
        return super().offers(capability)

    def with_possible(
        self, state: RemoteEstimationState, possible: NDArray[np.bool_]
    ) -> RemoteEstimationState:
        """See :class:`System`."""
        return replace(state, possible=possible)

    @property
    def observation(self) -> tuple[Block, ...]:
        """Blocks of the observation, without the channel's where it has no states."""
        nodes = numbered(self.sensor_count)
        error = Block(
            "error",
            "value minus the centre's prediction, over ``error_scale``",
            lambda s: (s.truth - s.prior) / self.error_scale[:, None],
            (nodes,),
            "own",
            "own",
            _RANGE,
            {"error_scale": self.error_scale},
        )
        channel = Block(
            "channel",
            "state of the channel at the step before, one-hot",
            lambda s: s.channel[:, None] == np.arange(len(STATES))[:, None],
            (nodes, STATES),
            node="own",
        )
        return (error, age_block(nodes), *((channel,) if self.channel.states > 1 else ()))

    def start(self, noise: Array) -> RemoteEstimationState:
        """Draw x(0) with the mean 0, which is also the centre's estimate."""
        sensors, runs = self.sensor_count, noise.shape[-1]
        noise, departure = self.nature.begin(noise)
        truth = self.initial_deviation[:, None] * noise[:sensors]
        nothing = np.zeros((sensors, runs))
        variance = np.repeat(self.initial_deviation[:, None] ** 2, runs, axis=1)
        known = np.zeros((sensors, runs), dtype=np.int64)
        if self.channel.states > 1:
            known = self.channel.start(noise[sensors:])
        return RemoteEstimationState(
            truth=truth,
            prior=nothing,
            estimate=nothing,
            prior_variance=variance,
            variance=variance,
            held=nothing,
            age=nothing,
            channel=known,
            next_channel=known,
            lost=np.zeros((sensors, runs), dtype=np.bool_),
            departure=departure,
        )

    def sense(self, state: RemoteEstimationState, noise: Array) -> RemoteEstimationState:
        """Move the sources and the channels, and predict."""
        sensors = self.sensor_count
        a, sigma = self.coefficient[:, None], self.deviation[:, None]
        following, lost = self._coming(state.next_channel, noise[sensors:])
        moved = true_motion(state.departure, np.zeros(1), a * state.truth)
        drawn = true_noise(state.departure, noise[:sensors], noise[:0])[0]
        return replace(
            state,
            truth=moved + sigma * drawn,
            prior=a * state.estimate,
            prior_variance=a * a * state.variance + sigma * sigma,
            age=state.age + 1.0,
            channel=state.next_channel,
            next_channel=following,
            lost=lost,
        )

    def deliver(
        self, state: RemoteEstimationState, granted: NDArray[np.bool_]
    ) -> RemoteEstimationState:
        """Replace the centre's prediction where a granted packet arrives."""
        xp, arrived = namespace(granted, state.lost), granted & ~state.lost
        floor = _FLOOR * self.deviation[:, None] ** 2
        estimate, variance = self._silent(state)
        return replace(
            state,
            estimate=xp.where(arrived, state.truth, estimate),
            variance=xp.where(arrived, floor, variance),
            held=xp.where(arrived, state.truth, state.held),
            age=xp.where(arrived, 0.0, state.age),
            possible=None,
        )

    def _silent(self, state: RemoteEstimationState) -> tuple[Array, Array]:
        """Return estimate and variance (n, N) without a delivery."""
        if self.silence is None:
            return state.prior, state.prior_variance
        failure = 1.0 - self._arrival_probability(state.channel)
        if state.possible is not None:
            failure = np.where(state.possible, failure, 1.0)
        deviation = np.sqrt(np.maximum(state.prior_variance, _FLOOR * self.deviation[:, None] ** 2))
        shift = self.silence.middle(state.held, state.prior) - state.prior
        mean, variance = self.silence.moments(self.silence.threshold, shift, deviation, failure)
        return state.prior + deviation * mean, deviation**2 * variance

    def read(
        self, state: RemoteEstimationState
    ) -> Mapping[str, SignalArray | Callable[[], SignalArray]]:
        """Return the signals of ``SIGNALS``."""
        return {
            "measurement": state.truth[:, None],
            "innovation": lambda: (state.truth - state.prior)[:, None],
            "held": state.held[:, None],
            "age": state.age,
            "expected_measurement": state.prior[:, None],
            "innovation_deviation": lambda: namespace(state.prior_variance).sqrt(
                state.prior_variance
            )[:, None],
            "channel_state": state.channel,
            "prior_mean": state.prior,
            "prior_covariance": lambda: _diagonal(state.prior_variance),
            "silent_variance": lambda: linalg.total(self._weighted(self._silent(state)[1])),
            "variance_reduction": lambda: (
                self._weighted(self._silent(state)[1]) * self._arrival_probability(state.channel)
            ),
        }

    def visible(self, state: RemoteEstimationState) -> RemoteEstimationState:
        """Return the state without departure and coming losses; the sensors measure the sources."""
        lost = np.zeros_like(state.lost)
        return replace(state, next_channel=state.channel, lost=lost, departure=None)

    @property
    def imagination_channels(self) -> int:
        """Normals of the channel in one step."""
        return self.noise_channels - self.sensor_count

    def imagine(
        self, state: RemoteEstimationState, mean: Array, covariance: Array, noise: Array
    ) -> RemoteEstimationState:
        """Draw the channel's coming state and losses from the state that was fed back."""
        following, lost = self._coming(state.channel, noise)
        return replace(state, next_channel=following, lost=lost, departure=None)

    def arrival_probability(self, state: RemoteEstimationState) -> Array:
        """Return the probability (sensors, N) of an arrival, given the channel's last state."""
        return self._arrival_probability(state.channel)

    def arriving(
        self, state: RemoteEstimationState, packets: NDArray[np.bool_]
    ) -> RemoteEstimationState:
        """Return the state in which these packets (sensors, N) are not lost."""
        return replace(state, lost=state.lost & ~packets)

    def fused(self, state: RemoteEstimationState) -> tuple[Array, Array]:
        """Return the centre's mean (n, N) and covariance by age (n, n, N).

        After a delivery the error is zero; its variance is set to 1e-12 σ².
        """
        return state.estimate, _diagonal(state.variance)

    def fused_mean(self, state: RemoteEstimationState) -> Array:
        """Return the centre's mean (n, N)."""
        return state.estimate

    def local_means(self, state: RemoteEstimationState) -> Array:
        """Return the nodes' means (sensors, n, N): the own source, and x̂ of the others."""
        own = np.eye(self.sensor_count, dtype=np.bool_)[..., None]
        return np.where(own, state.truth, state.estimate)

    def open_loop(self, horizon: int) -> Array:
        """Return the mean error variance (n,) over t = 1..horizon without a delivery."""
        variance, total = self.initial_deviation**2, np.zeros(self.sensor_count)
        for _ in range(horizon):
            variance = self.coefficient**2 * variance + self.deviation**2
            total = total + variance
        return total / horizon

    def rounding(self, horizon: int) -> tuple[float, float]:
        """See :class:`System`; 1e-6 of a source's noise deviation may be lost."""
        largest = horizon * self.open_loop(horizon) / self.deviation**2
        return 1e-8 * float(largest.max()), 0.0

    def _coming(
        self, channel: NDArray[np.int64], noise: Array
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the channel's next state and loss from its last state (sensors, N)."""
        sensors = self.sensor_count
        following, lost = channel, np.zeros(channel.shape, dtype=np.bool_)
        if self.channel.states > 1:
            following = self.channel.advance(channel, noise[:sensors])
        if self.channel.loses:
            lost = self.channel.lost(following, noise[-sensors:])
        return following, lost

    def _weighted(self, variance: Array) -> Array:
        return self.state_weights[:, None] * variance

    def _arrival_probability(self, channel: NDArray[np.int64]) -> Array:
        """Probability (sensors, N) that a packet arrives, given the state before."""
        sensor = np.arange(self.sensor_count)[:, None]
        loss = namespace(channel).asarray(self.channel.transition @ self.channel.drop)
        return 1.0 - loss[channel, sensor]


def _diagonal(variance: Array) -> Array:
    """Covariances (n, n, N) of independent errors with variances (n, N)."""
    return variance[None] if len(variance) == 1 else linalg.identity(len(variance)) * variance
