"""The nodes of an unknown-input system, and the fusion of their estimates at the centre.

State and input are fused separately, each by (24) with weights of the smallest trace (25). The
cross-covariance of the two results is unknown and set to zero. :class:`TableNodes` reads tables
that all runs share; :class:`RunNodes` has a covariance for every node and run. Nodes get no
feedback.

Source: unknown_input, equations (8), (24)-(26).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.fusion import several
from fusion_gym.fusion.rules import Active, Fused, FusionRule, own_covariances
from fusion_gym.namespace import in_runs, namespace, put_runs, set_at, take
from fusion_gym.systems.unknown_input.filters import (
    BoundTables,
    ExactInputStateFilter,
    InputModel,
    RandomWalkInputFilter,
)
from fusion_gym.systems.unknown_input.plant import InputSensors

_GAP = 0.01  # relative gap at which the tracked weights rest
_STEPS = 4  # evaluations of the tracked weights at a time, at most
_FLOOR = 1e-3  # a tracked weight stays above, so that it can come back


@dataclass(frozen=True)
class NodeFusion(FusionRule):
    """The centre's rule for l nodes with n states and q inputs.

    ``rule`` joins the ``states`` n entries of the nodes' states, and their inputs. With
    :class:`~fusion_gym.fusion.several.CovarianceIntersection` and ``tracked``, its weights follow
    the smallest trace from one time to the next (:func:`tracked_intersection`), starting from the
    last ``weights`` (l, N).

    Covariance intersection gives a bound for every correlation of the nodes' errors, provided that
    the nodes' covariances are bounds. Its inverse form does not, because the errors share process
    noise.
    """

    rule: FusionRule
    states: int
    tracked: bool = False
    state_weights: Array | None = None
    weights: Array | None = None

    def fuse(
        self, means: Array, covariance: Array, active: Active = None, *, basis: Array | None = None
    ) -> Fused:
        """See :class:`~fusion_gym.fusion.rules.FusionRule`, for means (l, s, N), s = n + q.

        The covariance has zero blocks between state and input. Tracked weights are the state's.
        """
        n, own = self.states, own_covariances(covariance)
        ranges = slice(n), slice(n, None)
        part = self.state_weights
        every = (None, None) if part is None else (part[:n], part[n:])
        state = self._block(means[:, :n], own[:, :n, :n], active, every[0])
        inputs = self._block(means[:, n:], own[:, n:, n:], active, every[1])
        xp, blocks = namespace(means, own), [(..., part, part, slice(None)) for part in ranges]

        def joined(*parts: Array) -> Array:
            whole = xp.zeros((*parts[0].shape[:-3], *own.shape[1:]))
            for block, part in zip(blocks, parts, strict=True):
                whole = set_at(whole, block, part)
            return whole

        return Fused(
            xp.concatenate((state.mean, inputs.mean)),
            joined(state.covariance, inputs.covariance),
            lambda: joined(state.gains, inputs.gains),
            state.weights if self.tracked else None,
        )

    def _block(
        self, means: Array, own: Array, active: NDArray[np.bool_] | None, state: Array | None
    ) -> Fused:
        rule = self.rule.with_weights(state)
        if active is not None:
            return rule.fuse(means, own, active)
        ones = np.ones((1, means.shape[-1]))
        if len(means) == 1:
            identity = linalg.identity(means.shape[1]) * ones
            return Fused(means[0], own[0], lambda: identity[None], ones)
        if isinstance(rule, several.CovarianceIntersection):
            if means.shape[1] == 1:
                return _smallest_variance(means, own)
            if self.weights is not None:
                return tracked_intersection(means, own, self.weights, rule.metric(own, None))
        return rule.fuse(means, own)


def _smallest_variance(mean: Array, covariance: Array) -> Fused:
    """Return the covariance intersection of scalars: the smallest variance, or equal shares."""
    smallest = covariance.min(0)
    selection = (covariance == smallest)[:, 0, 0]
    weights = selection / linalg.total(selection * 1.0)
    joined = linalg.total(weights[:, None] * mean, 0)
    return Fused(joined, smallest, lambda: weights[:, None, None], weights)


@np.errstate(all="ignore")
def tracked_intersection(
    mean: Array, covariance: Array, weights: Array, basis: Array | None = None
) -> Fused:
    """Return the covariance intersection with weights that follow the smallest trace over time.

    From the given weights (l, N), w_i ← w_i √tr(P Y_i P), normalised, with Y_i = P_i⁻¹ and P = (Σ
    w_i Y_i)⁻¹, until the trace of P is within 1 % of its minimum: the gap is at most max_i tr(P Y_i
    P) - tr P. A call makes at most four evaluations; the next call continues. Every P is a bound,
    since any weights give one. For a nearly singular estimate the search is
    :func:`~fusion_gym.fusion.several.covariance_intersection_many`.

    Args:
        mean: (l, n, N).
        covariance: (l, n, n, N), symmetric positive semi-definite.
        weights: (l, N), not negative, of sum 1.
        basis: As in :meth:`~fusion_gym.fusion.rules.FusionRule.fuse`.
    """
    information, xp = linalg.inverse(covariance), namespace(covariance)
    nodes, n = mean.shape[:2]
    vectors = linalg.matvec(information, mean)
    weights = xp.maximum(weights, _FLOOR)
    weights /= linalg.total(weights, 0)
    lanes: Any = slice(None)
    fused = xp.empty_like(covariance[0])
    for step in range(_STEPS):
        runs = lanes if xp is np else slice(None)  # JAX computes all
        part, some = information[..., runs], weights[:, runs]
        bound = linalg.inverse(linalg.total(some[:, None, None] * part, 0))
        fused = put_runs(fused, lanes, bound)
        if step == _STEPS - 1:
            break
        metric = None if basis is None else basis[..., runs]
        spread = bound if metric is None else linalg.matmul(bound, linalg.transpose(metric))
        square = linalg.matmul(spread, linalg.transpose(spread))
        gain = linalg.total((part * square).reshape(nodes, n * n, -1))
        total = linalg.trace(bound if metric is None else linalg.matmul(metric, spread))
        still = gain.max(0) > (1.0 + _GAP) * total
        if xp is np:
            if not still.any():
                break
            some, gain = some[:, still], gain[:, still]
            lanes = np.flatnonzero(still) if isinstance(lanes, slice) else lanes[still]
        else:
            lanes = still if isinstance(lanes, slice) else lanes & still
        moved = xp.maximum(some * xp.sqrt(gain), _FLOOR**2)
        weights = put_runs(weights, lanes, moved / linalg.total(moved, 0))
    joined = linalg.matvec(fused, linalg.total(weights[:, None] * vectors, 0))
    singular: Any = ~several.is_regular(covariance, information).all(0)

    def best(mean: Array, covariance: Array, basis: Array | None = None) -> tuple[Any, ...]:
        found = several.covariance_intersection_many(mean, covariance, basis=basis)
        return found.mean, found.covariance, found.weights, found.gains

    arguments = (mean, covariance) if basis is None else (mean, covariance, basis)
    results = joined, fused, weights, xp.zeros(covariance.shape)
    joined, fused, weights, own = in_runs(singular[None], best, arguments, results)

    def gains() -> Array:
        every = linalg.matmul(fused, weights[:, None, None] * information)
        return xp.where(singular, own, every)

    return Fused(joined, fused, gains, weights)


class Estimates(NamedTuple):
    """Posteriors of [x(k); d(k - 1)], s = n + q entries.

    ``mean`` (l, s, N) of the nodes and ``fused_mean`` (s, N) of the centre; ``covariance``
    (l, s, s, N), ``fused_covariance`` (s, s, N) and ``weights`` (l, N) if each run has its own.
    """

    mean: Array
    fused_mean: Array
    covariance: Any = None
    fused_covariance: Any = None
    weights: Array | None = None


class NodePrediction(NamedTuple):
    """Predictions for the coming measurement.

    ``mean`` (l, s, N), ``fused_mean`` (s, N), ``expected`` measurements (l, m, N), and
    ``covariance`` (l, s, s, N) if each run has its own.
    """

    mean: Array
    fused_mean: Array
    expected: Array
    covariance: Any


@dataclass(frozen=True)
class _Nodes:
    """What both kinds of nodes have: the model of plant and input, and the sensors.

    A ``state`` below is the estimator's, with the last deliveries, the new ones included.
    """

    model: InputModel
    sensors: InputSensors

    def _start(self, runs: int) -> tuple[Array, Array, Array]:
        """Return the initial means (l, s, N), (s, N) and covariance (s, s, N)."""
        first, initial = self.model.initial_mean, self.model.initial_covariance
        fused = np.broadcast_to(first, (len(first), runs)).copy()
        mean = np.broadcast_to(fused, (self.sensors.count, *fused.shape)).copy()
        return mean, fused, np.broadcast_to(initial, (*fused.shape[:1] * 2, runs)).copy()

    def predict(self, estimates: Estimates) -> NodePrediction:
        """Return the predictions for the next measurements."""
        xp, covariance = namespace(estimates.mean), estimates.covariance
        prior = self.model.predict(xp.concatenate((estimates.mean, estimates.fused_mean[None])))
        if covariance is not None:
            covariance = self.model.predict_covariance(covariance)
        return NodePrediction(prior[:-1], prior[-1], self.sensors.expect(prior[:-1]), covariance)


@dataclass(frozen=True)
class TableNodes(_Nodes):
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
        delivered = fusion.fuse_single(tables.covariance, tables.delivered)[1]
        prior = model.predict_covariance(np.roll(tables.covariance, 1, axis=-1))
        both = gains[:, :n, :n], gains[:, n:, n:]
        return cls(model, sensors, tables, *both, fused, delivered, prior)

    def start(self, runs: int) -> Estimates:
        """Return the estimates before any measurement; covariances stay in the tables."""
        mean, fused, _ = self._start(runs)
        return Estimates(mean, fused)

    def update(self, state: Any, granted: NDArray[np.bool_]) -> Estimates:
        """Update every node with the held measurement (l, m, N) as the present one.

        Source: unknown_input, equations (8), (24).
        """
        prediction, n = state.prediction, self.model.size
        gain = self._at(self.tables.gain, state.time)
        mean = prediction.mean + linalg.matvec(gain, state.held - prediction.expected)
        states = linalg.matvec(self._at(self.state_gain, state.time), mean[:, :n])
        inputs = linalg.matvec(self._at(self.input_gain, state.time), mean[:, n:])
        parts = linalg.total(states, 0), linalg.total(inputs, 0)
        return Estimates(mean, namespace(mean).concatenate(parts))

    def prior_covariance(self, prediction: NodePrediction, time: Array) -> Array:
        """Return the table's entry; at time 0, without a prediction, it has no meaning."""
        return self._at(self.prior, time)

    def fused_covariance(self, estimates: Estimates, time: Array) -> Array:
        """Return the bound (s, s, N), which holds if the trigger keeps |σ|² <= ρ̄."""
        return self._at(self.fused, time)

    def variances(self, state: Any, weights: Array) -> tuple[Array, Array]:
        """Return the bound's trace (N,), weighted by (s,), and its reductions (l, N).

        A reduction supposes that one held difference is zero.
        """
        silent = linalg.weighted_trace(self.fused, weights)
        reduction = silent - linalg.weighted_trace(self.delivered, weights)
        rows = self._rows(state.time)
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
class RunNodes(_Nodes):
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
        weights = np.full((len(mean), runs), 1.0 / len(mean)) if self.fusion.tracked else None
        return Estimates(mean, fused, every, covariance, weights)

    def update(self, state: Any, granted: NDArray[np.bool_]) -> Estimates:
        """Update granted nodes, predict (or hold) the others, and fuse all."""
        prediction, (gain, covariance) = state.prediction, self._outcome(state, granted)
        correction = linalg.matvec(gain, state.held - prediction.expected)
        if self.hold_variance is None:
            grant = granted[:, None]
            correction *= grant
            prior = prediction.covariance
            covariance = namespace(granted).where(grant[:, None], covariance, prior)
        mean = prediction.mean + correction
        fusion = replace(self.fusion, weights=state.estimates.weights)
        fused = fusion.fuse(mean, covariance)
        return Estimates(mean, fused.mean, covariance, fused.covariance, fused.weights)

    def prior_covariance(self, prediction: NodePrediction, time: Array) -> Array:
        """Return the runs' own covariances (l, s, s, N)."""
        return prediction.covariance

    def fused_covariance(self, estimates: Estimates, time: Array) -> Array:
        """Return the centre's covariance (s, s, N)."""
        return estimates.fused_covariance

    def variances(self, state: Any, weights: Array) -> tuple[Array, Array]:
        """Return a silent step's fused trace (N,), weighted by (s,), and its reductions (l, N).

        The fusion has the best weights.
        """
        nobody, silent = np.zeros(state.age.shape, dtype=np.bool_), state.prediction.covariance
        if self.hold_variance is not None:
            silent = self._outcome(state, nobody)[1]
        delivered = self._outcome(state, ~nobody)[1]
        together, single = self.fusion.fuse_single(silent, delivered)
        start = linalg.weighted_trace(together, weights)
        return start, start - linalg.weighted_trace(single, weights)

    def _outcome(self, state: Any, granted: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Return gain (l, s, m, N) and covariance (l, s, s, N) of an update."""
        noise = self.sensors.covariance
        if isinstance(self.filter, ExactInputStateFilter):
            return self.filter.update(state.estimates.covariance, noise)
        if self.hold_variance is not None:
            extra = self.hold_variance * ~granted[:, None, None]
            noise = noise + linalg.identity(self.sensors.size) * extra
        return self.filter.update(state.prediction.covariance, noise)


Nodes = TableNodes | RunNodes
