"""Linear plant x' = A x + w with a process covariance of any rank."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.nature import true_motion

_CANCELLED = 1e-3  # of what is summed; what is left has lost three digits


def covariance_factor(matrix: Array) -> Array:
    """A factor F of shape (n, rank) with F Fᵀ = matrix, for any positive semi-definite matrix."""
    factor = linalg.root(matrix[..., None])[..., 0]
    return np.ascontiguousarray(factor[:, factor.any(0)])


@dataclass(frozen=True)
class Plant:
    """What linear plants have in common: A, the noise w ~ N(0, W), the law of x(0).

    Shapes: ``transition`` A (n, n, 1), ``process_covariance`` W (n, n, 1), ``process_factor``
    (n, r, 1) with r the rank of W, ``initial_mean`` (n, 1), ``initial_covariance`` (n, n, 1),
    ``initial_factor`` (n, n, 1).
    """

    transition: Array
    process_covariance: Array
    process_factor: Array
    initial_mean: Array
    initial_covariance: Array
    initial_factor: Array

    @property
    def size(self) -> int:
        """Number of states n."""
        return self.transition.shape[0]

    @property
    def noise_channels(self) -> int:
        """Standard normals that one step consumes: the rank of the process covariance."""
        return self.process_factor.shape[1]

    def true_radius(self, factor: float) -> float:
        """Spectral radius of I + c (A - I)."""
        still = np.eye(self.size)
        moved = still + factor * (self.transition[..., 0] - still)
        return float(np.abs(np.linalg.eigvals(moved)).max())

    @property
    def unmoved(self) -> tuple[str, ...]:
        """The options of the true plant that can change nothing."""
        still = np.array_equal(self.transition[..., 0], np.eye(self.size))
        result = {"true_process_noise": not self.process_factor.any(), "true_transition": still}
        return tuple(name for name, absent in result.items() if absent)


@dataclass(frozen=True)
class LinearPlant(Plant):
    """x(t+1) = A x(t) + w(t), w ~ N(0, W), x(0) ~ N(initial_mean, initial_covariance).

    Build one with :meth:`create`, which checks its arguments.

    Source: tobit_token_bucket, equation (1).
    """

    @classmethod
    def create(
        cls,
        transition: ArrayLike,
        process_covariance: ArrayLike,
        initial_mean: ArrayLike,
        initial_covariance: ArrayLike,
    ) -> LinearPlant:
        """Check the plain matrices (no batch axis) and prepare their factors.

        Raises:
            ConfigurationError: a wrong shape, a non-finite entry, or a covariance that is not
                symmetric positive semi-definite.
        """
        matrix = validation.square("transition", transition)
        size = len(matrix)
        process = validation.covariance("process_covariance", process_covariance, size)
        start = validation.covariance("initial_covariance", initial_covariance, size)
        return cls(
            transition=matrix[..., None],
            process_covariance=process[..., None],
            process_factor=covariance_factor(process)[..., None],
            initial_mean=validation.array("initial_mean", initial_mean, (size,))[..., None],
            initial_covariance=start[..., None],
            initial_factor=linalg.root(start[..., None]),
        )

    def start(self, mean: Array, noise: Array) -> Array:
        """Draw x(0), shape (n, N), about ``mean`` (n, N) from standard normals (n, N)."""
        return mean + linalg.matvec(self.initial_factor, noise)

    def advance(self, state: Array, noise: Array, departure: Array | None = None) -> Array:
        """x(t+1), shape (n, N), from x(t) (n, N) and standard normals (r, N).

        With a ``departure`` (4, N) the plant moves by I + c (A - I) in the place of A.
        """
        moved = true_motion(departure, state, linalg.matvec(self.transition, state))
        if not self.noise_channels:
            return moved
        return moved + linalg.matvec(self.process_factor, noise)

    def predict(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Prior mean (n, N) and covariance A P Aᵀ + W (n, n, N) of the next state.

        Where A P Aᵀ cancels, as it may after a known start, it is (A F)(A F)ᵀ with a root F of P.

        Source: tobit_token_bucket, equations (21) and (29).
        """
        prior = linalg.congruence(self.transition, covariance) + self.process_covariance
        if not self._known_start:
            return linalg.matvec(self.transition, mean), prior
        most = (self._cancelling * linalg.diagonal(covariance)[..., None, :, :]).sum(-2)
        cancelled = linalg.diagonal(prior) < most
        if cancelled.any():
            lanes = np.flatnonzero(cancelled.reshape(-1, cancelled.shape[-1]).any(0))
            moved = linalg.matmul(self.transition, linalg.root(covariance[..., lanes]))
            prior[..., lanes] = linalg.gram(moved) + self.process_covariance
        return linalg.matvec(self.transition, mean), prior

    @functools.cached_property
    def _known_start(self) -> bool:
        """Whether the start is known in some direction."""
        return bool(np.linalg.matrix_rank(self.initial_covariance[..., 0]) < self.size)

    @functools.cached_property
    def _cancelling(self) -> Array:
        """C (n, n, 1): a variance of A P Aᵀ below C diag(P) has lost digits."""
        return _CANCELLED * self.size * self.transition**2

    def open_loop(self, horizon: int) -> Array:
        """Mean over t = 1..horizon of the error variance without measurements, shape (n,)."""
        return np.array([np.diagonal(moment) for moment in self.moments(horizon)][1:]).mean(0)

    def second_moments(self, horizon: int, random_start: bool = False) -> Array:
        """Mean square (horizon + 1, n) of each state at t = 0..horizon."""
        mean, size = self.initial_mean[:, 0], self.size
        start = np.eye(size) * (mean @ mean) / size if random_start else np.outer(mean, mean)
        return np.array([np.diagonal(moment) for moment in self.moments(horizon, start)])

    def moments(self, horizon: int, square: float | Array = 0.0) -> Iterator[Array]:
        """Covariances (n, n) of the error without measurements at t = 0..horizon.

        With the ``square`` (n, n) of the initial mean, the state's second moments.
        """
        transition, process = self.transition[..., 0], self.process_covariance[..., 0]
        moment = self.initial_covariance[..., 0] + square
        yield moment
        for _ in range(horizon):
            root, moment = moment, transition @ moment @ transition.T + process
            if (np.diagonal(moment) < 0.0).any():  # it has cancelled
                root = transition @ covariance_factor(root)
                moment = root @ root.T + process
            yield moment


def typical_magnitude(plant: LinearPlant, horizon: int, random_start: bool) -> Array:
    """Root of the mean second moment of each state over t = 0..horizon, shape (n,)."""
    magnitude = np.sqrt(plant.second_moments(horizon, random_start).mean(0))
    return np.where(magnitude > 0.0, magnitude, 1.0)


def largest_ratio(moments: Array, rows: Array) -> float:
    """Bound of the mean square of any of the ``rows`` (..., n) of states of ``moments`` (T, n)."""
    finest = np.abs(rows).reshape(-1, rows.shape[-1]).max(0)
    return float((np.sqrt(moments) @ finest).max() ** 2)


def variance_loss(plant: LinearPlant, horizon: int, rows: Array, noise: Array) -> float:
    """Largest ratio of predicted variances, and their rounding, to those that a packet leaves.

    After silence until one of sixteen times, of packets with ``rows`` C (..., m, n) and ``noise``
    R (..., m, m). With G = I - K C and P the prediction, state i has (Σ |G_ij| √P_jj)² over the
    variance that is left.
    """
    times = np.geomspace(1, horizon, 16).round()
    largest = 0.0
    for time, prior in enumerate(plant.moments(horizon)):
        if time not in times:
            continue
        cross = rows @ prior
        try:
            gain = np.linalg.solve(cross @ rows.swapaxes(-1, -2) + noise, cross).swapaxes(-1, -2)
        except np.linalg.LinAlgError:  # the noise drowns
            return np.inf
        keep = np.eye(plant.size) - gain @ rows
        left = ((keep @ prior) * keep).sum(-1) + ((gain @ noise) * gain).sum(-1)
        rounded = (np.abs(keep) @ np.sqrt(np.diagonal(prior))) ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(rounded > 0.0, rounded / np.maximum(left, 0.0), 0.0)
        largest = float(np.maximum(largest, ratio.max()))
    return largest
