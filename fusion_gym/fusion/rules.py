"""The interface of a fusion rule, its result, and the two rules in closed form.

A new rule is a subclass of :class:`FusionRule` and a row of the table in
:mod:`fusion_gym.fusion.table`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.namespace import in_runs, namespace

Active = NDArray[np.bool_] | None  # (l, N), the active estimates; all by default

# Relative ridge above the rounding of Σ: weights stay below 1e6, their covariance is accurate to
# 1e-4 in the worst case and usually to 1e-9.
_RIDGE = 1e-12


@dataclass(frozen=True)
class Fused:
    """The fused estimate of l estimates: x = Σ G_i x_i with Σ G_i = I.

    Args:
        mean: (n, N), NaN in a run without active estimates.
        covariance: Estimated covariance (n, n, N).
        find_gains: Function that computes the gains on first access.
        weights: (l, N), >= 0 with sum 1, of a rule that weighs covariances.
    """

    mean: Array
    covariance: Array
    find_gains: Callable[[], Array]
    weights: Array | None = None

    @cached_property
    def gains(self) -> Array:
        """G (l, n, n, N), zero for an inactive estimate.

        The actual covariance of the result is Σ_ij G_i P̄_ij G_jᵀ with the actual covariances P̄_ij
        of the estimates.
        """
        return self.find_gains()


class FusionRule(ABC):
    """A rule that joins the estimates of several nodes, or of a centre and its nodes."""

    @abstractmethod
    def fuse(
        self, means: Array, covariance: Array, active: Active = None, *, basis: Array | None = None
    ) -> Fused:
        """Return the fused active estimates.

        Args:
            means: (l, n, N).
            covariance: The estimates' own, (l, n, n, N), or the joint one of their errors,
                (l, l, n, n, N), of which most rules read only the diagonal blocks.
            active: (l, N) bool, the estimates to join; all by default. Others are not read.
            basis: G (n, n, N) if the estimates and the result are of z with x = G z; weights then
                minimise the trace of G P Gᵀ. The identity by default.
        """

    def with_weights(self, state_weights: Array | None) -> Self:
        """Return the rule for a trace with the weights (n,) of the states, if it uses a trace."""
        return self

    def fuse_single(
        self, silent: Array, delivered: Array, basis: Array | None = None
    ) -> tuple[Array, Array]:
        """Return the fused covariances without a delivery and after single deliveries.

        Args:
            silent: The nodes' covariances (l, n, n, N) without a delivery.
            delivered: The nodes' covariances (l, n, n, N) after a delivery.
            basis: As in :meth:`fuse`.

        Returns:
            (n, n, N) without a delivery, and (l, n, n, N), entry i after node i's delivery only.
        """
        nowhere = np.zeros(silent.shape[:2] + silent.shape[-1:])
        xp, single = namespace(silent, delivered), []
        for node in range(len(silent)):
            parts = silent[:node], delivered[node : node + 1], silent[node + 1 :]
            single.append(self.fuse(nowhere, xp.concatenate(parts), basis=basis).covariance)
        return self.fuse(nowhere, silent, basis=basis).covariance, xp.stack(single)


@dataclass(frozen=True)
class SmallestTrace(FusionRule):
    """A rule whose result has the smallest trace Σ w_i P_ii; ``state_weights`` w (n,), or all 1."""

    state_weights: Array | None = field(default=None, kw_only=True)

    def with_weights(self, state_weights: Array | None) -> Self:
        """See :class:`FusionRule`; equal weights leave the plain trace."""
        differ = state_weights is not None and np.ptp(state_weights) > 0.0
        return replace(self, state_weights=state_weights if differ else None)

    def metric(self, covariance: Array, basis: Array | None) -> Array | None:
        """Return √W G (n, n, N) of the trace of (√W G) P (√W G)ᵀ; ``None`` for the identity."""
        if self.state_weights is None:
            return basis
        plain = linalg.identity(len(self.state_weights)) if basis is None else basis
        weighted = np.sqrt(self.state_weights)[:, None, None] * plain
        return namespace(weighted).broadcast_to(weighted, covariance.shape[-3:])


def own_covariances(covariance: Array) -> Array:
    """Return the estimates' own covariances (l, n, n, N), also from the joint covariance."""
    if covariance.ndim == 4:
        return covariance
    own = [covariance[i, i] for i in range(len(covariance))]
    return linalg.symmetrise(namespace(covariance).stack(own))


@dataclass(frozen=True)
class InformationFusion(FusionRule):
    r"""Sum of the informations of independent estimates: P = (Σ P_i⁻¹)⁻¹, x = P Σ P_i⁻¹ x_i.

    It has no parameters. The result is optimal for independent errors, and for nodes that share a
    prior in shares of its information. If several estimates contain a whole prior, the sum counts
    it once per estimate, and P is too small.

    Equation:
        $$
        P=\left(\sum_i P_i^{-1}\right)^{-1},\qquad \hat x=P\sum_i P_i^{-1}x_i
        $$

        For nodes that receive the estimate in shares wᵢ (``information_shares``):

        $$
        P_i\leftarrow P/w_i,\qquad x_i\leftarrow\hat x,\qquad \sum_i w_i=1
        $$

        so that the sum counts the prior once.

    Assumes: independent errors, or nodes with shares of one common prior.

    Source: tobit_token_bucket, equation (50).
    """

    def fuse(
        self, means: Array, covariance: Array, active: Active = None, *, basis: Array | None = None
    ) -> Fused:
        """Return the fused active estimates, NaN where a covariance is not definite."""
        information = linalg.inverse(own_covariances(covariance))
        if active is not None:
            xp = namespace(active, information)
            information = xp.where(active[:, None, None], information, 0.0)
            means = xp.where(active[:, None], means, 0.0)
        fused = linalg.inverse(linalg.total(information, 0))
        mean = linalg.matvec(fused, linalg.total(linalg.matvec(information, means), 0))
        return Fused(mean, fused, lambda: linalg.matmul(fused, information))

    def fuse_single(
        self, silent: Array, delivered: Array, basis: Array | None = None
    ) -> tuple[Array, Array]:
        """Return fused covariances from sums of informations."""
        information = linalg.inverse(silent)
        total = linalg.total(information, 0)
        gained = linalg.inverse(delivered) - information
        return linalg.inverse(total), linalg.inverse(total + gained)


@dataclass(frozen=True)
class MatrixWeightedFusion(FusionRule):
    r"""x = Σ A_i x_i with Σ A_i = I and the smallest error variance of all such sums.

    It needs the joint covariance. The weights of (56), (eᵀ Σ⁻¹ e)⁻¹ eᵀ Σ⁻¹ with e a column of
    identities, equal the best linear correction of the first estimate by the differences
    D_i = x_i - x_1 of the others, x = x_1 - Cov(x_1, D) Cov(D)⁻¹ D. In this form the weights add
    up to I exactly, and Σ may be singular, as for two equal estimates. Then
    Cov(D) is singular too, and a relative ridge of 1e-12 approximates its pseudo-inverse. The
    result is (eᵀ T⁺ e)⁺ eᵀ T⁺ with T = Σ + e eᵀ. The covariance is
    weights · Σ · weightsᵀ of the given Σ, the true one for these weights.

    Equation:
        $$
        \hat x=\sum_i A_i x_i,\qquad (A_1,\dots,A_l)=(e^{\mathsf T}\Sigma^{-1}e)^{-1}e^{\mathsf
        T}\Sigma^{-1},\qquad P=A\,\Sigma\,A^{\mathsf T}
        $$

        Σ is the joint covariance of all errors, blocks Pᵢⱼ, and e a column of identities, so that
        Σᵢ Aᵢ = I. Where Σ is singular it is (eᵀ T⁺ e)⁺ eᵀ T⁺ with T = Σ + e eᵀ.

    Assumes: the joint covariance of all errors is known, cross-covariances included; no
    Gaussian distribution is needed.

    Source: markov_jump, equations (55)-(57); the printed (57), (eᵀ Σ⁻¹ e)⁻¹, needs a regular Σ.
    """

    def weights(self, joint: Array) -> Array:
        """Return the weights A (l, n, n, N) for a joint covariance (l, l, n, n, N)."""
        xp, count, n, runs = namespace(joint), len(joint), joint.shape[2], joint.shape[-1]
        if count == 1:
            return np.broadcast_to(linalg.identity(n), joint.shape[1:])
        toward = joint[1:, 0] - joint[0, 0]  # Cov(D_i, x_1)
        spread = joint[1:, 1:] - joint[0, 1:] - toward[:, None]
        own = linalg.diagonal(own_covariances(joint))
        ridge = _RIDGE * (own[0] + own[1:])
        # It is 1 where all variances are zero.
        ridge = xp.where(ridge < np.finfo(np.float64).tiny, 1.0, ridge)
        size = (count - 1) * n
        spread = spread.swapaxes(1, 2).reshape(size, size, runs)
        ridge, toward = ridge.reshape(size, runs), toward.reshape(size, n, runs)
        solved = linalg.solve(linalg.add_diagonal(spread, ridge), toward)
        rounded = xp.isnan(solved)  # rounding made the matrix indefinite
        (solved,) = in_runs(rounded, _solve_definite, (spread, ridge, toward), (solved,))
        others = -linalg.transpose(solved.reshape(count - 1, n, n, runs))
        first = linalg.identity(n) - linalg.total(others, 0)
        return xp.concatenate((first[None], others))

    def fuse(
        self, means: Array, covariance: Array, active: Active = None, *, basis: Array | None = None
    ) -> Fused:
        """Return the fused estimates.

        Args:
            means: (l, n, N).
            covariance: Joint covariance (l, l, n, n, N) of all errors, positive semi-definite.
            active: None: the rule joins all estimates, never some of them.
            basis: Ignored, because the weights do not depend on it.
        """
        if active is not None:
            raise ValueError("active is not allowed with the rule 'matrix': it joins all estimates")
        count, n, runs = means.shape
        weights = self.weights(covariance)
        row = weights.swapaxes(0, 1).reshape(n, count * n, runs)
        sigma = covariance.swapaxes(1, 2).reshape(count * n, count * n, runs)
        mean = linalg.matvec(row, means.reshape(count * n, runs))
        return Fused(mean, linalg.congruence(row, sigma), lambda: weights)


def _solve_definite(spread: Array, ridge: Array, toward: Array) -> tuple[Array]:
    definite = linalg.add_diagonal(linalg.gram(linalg.root(spread)), ridge)
    return (linalg.solve(definite, toward),)
