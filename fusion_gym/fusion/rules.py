"""What a fusion rule is, what it returns, and the two rules in closed form.

A rule in a file of its own is a subclass of :class:`FusionRule` and one row of the table in
:mod:`fusion_gym.fusion.table`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array

Active = NDArray[np.bool_] | None  # (l, N), the estimates that take part; all by default

# Relative. Above the rounding of Σ, so that weights stay below 1e6 and their covariance honest to
# 1e-4 in the worst case (1e-9 in the usual one); below any difference of estimates that matters.
_RIDGE = 1e-12


@dataclass(frozen=True)
class Fused:
    """The l estimates joined: x = Σ G_i x_i with Σ G_i = I.

    ``mean`` (n, N) · ``covariance`` (n, n, N), what the rule claims · ``weights`` (l, N), where a
    rule weighs covariances, >= 0 with sum 1. The gains are computed when they are first read, by
    ``find_gains``, whatever has become of the estimates by then. A lane in which no estimate takes
    part is NaN.
    """

    mean: Array
    covariance: Array
    find_gains: Callable[[], Array]
    weights: Array | None = None

    @cached_property
    def gains(self) -> Array:
        """G (l, n, n, N), zero for an estimate that takes no part.

        The actual covariance of the result is Σ_ij G_i P̄_ij G_jᵀ with the actual covariances P̄_ij
        of the estimates.
        """
        return self.find_gains()


class FusionRule(ABC):
    """Joins the estimates of several nodes, or of a centre and its nodes, in one."""

    @abstractmethod
    def fuse(
        self, means: Array, covariance: Array, active: Active = None, *, basis: Array | None = None
    ) -> Fused:
        """The active estimates joined.

        Args:
            means: (l, n, N).
            covariance: the estimates' own, (l, n, n, N), or the joint one of their errors,
                (l, l, n, n, N), of which most rules read the diagonal blocks alone.
            active: (l, N), the estimates that take part; all by default. Others are not read.
            basis: G (n, n, N) where the estimates, and the result, are of z with x = G z; weights
                then minimise the trace of G P Gᵀ. The identity by default.
        """

    def fuse_single(
        self, silent: Array, delivered: Array, basis: Array | None = None
    ) -> tuple[Array, Array]:
        """Fused covariances if nobody delivers (n, n, N), and (l, n, n, N) if each alone does.

        From the nodes' own covariances without and with a delivery, both (l, n, n, N).
        """
        nowhere = np.zeros(silent.shape[:2] + silent.shape[-1:])
        single = np.empty(silent.shape)
        for node in range(len(silent)):
            covariances = silent.copy()
            covariances[node] = delivered[node]
            single[node] = self.fuse(nowhere, covariances, basis=basis).covariance
        return self.fuse(nowhere, silent, basis=basis).covariance, single


def own_covariances(covariance: Array) -> Array:
    """The estimates' own covariances (l, n, n, N), also where the joint one is given."""
    if covariance.ndim == 4:
        return covariance
    return linalg.symmetrise(np.stack([covariance[i, i] for i in range(len(covariance))]))


@dataclass(frozen=True)
class InformationFusion(FusionRule):
    r"""Sum of the informations of independent estimates: P = (Σ P_i⁻¹)⁻¹, x = P Σ P_i⁻¹ x_i.

    It has no parameters. The result is optimal for independent errors, and for those of nodes
    that share a prior in shares of its information. A prior that several estimates have in full
    is counted as often as they do, and P is then too small.

    Equation:
        $$
        P=\left(\sum_i P_i^{-1}\right)^{-1},\qquad \hat x=P\sum_i P_i^{-1}x_i
        $$

        Of nodes that get the estimate back in shares wᵢ (``information_shares``):

        $$
        P_i\leftarrow P/w_i,\qquad x_i\leftarrow\hat x,\qquad \sum_i w_i=1
        $$

        so that the prior is counted once when the informations are added up.

    Assumes: independent errors, or nodes whose common prior was shared out among them.

    Source: tobit_token_bucket, equation (50).
    """

    def fuse(
        self, means: Array, covariance: Array, active: Active = None, *, basis: Array | None = None
    ) -> Fused:
        """See :class:`FusionRule`; a lane with a covariance that is not definite is NaN."""
        information = linalg.inverse(own_covariances(covariance))
        if active is not None:
            information = np.where(active[:, None, None], information, 0.0)
            means = np.where(active[:, None], means, 0.0)
        fused = linalg.inverse(information.sum(0))
        mean = linalg.matvec(fused, linalg.matvec(information, means).sum(0))
        return Fused(mean, fused, lambda: linalg.matmul(fused, information))

    def fuse_single(
        self, silent: Array, delivered: Array, basis: Array | None = None
    ) -> tuple[Array, Array]:
        """See :class:`FusionRule`: informations are sums."""
        information = linalg.inverse(silent)
        total = information.sum(0)
        gained = linalg.inverse(delivered) - information
        return linalg.inverse(total), linalg.inverse(total + gained)


@dataclass(frozen=True)
class MatrixWeightedFusion(FusionRule):
    r"""x = Σ A_i x_i with Σ A_i = I and the smallest error variance of all such sums.

    It needs the joint covariance. The weights of (56), (eᵀ Σ⁻¹ e)⁻¹ eᵀ Σ⁻¹ with e a column of
    identities, are those of the best linear correction of the first estimate by the differences
    D_i = x_i - x_1 of the others, x = x_1 - Cov(x_1, D) Cov(D)⁻¹ D. In this form the weights add
    up to I exactly, and Σ itself may be singular: it is whenever two estimates are the same. Then
    Cov(D) is singular too, and a relative ridge of 1e-12 on it stands for its pseudo-inverse. The
    result is that of (eᵀ T⁺ e)⁺ eᵀ T⁺ with T = Σ + e eᵀ. The covariance is
    weights · Σ · weightsᵀ of the given Σ, the true one for these weights.

    Equation:
        $$
        \hat x=\sum_i A_i x_i,\qquad (A_1,\dots,A_l)=(e^{\mathsf T}\Sigma^{-1}e)^{-1}e^{\mathsf
        T}\Sigma^{-1},\qquad P=A\,\Sigma\,A^{\mathsf T}
        $$

        Σ is the joint covariance of all errors, blocks Pᵢⱼ, and e a column of identities, so that
        Σᵢ Aᵢ = I. Where Σ is singular it is (eᵀ T⁺ e)⁺ eᵀ T⁺ with T = Σ + e eᵀ.

    Assumes: the joint covariance of all errors is known, cross-covariances included; no
    Gaussian law is needed.

    Source: markov_jump, equations (55)-(57); the printed (57), (eᵀ Σ⁻¹ e)⁻¹, needs a regular Σ.
    """

    def weights(self, joint: Array) -> Array:
        """Weights A (l, n, n, N) for a joint covariance (l, l, n, n, N)."""
        count, n, runs = len(joint), joint.shape[2], joint.shape[-1]
        weights = np.zeros((count, n, n, runs))
        for state in range(n):
            weights[0, state, state] = 1.0
        if count == 1:
            return weights
        toward = joint[1:, 0] - joint[0, 0]  # Cov(D_i, x_1)
        spread = joint[1:, 1:] - joint[0, 1:] - toward[:, None]
        own = linalg.diagonal(own_covariances(joint))
        ridge = _RIDGE * (own[0] + own[1:])
        ridge[ridge < np.finfo(np.float64).tiny] = 1.0  # of what all know exactly
        size = (count - 1) * n
        spread = spread.swapaxes(1, 2).reshape(size, size, runs)
        ridge, toward = ridge.reshape(size, runs), toward.reshape(size, n, runs)
        solved = linalg.solve(linalg.add_diagonal(spread, ridge), toward)
        (lanes,) = np.nonzero(np.isnan(solved).any((0, 1)))  # rounding has left it indefinite
        if lanes.size:
            definite = linalg.gram(linalg.root(spread[..., lanes]))
            definite = linalg.add_diagonal(definite, ridge[:, lanes])
            solved[..., lanes] = linalg.solve(definite, toward[..., lanes])
        weights[1:] = -linalg.transpose(solved.reshape(count - 1, n, n, runs))
        weights[0] -= weights[1:].sum(0)
        return weights

    def fuse(
        self, means: Array, covariance: Array, active: Active = None, *, basis: Array | None = None
    ) -> Fused:
        """See :class:`FusionRule`.

        Args:
            means: (l, n, N).
            covariance: (l, l, n, n, N), that of all errors, positive semi-definite.
            active: (l, N); all by default.
        """
        if active is not None:
            return self._fuse_sets(means, covariance, active)
        count, n, runs = means.shape
        weights = self.weights(covariance)
        row = weights.swapaxes(0, 1).reshape(n, count * n, runs)
        sigma = covariance.swapaxes(1, 2).reshape(count * n, count * n, runs)
        mean = linalg.matvec(row, means.reshape(count * n, runs))
        return Fused(mean, linalg.congruence(row, sigma), lambda: weights)

    def _fuse_sets(self, means: Array, joint: Array, active: NDArray[np.bool_]) -> Fused:
        """Lanes with the same active estimates together, as if there were no others."""
        mean, fused = np.full(means.shape[1:], np.nan), np.full(joint.shape[2:], np.nan)
        gains = np.zeros(joint.shape[1:])
        for selected in np.unique(active, axis=1).T:
            nodes, lanes = np.flatnonzero(selected), np.flatnonzero((selected == active.T).all(1))
            if nodes.size:
                part = self.fuse(means[nodes][..., lanes], joint[np.ix_(nodes, nodes)][..., lanes])
                mean[:, lanes], fused[..., lanes] = part.mean, part.covariance
                for node, gain in zip(nodes, part.gains, strict=True):
                    gains[node][..., lanes] = gain
        return Fused(mean, fused, lambda: gains)
