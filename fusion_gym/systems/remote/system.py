"""Scalar sources, each with a noise-free sensor, and their optimal estimator.

Source: J. Chakravorty and A. Mahajan, "Remote estimation over a packet-drop channel with Markovian
state", IEEE Trans. Automatic Control 65, 2020 (arXiv 1807.09706).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.core.estimator import Estimator, Reception, SignalValues
from fusion_gym.core.knowledge import Block, age_block, common_signals, numbered
from fusion_gym.core.plant import AS_ASSUMED, Nature, true_motion, true_noise
from fusion_gym.namespace import namespace
from fusion_gym.systems.bases import RANGE, Deliveries
from fusion_gym.systems.linear_plant import steer
from fusion_gym.systems.silence import Silence
from fusion_gym.systems.solvable import IndependentSources

_FLOOR = 1e-12  # variance after a delivery, in process variances: zero could not be inverted


@dataclass(slots=True)
class SourceTruth:
    """The values ``truth`` (n, N) of n sources, one sensor each, in N runs.

    ``departure`` (4, N) of the truth from the model, if any.
    """

    truth: Array
    departure: Array | None = None


@dataclass(frozen=True)
class ScalarSources(IndependentSources[SourceTruth]):
    """n independent sources x(t+1) = a x(t) + w(t), w ~ N(0, σ²), measured without noise.

    ``input_matrix`` is B (n, k, 1) of a controller's input.

    Where the truth departs by ``nature``, a source moves by c a, because I + c (a - I) would not
    change a random walk.
    """

    nature: Nature = AS_ASSUMED
    input_matrix: Array | None = None
    traceable = True

    @property
    def sensor_count(self) -> int:
        """Number of sensors, one per source."""
        return len(self.coefficient)

    @property
    def noise_channels(self) -> int:
        """Normals of one step, one per source."""
        return len(self.coefficient)

    @property
    def start_channels(self) -> int:
        """Normals of a start: x(0), nature's."""
        return len(self.coefficient) + self.nature.channels

    def start(self, noise: Array) -> tuple[SourceTruth, None]:
        """Draw x(0) with the mean 0."""
        noise, departure = self.nature.begin(noise)
        return SourceTruth(self.initial_deviation[:, None] * noise, departure), None

    def sense(self, state: SourceTruth, noise: Array, control: Array | None = None) -> SourceTruth:
        """Move the sources."""
        a, sigma = self.coefficient[:, None], self.deviation[:, None]
        moved = true_motion(state.departure, np.zeros(1), a * state.truth)
        drawn = true_noise(state.departure, noise, noise[:0])[0]
        moved = steer(moved, self.input_matrix, control)
        return SourceTruth(moved + sigma * drawn, state.departure)

    def measurement(self, state: SourceTruth) -> Array:
        """Return the values (n, 1, N)."""
        return state.truth[:, None]

    @property
    def draw_channels(self) -> int:
        """No normals: the sensors measure the sources."""
        return 0

    def draw(
        self, measurement: Array, mean: Array, covariance: Array, noise: Array, time: Array
    ) -> SourceTruth:
        """Return the measured values."""
        return SourceTruth(measurement[:, 0])

    def open_loop(self, horizon: int) -> Array:
        """Return the mean error variance (n,) over t = 1..horizon without a delivery."""
        variance, total = self.initial_deviation**2, np.zeros(self.sensor_count)
        for _ in range(horizon):
            variance = self.coefficient**2 * variance + self.deviation**2
            total = total + variance
        return total / horizon

    def rounding(self, horizon: int) -> tuple[float, float]:
        """See :class:`Plant`; 1e-6 of a source's noise deviation may be lost."""
        largest = horizon * self.open_loop(horizon) / self.deviation**2
        return 1e-8 * float(largest.max()), 0.0


@dataclass(slots=True)
class RemoteEstimate(Deliveries):
    """The estimate of N runs at one time; n sources, one sensor each.

    ``held`` (n, N), the last delivered value · ``prior`` a x̂(t-1) and ``mean`` x̂ (n, N), after the
    delivery · ``prior_variance`` and ``variance`` (n, N), of the errors by age.
    """

    prior: Array
    mean: Array
    prior_variance: Array
    variance: Array


def error_blocks(whose: str, error: Callable[[Any], Array], scale: Array) -> tuple[Block, Block]:
    """Return the blocks of errors (l, …, N) over ``scale`` (l, …), and of the ages."""
    labels, constants = tuple(numbered(size) for size in scale.shape), {"error_scale": scale}
    meaning = f"{whose} minus the centre's prediction, over ``error_scale``"
    own = partial(Block, knowledge="own", node="own", limit=RANGE, constants=constants)
    errors = own("error", meaning, lambda s: error(s) / scale[..., None], labels)
    return errors, age_block(labels[0])


SIGNALS = common_signals(
    "(sensors, 1, N)",
    measurement="the source's value",
    innovation="error without a delivery: value minus prediction",
    innovation_deviation="standard deviation of the innovation by age",
    prior_covariance="covariance of the prediction by age",
    variance_reduction="expected reduction of this trace by this sensor's packet",
)


@dataclass(frozen=True)
class RemoteEstimator(Estimator[RemoteEstimate]):
    r"""The optimal estimator of independent sources x(t+1) = a x(t) + w(t), w ~ N(0, σ²).

    x̂ = x on a delivery and a x̂ otherwise, which is optimal under every rule that is symmetric in
    the error. Silence then carries no information on the error's sign; the variances by age ignore
    its information on the error's size. With ``silence`` both use it. The centre feeds back the
    arrival of a packet, so that the sensor knows x̂.

    ``error_scale`` (n,) divides observed errors, ``state_weights`` (n,) weigh the traces.

    Equation:
        $$
        \text{delivered:}\quad \hat x^{+}=x,\quad P^{+}=0,\qquad
        \text{silent:}\quad \hat x^{+}=a\,\hat x,\quad P^{+}=a^2P+\sigma^2
        $$

    Assumes: Gaussian noise, exact measurements, and a rule that is symmetric in the error.

    Source: J. Chakravorty and A. Mahajan, "Remote estimation over a packet-drop channel with
    Markovian state", IEEE Trans. Automatic Control 65, 2020.
    """

    model: ScalarSources
    error_scale: Array
    state_weights: Array
    silence: Silence | None = None
    signals = SIGNALS

    independent_nodes = True

    @property
    def traceable(self) -> bool:  # type: ignore[override]
        """See :class:`Estimator`."""
        return self.silence is None

    @property
    def reads_silence(self) -> bool:  # type: ignore[override]
        """See :class:`Estimator`."""
        return self.silence is not None

    @property
    def observation(self) -> tuple[Block, ...]:
        """Blocks of the observation."""
        return error_blocks("value", lambda s: s.measurement[:, 0] - s.prior, self.error_scale)

    def start(self, measurement: Array, announcement: None) -> RemoteEstimate:
        """Return the centre's estimate 0."""
        nothing = np.zeros((len(measurement), measurement.shape[-1]))
        variance = np.repeat(self.model.initial_deviation[:, None] ** 2, nothing.shape[-1], axis=1)
        return RemoteEstimate(measurement, nothing, nothing, nothing, nothing, variance, variance)

    def predict(self, state: RemoteEstimate, control: Array | None = None) -> RemoteEstimate:
        """Predict the sources."""
        a, sigma = self.model.coefficient[:, None], self.model.deviation[:, None]
        variance = a * a * state.variance + sigma * sigma
        prior = steer(a * state.mean, self.model.input_matrix, control)
        return state.later(prior=prior, prior_variance=variance)

    def update(self, state: RemoteEstimate, reception: Reception) -> RemoteEstimate:
        """Replace the centre's prediction where a packet arrives."""
        arrived, value = reception.arrived, state.measurement[:, 0]
        xp, floor = namespace(arrived, value), _FLOOR * self.model.deviation[:, None] ** 2
        estimate, variance = self._silent(state, reception.possible, reception.failure)
        return replace(
            state,
            mean=xp.where(arrived, value, estimate),
            variance=xp.where(arrived, floor, variance),
            held=xp.where(arrived, value, state.held),
            age=xp.where(arrived, 0.0, state.age),
        )

    def _silent(
        self, state: RemoteEstimate, possible: Any, failure: Array | None
    ) -> tuple[Array, Array]:
        """Return estimate and variance (n, N) without a delivery."""
        if self.silence is None:
            return state.prior, state.prior_variance
        lost: Any = 0.0 if failure is None else failure
        if possible is not None:
            lost = np.where(possible, lost, 1.0)
        floor = _FLOOR * self.model.deviation[:, None] ** 2
        deviation = np.sqrt(np.maximum(state.prior_variance, floor))
        shift = self.silence.middle(state.held, state.prior) - state.prior
        mean, variance = self.silence.moments(self.silence.threshold, shift, deviation, lost)
        return state.prior + deviation * mean, deviation**2 * variance

    def read(self, state: RemoteEstimate, failure: Array | None = None) -> SignalValues:
        """Return the signals of ``SIGNALS``."""
        weights = self.state_weights[:, None]
        return {
            **super().read(state, failure),
            "innovation": lambda: state.measurement - state.prior[:, None],
            "held": state.held[:, None],
            "expected_measurement": state.prior[:, None],
            "innovation_deviation": lambda: state.prior_variance[:, None] ** 0.5,
            "prior_mean": state.prior,
            "prior_covariance": lambda: _diagonal(state.prior_variance),
            "silent_variance": lambda: linalg.total(
                weights * self._silent(state, None, failure)[1]
            ),
            "variance_reduction": lambda: weights * self._silent(state, None, failure)[1],
        }

    def covariance(self, state: RemoteEstimate) -> Array:
        """Return the centre's covariance by age (n, n, N).

        After a delivery the error is zero; its variance is set to 1e-12 σ².
        """
        return _diagonal(state.variance)

    def local_means(self, state: RemoteEstimate) -> Array:
        """Return the nodes' means (sensors, n, N): the own source, and x̂ of the others."""
        own = np.eye(len(state.mean), dtype=np.bool_)[..., None]
        return np.where(own, state.measurement[:, 0], state.mean)


def _diagonal(variance: Array) -> Array:
    """Covariances (n, n, N) of independent errors with variances (n, N)."""
    return variance[None] if len(variance) == 1 else linalg.identity(len(variance)) * variance
