"""Covariance intersection of several nodes' estimates of a state and an input.

State and input are fused separately, each by (24) with weights of the smallest trace (25). The
cross-covariance of the two results is unknown and set to zero.

Source: unknown_input, equations (24)-(26).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.fusion.rules import Active, Fused, FusionRule, own_covariances
from fusion_gym.fusion.several import (
    CovarianceIntersection,
    covariance_intersection_many,
    is_regular,
)
from fusion_gym.namespace import in_runs, namespace, put_runs, set_at

_GAP = 0.01  # relative gap at which the tracked weights rest
_STEPS = 4  # evaluations of the tracked weights at a time, at most
_FLOOR = 1e-3  # a tracked weight stays above, so that it can come back


@dataclass(frozen=True)
class NodeFusion(FusionRule):
    """The centre's rule for l nodes with n states and q inputs.

    ``rule`` joins the ``states`` n entries of the nodes' states, and their inputs. With
    :class:`~fusion_gym.fusion.several.CovarianceIntersection` and ``tracked``, its weights follow
    the smallest trace from one time to the next (:func:`tracked_intersection`), starting from the
    weights of :meth:`going_on`.

    Covariance intersection gives a bound for every correlation of the nodes' errors, provided that
    the nodes' covariances are bounds. Its inverse form does not, because the errors share process
    noise.
    """

    rule: FusionRule
    states: int
    tracked: bool = False
    state_weights: Array | None = None
    weights: Array | None = None

    def start(self, nodes: int, runs: int) -> Array | None:
        """Return equal weights (l, N) if weights are tracked."""
        return np.full((nodes, runs), 1.0 / nodes) if self.tracked else None

    def going_on(self, weights: Array | None) -> NodeFusion:
        """Return the rule that starts from the last weights (l, N)."""
        return self if weights is None else replace(self, weights=weights)

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
        if isinstance(rule, CovarianceIntersection):
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
    :func:`covariance_intersection_many`.

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
    singular: Any = ~is_regular(covariance, information).all(0)

    def best(mean: Array, covariance: Array, basis: Array | None = None) -> tuple[Any, ...]:
        found = covariance_intersection_many(mean, covariance, basis=basis)
        return found.mean, found.covariance, found.weights, found.gains

    arguments = (mean, covariance) if basis is None else (mean, covariance, basis)
    results = joined, fused, weights, xp.zeros(covariance.shape)
    joined, fused, weights, own = in_runs(singular[None], best, arguments, results)

    def gains() -> Array:
        every = linalg.matmul(fused, weights[:, None, None] * information)
        return xp.where(singular, own, every)

    return Fused(joined, fused, gains, weights)
