"""Bounds of the duration of silence, and of the curvature of its value."""

import numpy as np
from scipy.special import ndtr

from fusion_gym.arrays import Array

_LOOK = 48  # largest number of steps ahead for a probability of one time


class Survival:
    """Upper bounds of the probability of silence, step by step backwards in time.

    Silence at time t needs e(t) in an ellipsoid {|F e| <= 1}. Among Gaussians of one covariance,
    the one of mean 0 gives a convex symmetric set its largest probability (T. W. Anderson, "The
    integral of a symmetric unimodal function", 1955). Hence, for any e(t), the probability of
    silence at t + 1, …, t + j is at most ρ(j). ρ(j) is the least product of such probabilities over
    any choice of times in between.

    ``curvature`` (n, n) is S(t) = Σ ρ(j) (Aʲ)ᵀ W Aʲ over j >= 0, for the last added time t.
    """

    def __init__(self, transition: Array, weights: Array, horizon: int) -> None:
        size = len(transition)
        self._transition = transition
        self._ellipsoids: list[Array] = []  # of the times t + 1, t + 2, …
        self._noises: list[Array] = []
        self._rho: list[Array] = [np.ones(1)]  # of the times t, t + 1, …
        power, grams = np.eye(size), []
        for _ in range(horizon):
            grams.append(power.T @ (weights[:, None] * power))
            power = transition @ power
        self._grams = np.array(grams)

    @property
    def curvature(self) -> Array:
        """S(t) of the last added time t."""
        rho = self._rho[0]
        return np.asarray(np.tensordot(rho, self._grams[: len(rho)], 1))

    def add(self, ellipsoid: Array, noise: Array) -> None:
        """Go back one step, with F (n, n) of the silent set {|F e| <= 1} and the noise Σ."""
        size = len(noise)
        self._ellipsoids.insert(0, ellipsoid)
        self._noises.insert(0, noise)
        looks = min(_LOOK, len(self._ellipsoids))
        del self._ellipsoids[_LOOK:], self._noises[_LOOK:]
        covariance, stretched = np.zeros((size, size)), np.empty((looks, size, size))
        for j in range(looks):
            covariance = self._transition @ covariance @ self._transition.T + self._noises[j]
            stretched[j] = covariance
        once = _inside(np.array(self._ellipsoids[:looks]), stretched)
        longest = len(self._rho[0])
        rho = np.ones(longest + 1)
        for j in range(looks):  # the first time is t + 1 + j
            later = self._rho[j]
            reach = longest + 1 - (j + 1)
            rho[j + 1 :] = np.minimum(rho[j + 1 :], once[j] * later[:reach])
        self._rho.insert(0, rho)
        del self._rho[_LOOK:]


def _inside(ellipsoids: Array, covariances: Array) -> Array:
    """Return upper bounds (J,) of P(|F z| <= 1), z ~ N(0, Γ), by the box around each ellipsoid."""
    variances = np.linalg.eigvalsh(ellipsoids @ covariances @ np.swapaxes(ellipsoids, -1, -2))
    deviations = np.sqrt(np.maximum(variances, 1e-300))
    return np.asarray(np.prod(2.0 * ndtr(1.0 / deviations) - 1.0, axis=-1))
