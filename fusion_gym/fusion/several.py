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
from fusion_gym.fusion.diagonal import REGULAR, orthonormalise
from fusion_gym.fusion.intersection import SequentialIntersection, best_of_pair, information_fusion
from fusion_gym.fusion.rules import Active, Fused, SmallestTrace, own_covariances
from fusion_gym.namespace import at_runs, in_runs, namespace, put_runs, repeat, runs_of, update_at

_GAP = 1e-6  # relative optimality gap at which the search ends
_STEPS = 100  # largest number of steps; most runs need 4, ill-conditioned ones about 30
_NOTHING = 1e-22  # share of a state's least variance below which a direction counts as known
_ALL = slice(None)
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
        xp, first = namespace(means, own), active.argmax(0)
        mean = xp.take_along_axis(means, first[None, None], 0)[0]
        fused = xp.take_along_axis(own, first[None, None, None], 0)[0]
        single = (np.arange(len(means))[:, None] == first) * 1.0
        lanes = runs_of(xp.asarray(active.sum(0) != 1))
        metric = None if basis is None else at_runs(basis, lanes)
        part = covariance_intersection_many(
            at_runs(means, lanes), at_runs(own, lanes), at_runs(active, lanes), metric
        )

        def gains() -> Array:
            every = single[:, None, None] * linalg.identity(len(mean))
            return put_runs(every, lanes, part.gains)

        mean, fused = put_runs(mean, lanes, part.mean), put_runs(fused, lanes, part.covariance)
        return Fused(mean, fused, gains, put_runs(single.copy(), lanes, part.weights))


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
    xp = namespace(means, covariances)
    selected = xp.ones(means.shape[::2], dtype=np.bool_) if active is None else active
    if xp is np:
        means, covariances = np.ascontiguousarray(means), np.ascontiguousarray(covariances)
    information = _informations(covariances, selected)
    metric = xp.zeros_like(covariances[0])
    metric += linalg.identity(len(metric)) if basis is None else basis
    weights, fused, open_lanes = _best_single(covariances, information, metric, selected)
    singular: Any = (~is_regular(covariances, information) & selected).any(0)
    open_lanes &= ~singular
    pairs = open_lanes & (selected.sum(0) == 2)
    pair = covariances, selected, metric
    if active is not None or len(means) == 2:
        weights, fused = in_runs(pairs[None], best_of_pair, pair, (weights, fused))
    several = covariances, information, selected, metric
    weights, fused = in_runs((open_lanes & ~pairs)[None], _best_of_all, several, (weights, fused))
    vector = xp.zeros_like(means[0])
    for weight, item, mean, takes_part in zip(weights, information, means, selected, strict=True):
        vector += weight * linalg.matvec(item, xp.where(takes_part, mean, 0.0))
    known = linalg.matvec(fused, vector), weights, fused, xp.zeros(covariances.shape)
    joined, weights, fused, part = in_runs(singular[None], _constrained, (means, *pair), known)

    def gains() -> Array:
        every = linalg.matmul(fused, weights[:, None, None] * information)
        return xp.where(singular, part, every)

    return Fused(joined, fused, gains, weights)


def is_regular(covariance: Array, information: Array) -> NDArray[np.bool_]:
    """Return whether an inverse (..., n, n, N) is accurate to some 12 digits, (..., N)."""
    inflation = linalg.diagonal(covariance) * linalg.diagonal(information)
    return namespace(inflation).all(REGULAR * inflation < 1.0, -2)


def _best_of_all(
    covariances: Array, information: Array, selected: NDArray[np.bool_], basis: Array
) -> tuple[Array, Array]:
    """Return weights (l, N) and covariance (n, n, N) of the smallest trace."""
    xp = namespace(covariances)
    start = xp.where(selected, 1.0 / xp.abs(linalg.trace(covariances)), 0.0)
    return _search(information, basis, start / linalg.total(start, 0))


def _constrained(
    means: Array, covariances: Array, selected: NDArray[np.bool_], basis: Array
) -> tuple[Array, Array, Array, Array]:
    """Return mean, weights (l, N), covariance and gains for nearly singular covariances.

    The result is x = x_0 + R u: x_0 joins the estimates as if they were independent, with the
    covariance R Rᵀ, so that all Rᵀ P_i⁻ R are at most the identity.

    Args:
        means: x_i (l, n, N).
        covariances: P_i (l, n, n, N).
        selected: (l, N).
        basis: (n, n, N).
    """
    size, xp = len(basis), namespace(covariances)
    own = xp.where(selected[:, None, None], covariances, linalg.identity(size))
    first = SequentialIntersection(information_fusion).fuse(own[:, 0], own, selected)
    least = xp.where(selected[:, None], linalg.diagonal(own), np.inf).min(0)[:, None]
    root = linalg.root(first.covariance)
    root *= (root * root > _NOTHING * least).any(0) & (least > 0.0)
    half = xp.stack([orthonormalise(linalg.root(item)[None])[:, size : 2 * size] for item in own])
    legs = linalg.matmul(half, root)
    information = linalg.matmul(linalg.transpose(legs), legs)
    unused = xp.where(root.any(0), 0.0, 1.0)
    information = linalg.add_diagonal(information, unused) * selected[:, None, None]
    start = selected / selected.sum(0)
    weights, inside = _search(information, linalg.matmul(basis, root), start)
    part = linalg.matmul(linalg.matmul(root, inside), linalg.transpose(legs))
    part = linalg.matmul(weights[:, None, None] * part, half)
    rest = linalg.identity(size) - linalg.total(part, 0)
    gains = part + linalg.matmul(rest, first.gains)
    mean = linalg.total(linalg.matvec(gains, xp.where(selected[:, None], means, 0.0)), 0)
    return mean, weights, linalg.congruence(root, inside), gains


def _informations(covariances: Array, selected: NDArray[np.bool_]) -> Array:
    """Return the inverses (l, n, n, N) of the selected covariances, zero elsewhere."""
    xp = namespace(covariances)
    if xp is not np or selected.all():
        return xp.where(selected[:, None, None], linalg.inverse(covariances), 0.0)
    result = np.zeros_like(covariances)
    for own, covariance, takes_part in zip(result, covariances, selected, strict=True):
        in_runs(takes_part[None], lambda part: (linalg.inverse(part),), (covariance,), (own,))
    return result


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
    xp = namespace(spread)
    traces = xp.where(selected, linalg.trace(linalg.matmul(basis, spread)), np.inf)
    first = traces.argmin(0)
    weights = ((np.arange(len(traces))[:, None] == first) & selected) * 1.0
    empty = ~selected.any(0)
    fused = xp.take_along_axis(covariances, first[None, None, None], 0)[0]
    fused = xp.where(empty, np.nan, fused)
    gain = _gain(information, linalg.matmul(fused, linalg.transpose(basis)))
    total = xp.where(empty, np.nan, traces.min(0))
    closed = gain.max(0) - total <= _GAP * total
    return weights, fused, ~(closed | empty)


def _gain(information: Array, spread: Array) -> Array:
    """Return tr(Y_i S Sᵀ) (l, N) of S = P Gᵀ, the negative gradient of the trace of G P Gᵀ."""
    square = linalg.matmul(spread, linalg.transpose(spread))
    product = information * square
    return linalg.total(product.reshape(len(information), len(square) ** 2, -1))


def _search(information: Array, basis: Array, start: Array) -> tuple[Array, Array]:
    """Return weights (l, N) and covariance (n, n, N) of the smallest trace, from ``start``."""
    xp, runs = namespace(information), start.shape[-1]

    def step(state: tuple[Any, ...]) -> tuple[Any, tuple[Any, ...]]:
        lanes, weights, fused, information, basis, old, new, lowest = state
        root = _inverse_root(_weighted(new, information))
        covariance = linalg.matmul(root, linalg.transpose(root))
        spread = linalg.matmul(covariance, linalg.transpose(basis))
        total = linalg.trace(linalg.matmul(basis, spread))
        gain = _gain(information, spread)
        worse = ~(total <= lowest) & (lowest < np.inf)
        open_lanes = worse | (gain.max(0) - total > _GAP * total)
        if xp is not np or not open_lanes.all():
            closed, still = runs_of(~open_lanes), runs_of(open_lanes)
            ended = lanes[closed] if xp is np else lanes & closed
            weights = put_runs(weights, ended, at_runs(new, closed))
            fused = put_runs(fused, ended, at_runs(covariance, closed))
            lanes = lanes[still] if xp is np else lanes & still
            parts = information, basis, old, new, lowest, worse, root, spread, gain, total
            parts = tuple(at_runs(part, still) for part in parts)
            information, basis, old, new, lowest, worse, root, spread, gain, total = parts
        goes_on = lanes.any() if xp is not np else lanes.size > 0
        if goes_on is not False:
            target = _newton(information, new, root, spread, gain, total)
            target = xp.where(worse, 0.5 * (old + new), target)
            old, lowest = xp.where(worse, old, new), xp.where(worse, lowest, total)
            new = target
        return goes_on, (lanes, weights, fused, information, basis, old, new, lowest)

    lanes = np.arange(runs) if xp is np else xp.full(runs, True)
    lowest, fused = xp.full(runs, np.inf), xp.empty_like(information[0])
    state = lanes, start.copy(), fused, information, basis, start, start, lowest
    lanes, weights, fused, information, _, old, *_ = repeat(step, state, _STEPS)
    if xp is np and not lanes.size:
        return weights, fused
    fused = put_runs(fused, lanes, linalg.inverse(_weighted(old, information)))
    return put_runs(weights, lanes, old), fused


def _weighted(weights: Array, information: Array) -> Array:
    """Return Σ w_i Y_i, (n, n, N)."""
    total: Array = weights[0] * information[0]
    for weight, item in zip(weights[1:], information[1:], strict=True):
        total += weight * item
    return total


def _inverse_root(matrix: Array) -> Array:
    """Return the upper triangular U (n, n, N) with U Uᵀ the inverse, NaN if not definite."""
    xp, size = namespace(matrix), len(matrix)
    unit = xp.zeros_like(matrix) + linalg.identity(size)
    stack = xp.concatenate((matrix, unit))  # rows from n on become U
    for k in range(size):
        rows, later = slice(k + 1, size + k + 1), slice(k + 1, None)
        pivot = xp.sqrt(stack[k, k])
        pivot /= stack[k, k]  # NaN where it is not positive
        stack = update_at(np.multiply, stack, (..., rows, k, _ALL), pivot)
        column = stack[rows, k]
        if k + 1 < size:
            product = column[:, None] * column[: size - k - 1]
            stack = update_at(np.subtract, stack, (..., rows, later, _ALL), product)
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
    free: Any = (weights > 0.0) | (gain > total)
    xp, somewhere = namespace(weights), free.any(1)
    if xp is np and not somewhere.all():  # skip estimates that are inactive in every run
        place = np.cumsum(somewhere) - 1
        part = _newton(
            information[somewhere], weights[somewhere], root, spread, gain[somewhere], total
        )
        return np.where(somewhere[:, None], part[place], 0.0)
    curvature = _curvature(information, root, spread)

    def step(state: tuple[Any, ...]) -> tuple[Any, tuple[Any, ...]]:
        reached, free, target = state
        negative = (target < 0.0).any(0)
        goes_on = negative.any()
        if xp is not np or goes_on:
            lanes = runs_of(negative)
            further, blocking = _as_far(at_runs(reached, lanes), at_runs(target, lanes))
            mask = at_runs(free, lanes) & ~blocking
            trial = _model_minimum(at_runs(curvature, lanes), at_runs(gain, lanes), mask)
            parts = zip(state, (further, mask, trial), strict=True)
            reached, free, target = (put_runs(old, lanes, part) for old, part in parts)
        return goes_on, (reached, free, target)

    start = weights.copy(), free, _model_minimum(curvature, gain, free)
    target = repeat(step, start, len(weights) - 1)[2]
    target = target / linalg.total(target, 0)
    sound: Any = (linalg.dot(target - weights, gain) > 0.0) & (target >= 0.0).all(0)
    (target,) = in_runs(~sound[None], _exchange, (weights, gain, curvature), (target,))
    return target


def _as_far(weights: Array, target: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the last non-negative weights (l, N) towards the target, and the blocking ones."""
    xp = namespace(weights)
    reach = xp.where(target < 0.0, weights / (weights - target), np.inf)
    length = reach.min(0)
    blocking = reach == length
    reached = xp.where(blocking, 0.0, weights + length * (target - weights))
    return xp.maximum(reached, 0.0), blocking


def _curvature(information: Array, root: Array, spread: Array) -> Array:
    """Return 2 tr(Sᵀ Y_i P Y_j S), (l, l, N), for i <= j, zero below."""
    count, size, _, runs = information.shape
    legs = linalg.matmul(information, spread)
    xp, rows = namespace(legs), []
    for row in range(size):
        moved = legs[:, row] * root[row, row]
        for other in range(row):
            moved += root[other, row] * legs[:, other]
        rows.append(moved)
    legs = xp.stack(rows, axis=1).reshape(count, -1, runs)
    scaled = legs + legs
    upper = [linalg.total(scaled[i] * legs[i:]) for i in range(count)]
    return xp.stack([xp.concatenate((xp.zeros((i, runs)), row)) for i, row in enumerate(upper)])


def _model_minimum(curvature: Array, gain: Array, free: NDArray[np.bool_]) -> Array:
    """Return t (l, N), Σ t = 1, zero outside ``free``, that minimises tᵀ H t / 2 - 3 gainᵀ t."""
    xp, count, mask = namespace(gain), len(gain), free * 1.0
    unit, right = linalg.identity(count), slice(count, None)
    work = curvature * (mask[:, None] * mask) * (1.0 + _RIDGE * unit) + unit * (1.0 - mask)
    work = xp.concatenate((work, (3.0 * mask * gain)[:, None], mask[:, None]), axis=1)
    for k in range(count - 1):
        factor, later = work[k, k + 1 : count] / work[k, k], slice(k + 1, None)
        product = factor[:, None] * work[k, later]
        work = update_at(np.subtract, work, (..., later, later, _ALL), product)
    for k in range(count - 1, -1, -1):
        work = update_at(np.divide, work, (..., k, right, _ALL), work[k, k])
        product = work[:k, k, None] * work[k, right]
        work = update_at(np.subtract, work, (..., slice(k), right, _ALL), product)
    pull, level = work[:, count], work[:, count + 1]
    excess = (linalg.total(pull, 0) - 1.0) / linalg.total(level, 0)
    minimum: Array = pull - excess * level
    return minimum


def _exchange(weights: Array, gain: Array, curvature: Array) -> tuple[Array]:
    """Return weights (l, N) after a move from the estimate of the smallest gain to the largest."""
    xp, lanes, place = namespace(weights), np.arange(weights.shape[-1]), np.arange(len(gain))
    most = gain.argmax(0)
    least = xp.where(weights > 0.0, gain, np.inf).argmin(0)
    bend = curvature[most, most, lanes] + curvature[least, least, lanes]
    bend -= 2.0 * curvature[xp.minimum(most, least), xp.maximum(most, least), lanes]
    reach = weights[least, lanes]
    length = (gain[most, lanes] - gain[least, lanes]) / bend
    length = xp.where((length > 0.0) & (length < reach), length, reach)
    moved = weights + xp.where(place[:, None] == most, length, 0.0)
    return (moved - xp.where(place[:, None] == least, length, 0.0),)
