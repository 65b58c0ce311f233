"""The nodes of an unknown-input system with their fusion centre, behind one interface.

:class:`TableNodes` reads tables that all runs share; :class:`RunNodes` has a covariance for every
node and run. Nodes get no feedback.

Source: unknown_input, equations (8), (24), (25).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.namespace import namespace, take
from fusion_gym.systems.unknown_input.bound_filter import BoundTables
from fusion_gym.systems.unknown_input.filters import ExactInputStateFilter, RandomWalkInputFilter
from fusion_gym.systems.unknown_input.fusion import NodeFusion
from fusion_gym.systems.unknown_input.input_state import InputModel
from fusion_gym.systems.unknown_input.sensors import InputSensors


class Estimates(NamedTuple):
    """Posteriors of [x(k); d(k - 1)], s = n + q entries.

    ``mean`` (l, s, N) of the nodes and ``fused_mean`` (s, N) of the centre; ``covariance``
    (l, s, s, N), ``fused_covariance`` (s, s, N) and ``weights`` (l, N) if each run has its own.
    """

    mean: Array
    fused_mean: Array
    covariance: Array | None
    fused_covariance: Array | None
    weights: Array | None


class NodePrediction(NamedTuple):
    """Predictions for the coming measurement.

    ``mean`` (l, s, N), ``fused_mean`` (s, N), ``expected`` measurements (l, m, N), and
    ``covariance`` (l, s, s, N) if each run has its own.
    """

    mean: Array
    fused_mean: Array
    expected: Array
    covariance: Array | None


@dataclass(frozen=True)
class Nodes(ABC):
    """Nodes and centre, with the nodes' model of plant and input."""

    model: InputModel
    sensors: InputSensors

    @abstractmethod
    def start(self, runs: int) -> Estimates:
        """Return the estimates before any measurement."""

    @abstractmethod
    def predict(self, estimates: Estimates, time: Array) -> NodePrediction:
        """Return the predictions for the measurements at ``time`` (N,)."""

    @abstractmethod
    def update(
        self,
        estimates: Estimates,
        prediction: NodePrediction,
        held: Array,
        granted: NDArray[np.bool_],
        time: Array,
    ) -> Estimates:
        """Return the posteriors; ``held`` (l, m, N) are the last deliveries with the new ones."""

    @abstractmethod
    def prior_covariance(self, prediction: NodePrediction, time: Array) -> Array:
        """Return the nodes' covariances (l, s, s, N or 1) before the update at ``time``."""

    @abstractmethod
    def fused_covariance(self, estimates: Estimates, time: Array) -> Array:
        """Return the centre's covariance (s, s, N or 1) of the posterior at ``time``."""

    @abstractmethod
    def variances(
        self, estimates: Estimates, prediction: NodePrediction, weights: Array, time: Array
    ) -> tuple[Array, Array]:
        """Return a silent step's fused trace (N,), weighted by (s,), and its reductions (l, N)."""

    def _start(self, runs: int) -> tuple[Array, Array, Array]:
        """Return the initial means (l, s, N), (s, N) and covariance (s, s, N)."""
        first, initial = self.model.initial_mean, self.model.initial_covariance
        fused = np.broadcast_to(first, (len(first), runs)).copy()
        mean = np.broadcast_to(fused, (self.sensors.count, *fused.shape)).copy()
        return mean, fused, np.broadcast_to(initial, (*fused.shape[:1] * 2, runs)).copy()

    def _predict(self, estimates: Estimates, covariance: Array | None) -> NodePrediction:
        """Return predictions with these covariances (l, s, s, N) of the nodes."""
        xp = namespace(estimates.mean)
        prior = self.model.predict(xp.concatenate((estimates.mean, estimates.fused_mean[None])))
        return NodePrediction(prior[:-1], prior[-1], self.sensors.expect(prior[:-1]), covariance)


@dataclass(frozen=True)
class TableNodes(Nodes):
    """Nodes that hold the last measurement; gains, bounds and fusion are tables over time.

    ``tables`` hold the nodes' gains and bounds. ``state_gain`` (l, n, n, T + 1) and ``input_gain``
    (l, q, q, T + 1) are the fusion's, w_i P P_i⁻¹ of (24); ``fused`` (s, s, T + 1) is its bound;
    ``delivered`` (l, s, s, T + 1) the bound after a single sensor's delivery; ``prior``
    (l, s, s, T + 1) the input model's prediction of the bound of one time before.
    """

    tables: BoundTables
    state_gain: Array
    input_gain: Array
    fused: Array
    delivered: Array
    prior: Array

    @classmethod
    def create(
        cls, model: InputModel, sensors: InputSensors, tables: BoundTables, fusion: NodeFusion
    ) -> TableNodes:
        """Return the nodes with fused tables, every time as a run, with the best weights."""
        n, (count, size, _, times) = fusion.states, tables.covariance.shape
        gains = np.zeros((count, size, size, times))
        fused = np.empty(0)
        for node in range(count):
            for entry in range(size):
                # The fusion is linear in the means: unit vectors read off its gains.
                unit = np.zeros((count, size, times))
                unit[node, entry] = 1.0
                result = fusion.fuse(unit, tables.covariance)
                gains[node, :, entry], fused = result.mean, result.covariance
        return cls(
            model=model,
            sensors=sensors,
            tables=tables,
            state_gain=gains[:, :n, :n],
            input_gain=gains[:, n:, n:],
            fused=fused,
            delivered=fusion.fuse_single(tables.covariance, tables.delivered)[1],
            prior=model.predict_covariance(np.roll(tables.covariance, 1, axis=-1)),
        )

    def start(self, runs: int) -> Estimates:
        """Return the estimates before any measurement; covariances stay in the tables."""
        mean, fused, _ = self._start(runs)
        return Estimates(mean, fused, None, None, None)

    def predict(self, estimates: Estimates, time: Array) -> NodePrediction:
        """See :class:`Nodes`."""
        return self._predict(estimates, None)

    def update(
        self,
        estimates: Estimates,
        prediction: NodePrediction,
        held: Array,
        granted: NDArray[np.bool_],
        time: Array,
    ) -> Estimates:
        """Update every node with the held measurement as the present one.

        Source: unknown_input, equations (8), (24).
        """
        gain = self._at(self.tables.gain, time)
        mean = prediction.mean + linalg.matvec(gain, held - prediction.expected)
        n = self.model.size
        state = linalg.matvec(self._at(self.state_gain, time), mean[:, :n])
        inputs = linalg.matvec(self._at(self.input_gain, time), mean[:, n:])
        parts = linalg.total(state, 0), linalg.total(inputs, 0)
        fused = namespace(mean).concatenate(parts)
        return Estimates(mean, fused, None, None, None)

    def prior_covariance(self, prediction: NodePrediction, time: Array) -> Array:
        """Return the table's entry; at time 0, without a prediction, it has no meaning."""
        return self._at(self.prior, time)

    def fused_covariance(self, estimates: Estimates, time: Array) -> Array:
        """Return the bound (s, s, N), which holds if the trigger keeps |σ|² <= ρ̄."""
        return self._at(self.fused, time)

    def variances(
        self, estimates: Estimates, prediction: NodePrediction, weights: Array, time: Array
    ) -> tuple[Array, Array]:
        """Return the bound's trace, and its reduction where one held difference is zero."""
        silent = linalg.weighted_trace(self.fused, weights)
        reduction = silent - linalg.weighted_trace(self.delivered, weights)
        rows = self._rows(time)
        return take(silent, rows), take(reduction, rows)

    def _rows(self, time: Array) -> NDArray[np.intp]:
        last = self.fused.shape[-1] - 1
        return namespace(time).minimum(time, last).astype(np.intp)

    def _at(self, table: Array, time: Array) -> Array:
        """Return the table's entry at every run's time, or one column if all times are equal."""
        rows = self._rows(time)
        if namespace(rows) is np and (rows == (first := int(rows[0]))).all():
            return table[..., first : first + 1]
        return take(table, rows)


@dataclass(frozen=True)
class RunNodes(Nodes):
    """Nodes whose covariances depend on the deliveries: each run has its own.

    A node without a delivery predicts. With ``hold_variance`` h (l, 1, 1, 1) it instead uses the
    last measurement as the present one, with h added to its noise's variance; this needs the
    random-walk filter.
    """

    filter: RandomWalkInputFilter | ExactInputStateFilter
    fusion: NodeFusion
    hold_variance: Array | None = None

    def start(self, runs: int) -> Estimates:
        """Return the estimates before any measurement, equal for all nodes."""
        mean, fused, covariance = self._start(runs)
        every = np.broadcast_to(covariance, (self.sensors.count, *covariance.shape)).copy()
        weights = self.fusion.start(self.sensors.count, runs)
        return Estimates(mean, fused, every, covariance, weights)

    def predict(self, estimates: Estimates, time: Array) -> NodePrediction:
        """See :class:`Nodes`."""
        prior = self.model.predict_covariance(_own(estimates.covariance))
        return self._predict(estimates, prior)

    def update(
        self,
        estimates: Estimates,
        prediction: NodePrediction,
        held: Array,
        granted: NDArray[np.bool_],
        time: Array,
    ) -> Estimates:
        """Update granted nodes, predict (or hold) the others, and fuse all."""
        gain, covariance = self._outcome(estimates, prediction, granted)
        correction = linalg.matvec(gain, held - prediction.expected)
        if self.hold_variance is None:
            grant = granted[:, None]
            correction *= grant
            own = _own(prediction.covariance)
            covariance = namespace(granted).where(grant[:, None], covariance, own)
        mean = prediction.mean + correction
        fused = self.fusion.going_on(estimates.weights).fuse(mean, covariance)
        return Estimates(mean, fused.mean, covariance, fused.covariance, fused.weights)

    def prior_covariance(self, prediction: NodePrediction, time: Array) -> Array:
        """Return the runs' own covariances (l, s, s, N)."""
        return _own(prediction.covariance)

    def fused_covariance(self, estimates: Estimates, time: Array) -> Array:
        """Return the centre's covariance (s, s, N)."""
        return _own(estimates.fused_covariance)

    def variances(
        self, estimates: Estimates, prediction: NodePrediction, weights: Array, time: Array
    ) -> tuple[Array, Array]:
        """See :class:`Nodes`; with the best fusion weights."""
        nobody = np.zeros((self.sensors.count, prediction.expected.shape[-1]), dtype=np.bool_)
        silent = _own(prediction.covariance)
        if self.hold_variance is not None:
            silent = self._outcome(estimates, prediction, nobody)[1]
        delivered = self._outcome(estimates, prediction, ~nobody)[1]
        together, single = self.fusion.fuse_single(silent, delivered)
        start = linalg.weighted_trace(together, weights)
        return start, start - linalg.weighted_trace(single, weights)

    def _outcome(
        self, estimates: Estimates, prediction: NodePrediction, granted: NDArray[np.bool_]
    ) -> tuple[Array, Array]:
        """Return gain (l, s, m, N) and covariance (l, s, s, N) of an update."""
        noise = self.sensors.covariance
        if isinstance(self.filter, ExactInputStateFilter):
            return self.filter.update(_own(estimates.covariance), noise)
        if self.hold_variance is not None:
            extra = self.hold_variance * ~granted[:, None, None]
            noise = noise + linalg.identity(self.sensors.size) * extra
        return self.filter.update(_own(prediction.covariance), noise)


def _own(value: Array | None) -> Array:
    if value is None:
        raise RuntimeError("these estimates belong to nodes that share their covariances")
    return value
