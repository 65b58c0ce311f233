"""Covariance intersection of several nodes' estimates of a state and an input.

State and input are fused separately, each by (24) with weights of the smallest trace (25). The
two results' cross-covariance is not known and stands as zero.

Source: unknown_input, equations (24)-(26).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.fusion.covariance_intersection import (
    covariance_intersection_many,
)
from fusion_gym.fusion.sequential import SequentialFusion

_GAP = 0.01  # relative gap at which the tracked weights rest
_STEPS = 4  # evaluations of the tracked weights at a time, at most
_FLOOR = 1e-3  # a tracked weight stays above, so that it can come back


class FusedEstimate(NamedTuple):
    """``mean`` (s, N), ``covariance`` (s, s, N) with zero blocks between state and input, and the
    state's ``weights`` (l, N), from which a search may go on at the next time."""

    mean: Array
    covariance: Array
    weights: Array


@dataclass(frozen=True)
class NodeFusion:
    """The centre's rule for l nodes with n states and q inputs.

    ``rule`` is one of

    - ``"ci"``: weights near the smallest trace, tracked from one time to the next
      (:func:`tracked_intersection`);
    - ``"exact_ci"``: the weights of the smallest trace, searched anew every time;
    - ``"sci"``: two at a time, in the order of the sensors, each pair with its best weight;
    - ``"ici"``: inverse covariance intersection of two nodes, ``"sici"`` of several in turn.

    The first three give a bound for every correlation of the nodes' errors, provided that the
    nodes' covariances are bounds. The last two do not, for the errors share process noise.
    """

    rule: str
    states: int

    def exact(self) -> NodeFusion:
        """The same rule with its best weights instead of tracked ones."""
        return NodeFusion("exact_ci", self.states) if self.rule == "ci" else self

    def start(self, nodes: int, runs: int) -> Array:
        """Equal weights (l, N)."""
        return np.full((nodes, runs), 1.0 / nodes)

    def fuse(self, mean: Array, covariance: Array, weights: Array) -> FusedEstimate:
        """Means (l, s, N) and covariances (l, s, s, N) fused; ``weights`` (l, N) to go on from."""
        n = self.states
        state = self._block(mean[:, :n], covariance[:, :n, :n], weights)
        inputs = self._block(mean[:, n:], covariance[:, n:, n:], weights)
        joint = np.zeros(covariance.shape[1:])
        joint[:n, :n], joint[n:, n:] = state.covariance, inputs.covariance
        return FusedEstimate(np.concatenate((state.mean, inputs.mean)), joint, state.weights)

    def _block(self, mean: Array, covariance: Array, weights: Array) -> FusedEstimate:
        if len(mean) == 1:
            return FusedEstimate(mean[0], covariance[0], weights)
        if self.rule in ("sci", "ici", "sici"):
            fused = SequentialFusion("ci" if self.rule == "sci" else "ici").fuse(
                mean[0],
                covariance[0],
                mean[1:],
                covariance[1:],
                np.ones((len(mean) - 1, mean.shape[-1]), dtype=np.bool_),
            )
            return FusedEstimate(fused.mean, fused.covariance, weights)
        if mean.shape[1] == 1:
            return _smallest_variance(mean, covariance)
        if self.rule == "exact_ci":
            return FusedEstimate(*covariance_intersection_many(mean, covariance))
        return tracked_intersection(mean, covariance, weights)


def _smallest_variance(mean: Array, covariance: Array) -> FusedEstimate:
    """Covariance intersection of scalars: the smallest variance takes all, equals share."""
    smallest = covariance.min(0)
    chosen = (covariance == smallest)[:, 0, 0]
    weights = chosen / chosen.sum(0)
    return FusedEstimate((weights[:, None] * mean).sum(0), smallest, weights)


def tracked_intersection(mean: Array, covariance: Array, weights: Array) -> FusedEstimate:
    """Covariance intersection with weights that follow the smallest trace over time.

    From the given weights (l, N) on, w_i ← w_i √tr(P Y_i P), normalised, with Y_i = P_i⁻¹ and
    P = (Σ w_i Y_i)⁻¹, until the trace of P is within 1 % of its minimum: the gap is at most
    max_i tr(P Y_i P) - tr P. At most four evaluations are made at a time; the search goes on at
    the next. Every P on the way is a bound, since any weights give one.

    Args:
        mean: (l, n, N).
        covariance: (l, n, n, N), symmetric positive definite.
        weights: (l, N), not negative, of sum 1.
    """
    information = linalg.inverse(covariance)
    nodes, n = mean.shape[:2]
    vectors = linalg.matvec(information, mean)
    weights = np.maximum(weights, _FLOOR)
    weights /= _sum(weights)
    lanes: slice | np.ndarray = slice(None)
    fused = np.empty(covariance.shape[1:])
    for step in range(_STEPS):
        part, some = information[..., lanes], weights[:, lanes]
        bound = linalg.inverse(_sum(some[:, None, None] * part))
        fused[..., lanes] = bound
        if step == _STEPS - 1:
            break
        square = linalg.matmul(bound, bound)
        gain = _sum((part * square).reshape(nodes, n * n, -1).swapaxes(0, 1))
        total = linalg.trace(bound)
        still = gain.max(0) > (1.0 + _GAP) * total
        if not still.any():
            break
        lanes = np.flatnonzero(still) if isinstance(lanes, slice) else lanes[still]
        moved = np.maximum(some[:, still] * np.sqrt(gain[:, still]), _FLOOR**2)
        weights[:, lanes] = moved / _sum(moved)
    return FusedEstimate(linalg.matvec(fused, _sum(weights[:, None] * vectors)), fused, weights)


def _sum(a: Array) -> Array:
    """Sum over the first axis, in ascending order."""
    total: Array = a[0].copy()
    for k in range(1, len(a)):
        total += a[k]
    return total
