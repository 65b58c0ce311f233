"""Joint error covariance of the nodes' estimates and the centre's copies, for any requests.

Source: markov_jump (event-triggered distributed fusion estimation for asynchronous Markov jump
systems with correlated noises and fading measurements).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.namespace import namespace, take
from fusion_gym.systems.markov_jump.linear_minimum_variance import ROUNDING, LocalFilters, Times


class LagCovariances(NamedTuple):
    """Covariances of the lags d_i, node i's prediction minus the centre's copy of it, at k|k-1.

    ``lag`` E d_i d_jᵀ (l (l + 1)/2, a, a, N), the pairs i <= j in the order (0, 0), (0, 1), … ·
    ``crossed`` E d_i L_jᵀ (l (l - 1), a, a, N) with the node's error L_j, the pairs i ≠ j in the
    order (0, 1), (0, 2), …
    """

    lag: Array
    crossed: Array


class JointPrediction(NamedTuple):
    """Covariances after the nodes' update at time k, before a transmission, in the plant's states.

    ``local`` E L⁺_i L⁺_jᵀ, ``crossed`` E d⁺_i L⁺_jᵀ and ``lag`` E d⁺_i d⁺_jᵀ, each (l, l, n, n, N),
    with L⁺ the nodes' errors and d⁺ their lags before a transmission. The copy of a node has the
    error L⁺_i after a transmission, else L⁺_i + d⁺_i. A variance below ``floor`` (l, n, N) is the
    rounding of a sum over modes and counts as zero.
    """

    local: Array
    crossed: Array
    lag: Array
    floor: Array

    def joint(self, sent: NDArray[np.bool_]) -> Array:
        """Return the covariance of the copies' errors (l, l, n, n, N) after packets (l, N)."""
        behind = 1.0 - sent
        crossed = behind[:, None, None, None] * self.crossed
        result = crossed + crossed.swapaxes(0, 1).swapaxes(2, 3)
        result += self.local
        result += (behind[:, None] * behind[None])[:, :, None, None] * self.lag
        xp = namespace(result)
        certain = xp.einsum("iissN->isN", result) <= self.floor
        if xp is np and not certain.any():
            return result
        return xp.where(certain[:, None, :, None] | certain[None, :, None], 0.0, result)


@dataclass(frozen=True)
class LagRecursion:
    """The joint recursion of the errors of nodes and centre, in the lags.

    The errors of the nodes, L_i, and their covariances depend on time only. The error of the
    centre's copy is F_i = L_i + d_i with the lag d_i, the node's estimate minus its copy. A packet
    sets the lag to zero; otherwise d_i' = Ā d_i + u_i ε_i, driven by the node's innovations only:

    - E d_i' L_j'ᵀ = s_i [Ā D Āᵀ - Ā y_ij u_jᵀ + u_i E(ε_i L_j')ᵀ], D = E d_i L_jᵀ, y_ij = D c_jᵀ; -
    E d_i' d_j'ᵀ = s_i s_j [Ā D Āᵀ + Ā y_ij u_jᵀ + u_i (Ā y_ji)ᵀ + u_i u_jᵀ E ε_i ε_j],   D = E d_i
    d_jᵀ,

    with s_i = 0 after a transmission of node i and 1 otherwise. E d_i L_iᵀ = 0, because a node's
    error is orthogonal to its measurements. The result is the exact (2 l a)² recursion for every
    pattern of packets that does not depend on the noise; the paper's (46)-(50) hold at full rate
    only.

    ``filters`` holds the tables by time; ``states`` is n.
    """

    filters: LocalFilters
    states: int
    local: Array  # E L⁺_i L⁺_jᵀ, (l, l, n, n, T)
    floor: Array  # the rounding of its variances, (l, n, T)
    gain: Array  # K, (l, n, T)
    filtered_cross: Array  # E ε_i L⁺_j, (l, l, n, T)

    @classmethod
    def create(cls, filters: LocalFilters, states: int) -> LagRecursion:
        """Return the recursion of the nodes' tables and the number n of the plant's states."""
        count, size, steps = filters.gain.shape
        modes = size // states
        blocks = filters.covariance.reshape(count, count, modes, states, modes, states, steps)
        crosses = filters.filtered_cross.reshape(count, count, modes, states, steps)
        own = np.abs(np.einsum("iimskst->imkst", blocks)).sum((1, 2))
        return cls(
            filters=filters,
            states=states,
            local=blocks.sum((2, 4)),
            floor=ROUNDING * own,
            gain=filters.gain.reshape(count, modes, states, steps).sum(1),
            filtered_cross=crosses.sum(2),
        )

    @property
    def local_trace(self) -> Array:
        """Trace of each node's error covariance after the update, (l, T), in the states."""
        count = len(self.local)
        return np.stack([linalg.trace(self.local[node, node]) for node in range(count)])

    def start(self, runs: int) -> LagCovariances:
        """Return zero lags: at k = 0 the copies are the nodes' estimates."""
        count, size, _ = self.filters.gain.shape
        return LagCovariances(
            np.zeros((count * (count + 1) // 2, size, size, runs)),
            np.zeros((count * (count - 1), size, size, runs)),
        )

    def predict(self, now: LagCovariances, sent: NDArray[np.bool_], place: Times) -> LagCovariances:
        """Return the covariances at k+1|k after ``sent`` (l, N), with the ``place`` (N,) of k."""
        filters, silent = self.filters, 1.0 - sent
        count, transition = len(silent), filters.transition
        moved = linalg.transpose(transition)
        step = take(filters.step, place)
        innovation = take(filters.innovation_covariance, place)
        ahead = take(filters.predicted_cross, place)
        carried: dict[tuple[int, int], Array] = {}
        crossed, lag = [], []
        for row, (i, j) in enumerate(_ordered(count)):
            block = linalg.matmul(transition, now.crossed[row])
            carried[i, j] = linalg.matvec(block, filters.measurement_matrix[j])
            block = linalg.matmul(block, moved)
            block -= linalg.outer(carried[i, j], step[j])
            block += linalg.outer(step[i], ahead[i, j])
            block *= silent[i]
            crossed.append(block)
        for row, (i, j) in enumerate(_pairs(count)):
            if i == j:
                block = linalg.congruence(transition, now.lag[row])
                block += linalg.outer(step[i], innovation[i, i] * step[i])
                block *= silent[i]
            else:
                block = linalg.matmul(transition, now.lag[row])
                block = linalg.matmul(block, moved)
                block += linalg.outer(carried[i, j], step[j])
                block += linalg.outer(step[i], carried[j, i] + innovation[i, j] * step[j])
                block *= silent[i] * silent[j]
            lag.append(block)
        return LagCovariances(_stacked(lag, now.lag), _stacked(crossed, now.crossed))

    def prediction(self, now: LagCovariances, place: Times) -> JointPrediction:
        """Return the covariances after the nodes' update at the time with the ``place`` (N,)."""
        filters, n, count = self.filters, self.states, len(self.filters.gain)
        shape = (count, count, n, n, len(place))
        gain = take(self.gain, place)
        innovation = take(filters.innovation_covariance, place)
        filtered = take(self.filtered_cross, place)
        crossed: dict[tuple[int, int], Array] = {}
        lag: dict[tuple[int, int], Array] = {}
        observed: dict[tuple[int, int], Array] = {}
        for row, (i, j) in enumerate(_ordered(count)):
            rows = _collapse(now.crossed[row], n)
            observed[i, j] = linalg.matvec(rows, filters.measurement_matrix[j])
            block = _collapse(rows.swapaxes(0, 1), n).swapaxes(0, 1)
            block = block - linalg.outer(observed[i, j], gain[j])
            block += linalg.outer(gain[i], filtered[i, j])
            crossed[i, j] = block
        for row, (i, j) in enumerate(_pairs(count)):
            block = _collapse(_collapse(now.lag[row], n).swapaxes(0, 1), n).swapaxes(0, 1)
            right = innovation[i, j] * gain[j]
            if i != j:
                block = block + linalg.outer(observed[i, j], gain[j])
                right += observed[j, i]
            lag[i, j] = block + linalg.outer(gain[i], right)
            if i != j:
                lag[j, i] = linalg.transpose(lag[i, j])
        nothing, pairs = np.zeros(shape[2:]), list(np.ndindex(count, count))
        whole = [
            _stacked([blocks.get(pair, nothing) for pair in pairs], now.lag).reshape(shape)
            for blocks in (crossed, lag)
        ]
        return JointPrediction(take(self.local, place), whole[0], whole[1], take(self.floor, place))


def _stacked(blocks: list[Array], before: Array) -> Array:
    """Return the blocks as one array, or ``before`` if there are none."""
    if not blocks:
        return before
    return namespace(before).concatenate(blocks).reshape(-1, *blocks[0].shape)


def _ordered(count: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(count) for j in range(count) if i != j]


def _pairs(count: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(count) for j in range(i, count)]


def _collapse(rows: Array, states: int) -> Array:
    """Return the sum of the modes' parts of the first axis: (modes · n, ...) to (n, ...)."""
    return linalg.total(rows.reshape(-1, states, *rows.shape[1:]), 0)
