"""Covariance intersection of several estimates at once, batch axis last.

The trace of the fused covariance is a convex function of the weights. Most runs need no search: one
estimate has the smallest trace, or only two are active (:mod:`fusion_gym.fusion.intersection`).
The others take Newton steps on the simplex of weights.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.fusion.intersection import (
    REGULAR,
    SequentialIntersection,
    best_of_pair,
    information_fusion,
    orthonormalise,
)
from fusion_gym.fusion.rules import Active, Fused, SmallestTrace, own_covariances

_GAP = 1e-6  # relative optimality gap at which the search ends
_STEPS = 100  # largest number of steps; most runs need 4, ill-conditioned ones about 30
_NOTHING = 1e-22  # share of a state's least variance below which a direction counts as known
_RIDGE = 1e-10  # keeps the curvature invertible where estimates are alike


@dataclass(frozen=True)
class CovarianceIntersection(SmallestTrace):
    r"""Covariance intersection of all estimates at once (:func:`covariance_intersection_many`).

    Like its sequential form it bounds the actual covariance for every correlation of the errors.
    A single active estimate is returned unchanged. The smallest trace depends on the units of the
    states, unless ``state_weights`` weigh them as the reward does.

    Equation:
        $$
        P=\left(\sum_i w_i P_i^{-1}\right)^{-1},\qquad \hat x=P\sum_i w_i P_i^{-1}x_i
        $$

        $$
        w=\arg\min\ \mathrm{tr}\,P\quad\text{over}\quad w_i\ge0,\ \ \sum_i w_i=1
        $$

        All weights give a bound. In ``UnknownInput-v1`` ``ci`` tracks the minimum to within 1 % of
        the trace, and ``exact_ci`` computes it at every step.

    Assumes: the P_i bound their own error covariances; nothing of their correlations.

    Source: the optimum is an A-optimal design, and the gap is J. Kiefer's, "General equivalence
    theory for optimum designs", Annals of Statistics 2, 1974.
    """

    def fuse(
        self, means: Array, covariance: Array, active: Active = None, *, basis: Array | None = None
    ) -> Fused:
        """Return the fused active estimates."""
        own = own_covariances(covariance)
        basis = self.metric(own, basis)
        if active is None:
            return covariance_intersection_many(means, own, basis=basis)
        first = active.argmax(0)
        mean = np.take_along_axis(means, first[None, None], 0)[0]
        fused = np.take_along_axis(own, first[None, None, None], 0)[0]
        weights = (np.arange(len(means))[:, None] == first) * 1.0
        lanes = np.flatnonzero(active.sum(0) != 1)
        metric = None if basis is None else _at(basis, lanes)
        part = covariance_intersection_many(
            _at(means, lanes), _at(own, lanes), _at(active, lanes), metric
        )
        mean[:, lanes], fused[..., lanes] = part.mean, part.covariance
        weights[:, lanes] = part.weights

        def gains() -> Array:
            every: Array = weights[:, None, None] * linalg.identity(len(mean))
            every[..., lanes] = part.gains
            return every

        return Fused(mean, fused, gains, weights)


@np.errstate(all="ignore")
def covariance_intersection_many(
    means: Array, covariances: Array, active: Active = None, basis: Array | None = None
) -> Fused:
    """Return the covariance intersection of l estimates with the smallest trace.

    P = (Σ w_i P_i⁻¹)⁻¹ and x = P Σ w_i P_i⁻¹ x_i with w_i >= 0 and Σ w_i = 1: a bound for every
    correlation of the errors, as with two estimates. With Y_i = P_i⁻¹ the trace of P exceeds its
    minimum by at most the gap max_i tr(P Y_i P) - tr P. Newton's method needs four to thirty steps;
    the multiplicative update w_i <- w_i sqrt(tr(P Y_i P)) needs thousands where estimates are
    alike.

    Args:
        means: (l, n, N).
        covariances: (l, n, n, N), symmetric positive semi-definite where active. A direction with
            zero variance in one estimate has zero variance in the result.
        active: (l, N) bool, the estimates to join; all by default. Others are not read and get the
            weight 0.
        basis: As in :meth:`~fusion_gym.fusion.rules.FusionRule.fuse`.

    Returns:
        The fused estimate with its weights w (l, N). The search ends at a gap of a relative 1e-6,
        or after 100 steps of a run. With two active estimates the trace is within a relative 1e-6
        of the optimum. In a run without active estimates or with a NaN, mean and covariance are
        NaN.

    Assumes: the P_i bound their own error covariances; nothing of their correlations.

    Source: the optimum is an A-optimal design, and the gap is J. Kiefer's, "General equivalence
    theory for optimum designs", Annals of Statistics 2, 1974.
    """
    selected = np.ones(means.shape[::2], dtype=np.bool_) if active is None else active
    means, covariances = np.ascontiguousarray(means), np.ascontiguousarray(covariances)
    information = _informations(covariances, selected)
    metric = np.zeros_like(covariances[0])
    metric += linalg.identity(len(metric)) if basis is None else basis
    weights, fused, open_lanes = _best_single(covariances, information, metric, selected)
    singular = selected.any(0) & (~is_regular(covariances, information) & selected).any(0)
    open_lanes &= ~singular
    pairs = open_lanes & (selected.sum(0) == 2)
    lanes = np.flatnonzero(pairs)
    if lanes.size:
        weights[:, lanes], fused[..., lanes] = best_of_pair(
            _at(covariances, lanes), _at(selected, lanes), _at(metric, lanes)
        )
    lanes = np.flatnonzero(open_lanes & ~pairs)
    if lanes.size:
        taking_part = _at(selected, lanes)
        start = taking_part / np.abs(_at(linalg.trace(covariances), lanes))
        np.copyto(start, 0.0, where=~taking_part)
        start /= linalg.total(start, 0)
        weights[:, lanes], fused[..., lanes] = _search(
            _at(information, lanes), _at(metric, lanes), start
        )
    vector = np.zeros_like(means[0])
    for weight, item, mean, takes_part in zip(weights, information, means, selected, strict=True):
        vector += weight * linalg.matvec(item, np.where(takes_part, mean, 0.0))
    joined = linalg.matvec(fused, vector)
    lanes = np.flatnonzero(singular)
    if lanes.size:
        own, taking_part = _at(covariances, lanes), _at(selected, lanes)
        part, weights[:, lanes], fused[..., lanes] = _constrained(
            own, taking_part, _at(metric, lanes)
        )
        known = np.where(taking_part[:, None], _at(means, lanes), 0.0)
        joined[:, lanes] = linalg.total(linalg.matvec(part, known), 0)

    def gains() -> Array:
        every = linalg.matmul(fused, weights[:, None, None] * information)
        if lanes.size:
            every[..., lanes] = part
        return every

    return Fused(joined, fused, gains, weights)


def is_regular(covariance: Array, information: Array) -> NDArray[np.bool_]:
    """Return whether an inverse (..., n, n, N) is accurate to some 12 digits, (..., N)."""
    inflation = linalg.diagonal(covariance) * linalg.diagonal(information)
    return np.asarray((REGULAR * inflation < 1.0).all(-2))


def _constrained(
    covariances: Array, selected: NDArray[np.bool_], basis: Array
) -> tuple[Array, Array, Array]:
    """Return gains (l, n, n, N), weights (l, N) and covariance for nearly singular covariances.

    The result is x = x_0 + R u: x_0 joins the estimates as if they were independent, with the
    covariance R Rᵀ, so that all Rᵀ P_i⁻ R are at most the identity.

    Args:
        covariances: P_i (l, n, n, N).
        selected: (l, N).
        basis: (n, n, N).
    """
    size = len(basis)
    own = np.where(selected[:, None, None], covariances, linalg.identity(size))
    first = SequentialIntersection(information_fusion).fuse(own[:, 0], own, selected)
    least = np.where(selected[:, None], linalg.diagonal(own), np.inf).min(0)[:, None]
    root = linalg.root(first.covariance)
    root *= (root * root > _NOTHING * least).any(0) & (least > 0.0)
    half = np.stack([orthonormalise(linalg.root(item)[None])[:, size : 2 * size] for item in own])
    legs = linalg.matmul(half, root)
    information = linalg.matmul(linalg.transpose(legs), legs)
    information = linalg.add_diagonal(
        information, np.where(root.any(0), 0.0, 1.0)
    )  # for unused directions
    information *= selected[:, None, None]
    start = selected / selected.sum(0)
    weights, inside = _search(information, linalg.matmul(basis, root), start)
    part = linalg.matmul(linalg.matmul(root, inside), linalg.transpose(legs))
    part = linalg.matmul(weights[:, None, None] * part, half)
    rest = linalg.identity(size) - linalg.total(part, 0)
    gains = part + linalg.matmul(rest, first.gains)
    return gains, weights, linalg.congruence(root, inside)


def _informations(covariances: Array, selected: NDArray[np.bool_]) -> Array:
    """Return the inverses (l, n, n, N) of the selected covariances, zero elsewhere."""
    if selected.all():
        return linalg.inverse(covariances)
    information = np.zeros_like(covariances)
    for estimate, takes_part in enumerate(selected):
        lanes = np.flatnonzero(takes_part)
        information[estimate][..., lanes] = linalg.inverse(_at(covariances[estimate], lanes))
    return information


def _at(array: NDArray[Any], lanes: NDArray[np.intp]) -> NDArray[Any]:
    """Return the given runs with a contiguous batch axis."""
    return array.take(lanes, axis=-1)


def _best_single(
    covariances: Array, information: Array, basis: Array, selected: NDArray[np.bool_]
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return weights and covariance of the single best estimate, and where it is not optimal.

    Args:
        covariances: (l, n, n, N).
        information: (l, n, n, N), the inverses.
        basis: (n, n, N).
        selected: (l, N).

    Returns:
        Weights (l, N), covariance (n, n, N), and the runs (N,) with a gap or a NaN. In a run
        without active estimates the weights are zero, the covariance is NaN, and there is no
        search.
    """
    spread = linalg.matmul(covariances, linalg.transpose(basis))
    traces = np.where(selected, linalg.trace(linalg.matmul(basis, spread)), np.inf)
    first = traces.argmin(0)
    weights = ((np.arange(len(traces))[:, None] == first) & selected) * 1.0
    fused = np.take_along_axis(covariances, first[None, None, None], 0)[0]
    empty = ~selected.any(0)
    fused[..., empty] = np.nan
    gain = _gain(information, linalg.matmul(fused, linalg.transpose(basis)))
    total = np.where(empty, np.nan, traces.min(0))
    closed = gain.max(0) - total <= _GAP * total
    return weights, fused, ~(closed | empty)


def _gain(information: Array, spread: Array) -> Array:
    """Return tr(Y_i S Sᵀ) (l, N) of S = P Gᵀ, the negative gradient of the trace of G P Gᵀ."""
    square = linalg.matmul(spread, linalg.transpose(spread))
    product = information * square
    return linalg.total(product.reshape(len(information), len(square) ** 2, -1))


def _search(information: Array, basis: Array, start: Array) -> tuple[Array, Array]:
    """Return weights (l, N) and covariance (n, n, N) of the smallest trace, from ``start``."""
    weights, fused = start.copy(), np.empty_like(information[0])
    lanes = np.arange(start.shape[-1])
    old, new, lowest = start, start, np.full(lanes.size, np.inf)
    for _ in range(_STEPS):
        root = _inverse_root(_weighted(new, information))
        covariance = linalg.matmul(root, linalg.transpose(root))
        spread = linalg.matmul(covariance, linalg.transpose(basis))
        total = linalg.trace(linalg.matmul(basis, spread))
        gain = _gain(information, spread)
        worse = ~(total <= lowest) & (lowest < np.inf)
        open_lanes = worse | (gain.max(0) - total > _GAP * total)
        if not open_lanes.all():
            closed, still = np.flatnonzero(~open_lanes), np.flatnonzero(open_lanes)
            weights[:, lanes[closed]] = _at(new, closed)
            fused[..., lanes[closed]] = _at(covariance, closed)
            if not still.size:
                return weights, fused
            lanes, information, worse = (lanes[still], _at(information, still), worse[still])
            root, spread, gain = (_at(root, still), _at(spread, still), _at(gain, still))
            basis = _at(basis, still)
            old, new = _at(old, still), _at(new, still)
            total, lowest = total[still], lowest[still]
        target = _newton(information, new, root, spread, gain, total)
        target = np.where(worse, 0.5 * (old + new), target)
        old, lowest = np.where(worse, old, new), np.where(worse, lowest, total)
        new = target
    weights[:, lanes] = old
    fused[..., lanes] = linalg.inverse(_weighted(old, information))
    return weights, fused


def _weighted(weights: Array, information: Array) -> Array:
    """Return Σ w_i Y_i, (n, n, N)."""
    total: Array = weights[0] * information[0]
    for weight, item in zip(weights[1:], information[1:], strict=True):
        total += weight * item
    return total


def _inverse_root(matrix: Array) -> Array:
    """Return the upper triangular U (n, n, N) with U Uᵀ the inverse, NaN if not definite."""
    size = len(matrix)
    stack = np.zeros((2 * size, size, matrix.shape[-1]))  # rows from n on become U
    stack[:size] = matrix
    for k in range(size):
        stack[size + k, k] = 1.0
        pivot = np.sqrt(stack[k, k])
        pivot /= stack[k, k]  # NaN where it is not positive
        column = stack[k + 1 : size + k + 1, k]
        column *= pivot
        if k + 1 < size:
            stack[k + 1 : size + k + 1, k + 1 :] -= column[:, None] * column[: size - k - 1]
    return stack[size:]


def _newton(
    information: Array, weights: Array, root: Array, spread: Array, gain: Array, total: Array
) -> Array:
    """Return the non-negative weights (l, N) that minimise the trace's quadratic model.

    With S = P Gᵀ the gradient is -``gain`` and the curvature H_ij = 2 tr(Sᵀ Y_i P Y_j S). The trace
    is homogeneous of degree -1, so H w = 2 ``gain`` and the model is tᵀ H t / 2 - 3 ``gain``ᵀ t.
    Free are the estimates of positive weight and of a gain above the trace. While the minimum has a
    negative weight, the weights move towards it up to the boundary, and the estimate whose weight
    becomes zero is no longer free. Where rounding leaves no descent, weight moves from the estimate
    of the smallest gain to the estimate of the largest.

    Args:
        information: Y_i (l, n, n, N).
        weights: w (l, N).
        root: U (n, n, N) with P = U Uᵀ.
        spread: S (n, n, N).
        gain: (l, N).
        total: Trace (N,).
    """
    free = (weights > 0.0) | (gain > total)
    somewhere = free.any(1)
    if not somewhere.all():  # skip estimates that are inactive in every run
        target = np.zeros_like(weights)
        target[somewhere] = _newton(
            information[somewhere], weights[somewhere], root, spread, gain[somewhere], total
        )
        return target
    curvature = _curvature(information, root, spread)
    target = _model_minimum(curvature, gain, free)
    reached = weights.copy()
    lanes = np.flatnonzero((target < 0.0).any(0))
    for _ in range(len(weights) - 1):
        if not lanes.size:
            break
        reached[:, lanes], blocking = _as_far(_at(reached, lanes), _at(target, lanes))
        mask = _at(free, lanes) & ~blocking
        trial = _model_minimum(_at(curvature, lanes), _at(gain, lanes), mask)
        free[:, lanes], target[:, lanes] = mask, trial
        lanes = lanes[(trial < 0.0).any(0)]
    target /= linalg.total(target, 0)
    sound = (linalg.dot(target - weights, gain) > 0.0) & (target >= 0.0).all(0)
    unsound = np.flatnonzero(~sound)
    if unsound.size:
        target[:, unsound] = _exchange(
            _at(weights, unsound), _at(gain, unsound), _at(curvature, unsound)
        )
    return target


def _as_far(weights: Array, target: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the last non-negative weights (l, N) towards the target, and the blocking ones."""
    reach = np.full_like(weights, np.inf)
    np.divide(weights, weights - target, out=reach, where=target < 0.0)
    length = reach.min(0)
    blocking = reach == length
    reached = np.where(blocking, 0.0, weights + length * (target - weights))
    return np.maximum(reached, 0.0), blocking


def _curvature(information: Array, root: Array, spread: Array) -> Array:
    """Return 2 tr(Sᵀ Y_i P Y_j S), (l, l, N), for i <= j, zero below."""
    count, size, _, runs = information.shape
    legs = linalg.matmul(information, spread)
    for row in range(size - 1, -1, -1):
        legs[:, row] *= root[row, row]
        for other in range(row):
            legs[:, row] += root[other, row] * legs[:, other]
    legs = legs.reshape(count, -1, runs)
    scaled = legs + legs
    result = np.zeros((count, count, runs))
    for i in range(count):
        result[i, i:] = linalg.total(scaled[i] * legs[i:])
    return result


def _model_minimum(curvature: Array, gain: Array, free: NDArray[np.bool_]) -> Array:
    """Return t (l, N), Σ t = 1, zero outside ``free``, that minimises tᵀ H t / 2 - 3 gainᵀ t."""
    count, mask = len(gain), free * 1.0
    work = np.zeros((count, count + 2, gain.shape[-1]))
    for i in range(count):
        np.multiply(curvature[i, i:], mask[i] * mask[i:], out=work[i, i:count])
        work[i, i] *= 1.0 + _RIDGE
        work[i, i] += 1.0 - mask[i]
        np.multiply(gain[i], 3.0 * mask[i], out=work[i, count])
        work[i, count + 1] = mask[i]
    for k in range(count - 1):
        factor = work[k, k + 1 : count] / work[k, k]
        work[k + 1 :, k + 1 :] -= factor[:, None] * work[k, k + 1 :]
    for k in range(count - 1, -1, -1):
        work[k, count:] /= work[k, k]
        if k:
            work[:k, count:] -= work[:k, k, None] * work[k, count:]
    pull, level = work[:, count], work[:, count + 1]
    excess = (linalg.total(pull, 0) - 1.0) / linalg.total(level, 0)
    minimum: Array = pull - excess * level
    return minimum


def _exchange(weights: Array, gain: Array, curvature: Array) -> Array:
    """Return weights (l, N) after a move from the estimate of the smallest gain to the largest."""
    lanes = np.arange(weights.shape[-1])
    most = gain.argmax(0)
    least = np.where(weights > 0.0, gain, np.inf).argmin(0)
    bend = curvature[most, most, lanes] + curvature[least, least, lanes]
    bend -= 2.0 * curvature[np.minimum(most, least), np.maximum(most, least), lanes]
    reach = weights[least, lanes]
    length = (gain[most, lanes] - gain[least, lanes]) / bend
    length = np.where((length > 0.0) & (length < reach), length, reach)
    moved = weights.copy()
    moved[most, lanes] += length
    moved[least, lanes] -= length
    return moved
