"""Independent vector sources, each with a sensor whose steady Kalman filter sends its estimate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.estimator import Estimator, Reception, SignalValues
from fusion_gym.core.knowledge import Block, common_signals
from fusion_gym.core.plant import Nature, true_motion, true_noise
from fusion_gym.errors import forbidden
from fusion_gym.namespace import namespace
from fusion_gym.systems.bases import Deliveries, NormalPlant, Truth, numbered_states
from fusion_gym.systems.remote.system import error_blocks
from fusion_gym.systems.solvable import AgedSources

KEYS = ("transition", "process_covariance", "measurement_matrix", "measurement_covariance")
_FLOOR = 1e-12  # of a deviation, in process deviations: zero could not divide
_GROWING, _DECAYING = (1.0, 1.05), (0.5, 0.95)  # ranges of the eigenvalues of drawn sources


@dataclass(frozen=True)
class Source:
    """A plant x' = A x + w, w ~ N(0, W), and a sensor y = C x + v, v ~ N(0, R)."""

    transition: Array
    process_covariance: Array
    measurement_matrix: Array
    measurement_covariance: Array

    @classmethod
    def create(cls, field: str, value: Any) -> Source:
        """Return a checked source of a mapping with the ``KEYS``."""
        if not isinstance(value, Mapping) or set(value) != set(KEYS):
            raise validation.refusal(field, value, f"a mapping with the keys {', '.join(KEYS)}")
        names = {key: f"{field}[{key!r}]" for key in KEYS}
        transition = validation.array(names[KEYS[0]], value[KEYS[0]], (None, None))
        size = len(transition)
        if transition.shape[1] != size:
            raise validation.refusal(names[KEYS[0]], value[KEYS[0]], "a square matrix")
        rows = np.atleast_2d(np.asarray(value[KEYS[2]], dtype=object))
        matrix = validation.array(names[KEYS[2]], rows.tolist(), (None, size))
        noise = np.atleast_2d(np.asarray(value[KEYS[3]], dtype=object)).tolist()
        return cls(
            transition,
            validation.covariance(names[KEYS[1]], value[KEYS[1]], size),
            matrix,
            validation.covariance(names[KEYS[3]], noise, len(matrix), definite=True),
        )

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Source:
        """Draw a source of two states, a growing and a decaying one, that one channel measures."""
        values = np.diag([rng.uniform(*_GROWING), rng.uniform(*_DECAYING)])
        angles = rng.uniform(0.2, 1.3, 2)
        basis = np.array([np.cos(angles), np.sin(angles) * (1.0, -1.0)])
        transition = basis @ values @ np.linalg.inv(basis)
        row = rng.uniform(0.5, 1.0, (1, 2)) @ np.linalg.inv(basis)  # measures both eigenvectors
        return cls(transition, np.eye(2), row, np.eye(1))

    def steady(self, field: str) -> tuple[Array, Array]:
        """Return gain (n, m) and posterior covariance (n, n) of the steady Kalman filter."""
        a, w, c, r = (getattr(self, key) for key in KEYS)
        try:
            prior = scipy.linalg.solve_discrete_are(a.T, c.T, w, r)
        except (np.linalg.LinAlgError, ValueError) as error:
            reason = "its sensor must measure every growing state, and noise must move every other"
            raise forbidden(field, a, reason) from error
        posterior = prior
        for _ in range(5):  # Riccati steps, which polish the solution
            gain = np.linalg.solve(c @ prior @ c.T + r, c @ prior).T
            rest = np.eye(len(a)) - gain @ c
            posterior = rest @ prior @ rest.T + gain @ r @ gain.T
            prior = a @ posterior @ a.T + w
        return gain, posterior


def make_sources(value: Any) -> list[Source]:
    """Return the sources of a list of mappings, or of a pair (count, seed) that draws them."""
    pair = isinstance(value, (list, tuple)) and len(value) == 2 and np.ndim(value[0]) == 0
    if pair and not any(isinstance(item, Mapping) for item in value):
        most = validation.MOST_SENSORS
        count = validation.integer("sources", value[0], at_least=1, at_most=most)
        rng = np.random.default_rng(validation.integer("sources", value[1], at_least=0))
        return [Source.draw(rng) for _ in range(count)]
    if not isinstance(value, (list, tuple)) or not value:
        raise validation.refusal("sources", value, "a list of mappings, or a pair (count, seed)")
    return [Source.create(f"sources[{place}]", item) for place, item in enumerate(value)]


def _padded(blocks: Sequence[NDArray[Any]]) -> Array:
    """Return matrices as one array (l, rows, columns, 1), zero where a matrix is smaller."""
    shape = np.max([block.shape for block in blocks], axis=0)
    result = np.zeros((len(blocks), *shape, 1))
    for target, block in zip(result, blocks, strict=True):
        target[: block.shape[0], : block.shape[1], 0] = block
    return result


@dataclass(frozen=True)
class VectorSources(NormalPlant, AgedSources[Truth]):
    """l independent sources with s states and m channels at most; x(0) ~ N(0, P̄).

    Shapes: ``transition`` (l, s, s, 1), ``process_factor`` (l, s, s, 1), ``measurement_matrix``
    (l, m, s, 1), ``noise_factor`` (l, m, m, 1), the steady filters' ``gain`` (l, s, m, 1) and
    ``posterior`` P̄ (l, s, s, 1), zero beyond a source's own size. ``places`` (l, s) are the states'
    numbers, n beyond. ``input_matrix`` is B (n, k, 1) of a controller's input.
    """

    state_names: tuple[str, ...]
    transition: Array
    process_factor: Array
    measurement_matrix: Array
    noise_factor: Array
    gain: Array
    posterior: Array
    places: NDArray[np.int64]
    nature: Nature
    input_matrix: Array | None = None
    traceable = True

    @classmethod
    def create(cls, sources: Sequence[Source], options: Any, horizon: int) -> VectorSources:
        """Return the plant of these sources, with the departure of the options."""
        filters = [source.steady(f"sources[{place}]") for place, source in enumerate(sources)]
        sizes = [len(source.transition) for source in sources]
        places = np.full((len(sources), max(sizes)), sum(sizes))
        for row, size, end in zip(places, sizes, np.cumsum(sizes), strict=True):
            row[:size] = np.arange(end - size, end)
        nature = Nature.create(options, ("true_threshold_shift",))
        whole = scipy.linalg.block_diag(*(source.transition for source in sources))

        def radius(factor: float) -> float:
            still = np.eye(len(whole))
            return float(np.abs(np.linalg.eigvals(still + factor * (whole - still))).max())

        nature.check_growth(radius, horizon)
        return cls(
            numbered_states(sum(sizes)),
            _padded([source.transition for source in sources]),
            _padded([linalg.root(s.process_covariance[..., None])[..., 0] for s in sources]),
            _padded([source.measurement_matrix for source in sources]),
            _padded([np.linalg.cholesky(source.measurement_covariance) for source in sources]),
            _padded([gain for gain, _ in filters]),
            _padded([posterior for _, posterior in filters]),
            places,
            nature,
        )

    @property
    def sensor_count(self) -> int:
        """Number of sensors, one per source."""
        return len(self.transition)

    @property
    def noise_channels(self) -> int:
        """Normals of one step: process noises, then measurement noises."""
        return self.sensor_count * sum(self.measurement_matrix.shape[1:3])

    @property
    def start_channels(self) -> int:
        """Normals of a start: x(0), nature's."""
        return self.places.size + self.nature.channels

    def start(self, noise: Array) -> tuple[Truth, None]:
        """Draw x(0); no measurement is taken."""
        noise, departure = self.nature.begin(noise)
        count, runs, xp = self.sensor_count, noise.shape[-1], namespace(noise)
        drawn = linalg.matvec(linalg.root(self.posterior), noise.reshape(count, -1, runs))
        nothing = xp.zeros((count, self.measurement_matrix.shape[1], runs))
        return Truth(self.flat(drawn), nothing, departure, np.zeros(runs)), None

    def sense(self, state: Truth, noise: Array, control: Array | None = None) -> Truth:
        """Move the sources, and measure."""
        count, channels, size, _ = self.measurement_matrix.shape
        split, runs = count * size, noise.shape[-1]
        moving = noise[:split].reshape(count, size, runs)
        measured = noise[split:].reshape(count, channels, runs)
        process, own = true_noise(state.departure, moving, measured)
        before = self.blocks(state.truth)
        moved = true_motion(state.departure, before, linalg.matvec(self.transition, before))
        truth = self.steer(moved, control) + linalg.matvec(self.process_factor, process)
        seen = linalg.matvec(self.measurement_matrix, truth)
        measurement = seen + linalg.matvec(self.noise_factor, own)
        return Truth(self.flat(truth), measurement, state.departure, state.time + 1.0)

    def steer(self, moved: Array, control: Array | None) -> Array:
        """Return states (l, s, N) with the effect of an input."""
        if control is None or self.input_matrix is None:
            return moved
        return moved + self.blocks(linalg.matvec(self.input_matrix, control))

    def blocks(self, values: Array) -> Array:
        """Return values (n, N) of the states by source (l, s, N)."""
        xp = namespace(values)
        return xp.concatenate((values, xp.zeros_like(values[:1])))[self.places]

    def flat(self, values: Array) -> Array:
        """Return values (l, s, N) as values (n, N) of the states."""
        present = np.flatnonzero(self.places < len(self.state_names))
        return values.reshape(-1, values.shape[-1])[present]

    def whole(self, blocks: Array) -> Array:
        """Return covariances (l, s, s, N) as one covariance (n, n, N)."""
        count, size, _, runs = blocks.shape
        same = np.eye(count, dtype=np.bool_)[:, None, :, None, None]
        spread = namespace(blocks).where(same, blocks[:, :, None], 0.0)
        present = np.flatnonzero(self.places < len(self.state_names))
        return spread.reshape(count * size, count * size, runs)[present][:, present]

    def predict_covariance(self, covariance: Array) -> Array:
        """Return A P Aᵀ + W of covariances P (l, s, s, N)."""
        moved = linalg.matmul(self.transition, covariance)
        moved = linalg.matmul(moved, linalg.transpose(self.transition))
        return moved + linalg.gram(self.process_factor)

    def age_costs(self, weights: Array, ages: int) -> Array:
        """Return the weighted traces (ages, l) of the sources' covariances at the ages 0, 1, …."""
        own, covariance, costs = self.blocks(weights)[..., 0], self.posterior, []
        for _ in range(ages):
            costs.append((own * linalg.diagonal(covariance)[..., 0]).sum(1))
            covariance = self.predict_covariance(covariance)
        return np.array(costs)

    @property
    def radii(self) -> Array:
        """Spectral radius (l,) of each source."""
        return np.array([np.abs(np.linalg.eigvals(a)).max() for a in self.transition[..., 0]])

    def open_loop(self, horizon: int) -> Array:
        """Return the mean error variance (n,) over t = 1..horizon without a delivery."""
        covariance, total = self.posterior, np.zeros(len(self.state_names))
        for _ in range(horizon):
            covariance = self.predict_covariance(covariance)
            total = total + self.flat(linalg.diagonal(covariance))[:, 0]
        return total / horizon

    def rounding(self, horizon: int) -> tuple[float, float]:
        """See :class:`Plant`; the mean of x is 0, so its variance grows as an open loop's."""
        variance = horizon * self.blocks(self.open_loop(horizon)[:, None])
        noise = linalg.diagonal(linalg.gram(self.noise_factor))
        seen = linalg.matvec(self.measurement_matrix**2, variance)
        return float((seen / np.where(noise > 0.0, noise, np.inf)).max()), 0.0


@dataclass(slots=True)
class VectorEstimate(Deliveries):
    """The estimates of N runs at one time; l sources with s states at most.

    ``held`` (l, s, N), the last delivered estimates · ``node_mean`` (l, s, N), of the local filters
    · ``prior`` and ``mean`` (l, s, N) of the centre, ``prior_blocks`` and ``blocks`` (l, s, s, N),
    their covariances by age.
    """

    node_mean: Array
    prior: Array
    mean: Array
    prior_blocks: Array
    blocks: Array


VECTOR_SIGNALS = common_signals(
    "(sensors, s, N)",
    measurement="the node's new estimate",
    innovation="the node's new estimate minus the centre's prediction",
    held="the last delivered estimate",
    expected_measurement="the centre's prediction of the source",
    innovation_deviation="standard deviation of the innovation by age",
    prior_covariance="covariance of the prediction by age",
)


@dataclass(frozen=True)
class VectorEstimator(Estimator[VectorEstimate]):
    r"""Steady Kalman filters at the sensors, which send their estimates to the centre.

    ``error_scale`` (l, s) divides observed differences, ``state_weights`` (n,) weigh the traces.

    Equation:
        $$
        \text{node:}\quad \hat z^{+}=A\hat z+K(y-CA\hat z),\qquad
        \text{delivered:}\quad \hat x^{+}=\hat z^{+},\ P^{+}=\bar P,\qquad
        \text{silent:}\quad \hat x^{+}=A\hat x,\ P^{+}=A P A^{\mathsf T}+W
        $$

        P̄ is the steady posterior covariance of the node, K its gain.

    Assumes: Gaussian noises, independent sources, and a rule that depends on no measurement.

    Source: A. S. Leong, A. Ramaswamy, D. E. Quevedo, H. Karl and L. Shi, "Deep reinforcement
    learning for wireless sensor scheduling in cyber-physical systems", Automatica 113, 2020,
    Section 2.
    """

    model: VectorSources
    error_scale: Array
    state_weights: Array
    signals = VECTOR_SIGNALS
    traceable = True
    independent_nodes = True
    covariance_cycle = 1

    @property
    def observation(self) -> tuple[Block, ...]:
        """Blocks of the observation."""
        return error_blocks("node's estimate", lambda s: s.node_mean - s.prior, self.error_scale)

    def start(self, measurement: Array, announcement: None) -> VectorEstimate:
        """Return estimates 0 with the nodes' steady covariance."""
        runs, xp = measurement.shape[-1], namespace(measurement)
        nothing = xp.zeros((*self.error_scale.shape, runs))
        shape = (*nothing.shape[:2], *nothing.shape[1:])
        blocks = xp.array(np.broadcast_to(self.model.posterior, shape))
        age = xp.zeros((len(nothing), runs))
        return VectorEstimate(measurement, nothing, age, nothing, nothing, nothing, blocks, blocks)

    def predict(self, state: VectorEstimate, control: Array | None = None) -> VectorEstimate:
        """Predict at the nodes and at the centre."""
        transition, steer = self.model.transition, self.model.steer
        return state.later(
            node_mean=steer(linalg.matvec(transition, state.node_mean), control),
            prior=steer(linalg.matvec(transition, state.mean), control),
            prior_blocks=self.model.predict_covariance(state.blocks),
        )

    def observe(self, state: VectorEstimate, measurement: Array) -> VectorEstimate:
        """Update the nodes with their own measurements."""
        innovation = measurement - linalg.matvec(self.model.measurement_matrix, state.node_mean)
        mean = state.node_mean + linalg.matvec(self.model.gain, innovation)
        return replace(state, measurement=measurement, node_mean=mean)

    def update(self, state: VectorEstimate, reception: Reception) -> VectorEstimate:
        """Replace the centre's prediction by the estimates that arrive."""
        arrived, xp = reception.arrived, namespace(reception.arrived, state.prior)
        grant = arrived[:, None]
        return state.after(
            arrived,
            state.node_mean,
            mean=xp.where(grant, state.node_mean, state.prior),
            blocks=xp.where(grant[:, None], self.model.posterior, state.prior_blocks),
        )

    def read(self, state: VectorEstimate, failure: Array | None = None) -> SignalValues:
        """Return the signals of ``VECTOR_SIGNALS``."""
        weights = self.model.blocks(self.state_weights[:, None])

        def traces(blocks: Array) -> Array:
            return linalg.total(weights * linalg.diagonal(blocks), 1)

        def deviation() -> Array:
            least = (_FLOOR * linalg.diagonal(linalg.gram(self.model.process_factor))) + _FLOOR**2
            variance = linalg.diagonal(state.prior_blocks - self.model.posterior)
            xp = namespace(variance)
            return xp.sqrt(xp.maximum(variance, least))

        return {
            **super().read(state, failure),
            "measurement": state.node_mean,
            "innovation": lambda: state.node_mean - state.prior,
            "expected_measurement": state.prior,
            "innovation_deviation": deviation,
            "prior_mean": lambda: self.model.flat(state.prior),
            "prior_covariance": lambda: self.model.whole(state.prior_blocks),
            "silent_variance": lambda: linalg.total(traces(state.prior_blocks)),
            "variance_reduction": lambda: traces(state.prior_blocks - self.model.posterior),
        }

    def mean(self, state: VectorEstimate) -> Array:
        """Return the centre's mean (n, N)."""
        return self.model.flat(state.mean)

    def covariance(self, state: VectorEstimate) -> Array:
        """Return the centre's covariance by age (n, n, N)."""
        return self.model.whole(state.blocks)

    def local_means(self, state: VectorEstimate) -> Array:
        """Return the nodes' means (sensors, n, N), the centre's for the sources of others."""
        own = np.eye(len(state.mean), dtype=np.bool_)[..., None, None]
        each = np.where(own, state.node_mean, state.mean)
        return np.stack([self.model.flat(means) for means in each])


def vector_scale(model: VectorSources, steps: int) -> Array:
    """Return the deviation (l, s) of the node's estimate minus the centre's after silent steps."""
    covariance = model.posterior
    for _ in range(steps):
        covariance = model.predict_covariance(covariance)
    variance = linalg.diagonal(covariance - model.posterior)[..., 0]
    return np.sqrt(np.where(variance > 0.0, variance, 1.0))
