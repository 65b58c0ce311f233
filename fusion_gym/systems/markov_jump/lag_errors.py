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

    ``lag`` E d_i d_jᵀ (l (l + 1)/2, a, a, N), first i = j, then the pairs i < j in the order (0,
    1), (0, 2), … · ``crossed`` E d_i L_jᵀ (l (l - 1), a, a, N) with the node's error L_j, first
    these pairs, then the same with i and j exchanged.
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
        filters, xp = self.filters, namespace(now.lag, sent)
        silent = 1.0 - sent[:, None, None]
        transition, count = filters.transition, len(silent)
        nodes, step = np.arange(count), take(filters.step, place)
        innovation = take(filters.innovation_covariance, place)[..., None, :]
        ahead = take(filters.predicted_cross, place)
        first, second = self._pairs
        half, back = len(first), linalg.transpose(transition)
        carried, crossed = [], []
        for i, j, block in zip(
            (first, second), (second, first), (now.crossed[:half], now.crossed[half:]), strict=True
        ):
            block = linalg.matmul(transition, block)
            carried.append(linalg.matvec(block, filters.measurement_matrix[j]))
            block = linalg.matmul(block, back)
            block -= linalg.outer(carried[-1], step[j])
            block += linalg.outer(step[i], ahead[i, j])
            block *= silent[i]
            crossed.append(block)
        own = linalg.congruence(transition, now.lag[:count])
        own += linalg.outer(step, innovation[nodes, nodes] * step)
        own *= silent
        lag = linalg.matmul(linalg.matmul(transition, now.lag[count:]), back)
        lag += linalg.outer(carried[0], step[second])
        lag += linalg.outer(step[first], carried[1] + innovation[first, second] * step[second])
        lag *= silent[first] * silent[second]
        return LagCovariances(xp.concatenate((own, lag)), xp.concatenate(crossed))

    def prediction(self, now: LagCovariances, place: Times) -> JointPrediction:
        """Return the covariances after the nodes' update at the time with the ``place`` (N,)."""
        filters, xp, count = self.filters, namespace(now.lag, place), len(self.filters.gain)
        nodes, gain = np.arange(count), take(self.gain, place)
        innovation = take(filters.innovation_covariance, place)[..., None, :]
        filtered = take(self.filtered_cross, place)
        first, second = self._pairs
        half, i, j = len(first), np.append(first, second), np.append(second, first)
        rows = self._collapse(now.crossed)
        observed = linalg.matvec(rows, filters.measurement_matrix[j])
        crossed = self._collapse(rows.swapaxes(1, 2)).swapaxes(1, 2)
        crossed = crossed - linalg.outer(observed, gain[j])
        crossed += linalg.outer(gain[i], filtered[i, j])
        lag = self._collapse(self._collapse(now.lag).swapaxes(1, 2)).swapaxes(1, 2)
        own, lag = lag[:count], lag[count:]
        own = own + linalg.outer(gain, innovation[nodes, nodes] * gain)
        right = innovation[first, second] * gain[second] + observed[half:]
        lag = lag + linalg.outer(observed[:half], gain[second])
        lag += linalg.outer(gain[first], right)
        places = np.concatenate((nodes * (count + 1), i * count + j))
        order = places.argsort().reshape(count, count)
        return JointPrediction(
            take(self.local, place),
            xp.concatenate((xp.zeros_like(own), crossed))[order],
            xp.concatenate((own, lag, linalg.transpose(lag)))[order],
            take(self.floor, place),
        )

    @property
    def _pairs(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Nodes i and j of the pairs i < j."""
        first, second = np.triu_indices(len(self.filters.gain), 1)
        return first, second

    def _collapse(self, rows: Array) -> Array:
        """Return the sum of the modes' parts of the second axis: (p, a, ...) to (p, n, ...)."""
        pairs, size, *rest = rows.shape
        parts = rows.reshape(pairs, size // self.states, self.states, *rest)
        return linalg.total(parts, 1)
