"""Linear plant x' = A x + w with a process covariance of any rank."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.plant import true_motion
from fusion_gym.namespace import in_runs
from fusion_gym.systems.schedule import MatrixSchedule, Scheduled

_SEEN, _NOTHING = 1e-9, 1e-300  # relative rounding of a rank, and the least length
_CANCELLED = 1e-3  # of what is summed; what is left has lost three digits


def covariance_factor(matrix: Array) -> Array:
    """Return a factor F (n, rank) with F Fᵀ = matrix of a positive semi-definite matrix."""
    factor = linalg.root(matrix[..., None])[..., 0]
    return np.ascontiguousarray(factor[:, factor.any(0)])


def initial_law(mean: ArrayLike, covariance: ArrayLike, size: int) -> dict[str, Any]:
    """Return the checked mean, covariance and factor of x(0), by field of a plant."""
    start = validation.covariance("initial_covariance", covariance, size)[..., None]
    return {
        "initial_mean": validation.array("initial_mean", mean, (size,))[..., None],
        "initial_covariance": start,
        "initial_factor": linalg.root(start),
    }


def steer(moved: Array, matrix: Array | None, control: Array | None) -> Array:
    """Return states (…, n, N) with the effect B u of an input (k, N), if there is one."""
    if control is None or matrix is None:
        return moved
    return moved + linalg.matvec(matrix, control)


class Sensors(Scheduled):
    """The common part of linear sensors: C (sensors, m, n, 1), a noise for each component."""

    measurement_matrix: Array

    @property
    def count(self) -> int:
        """Number of sensors."""
        return self.measurement_matrix.shape[0]

    @property
    def size(self) -> int:
        """Number of measured components m of each sensor."""
        return self.measurement_matrix.shape[1]

    @property
    def noise_channels(self) -> int:
        """Standard normals of one measurement of all sensors."""
        return self.count * self.size


@dataclass(frozen=True)
class LinearDynamics(Scheduled):
    """The common part of linear plants: A, the noise w ~ N(0, W) and the law of x(0).

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
        """Standard normals per step: the rank of the process covariance."""
        return self.process_factor.shape[1]

    def true_radius(self, factor: float) -> float:
        """Spectral radius of I + c (A - I), the largest of all steps."""
        still = np.eye(self.size)
        moved = still + factor * (np.moveaxis(self.each_step.transition, -1, 0) - still)
        return float(np.abs(np.linalg.eigvals(moved)).max())

    def warn_of_unseen_growth(self, rows: Array, names: Sequence[str]) -> None:
        """Warn of a growing state that no row (…, n, 1) of a sensor measures, by Hautus' test."""
        transition, rows = self.transition[..., 0], rows.reshape(-1, self.size)
        for value in np.linalg.eigvals(transition):
            pencil = np.concatenate([transition - value * np.eye(self.size), rows])
            length = np.maximum(np.linalg.norm(pencil, axis=0), _NOTHING)
            _, share, basis = np.linalg.svd(pencil / length)
            if abs(value) > 1.0 + _SEEN and share[-1] <= _SEEN * share[0]:
                state = names[int(np.abs(basis[-1]).argmax())]
                warnings.warn(
                    f"the state {state!r} grows by {abs(value):.4g} a step, and no sensor measures "
                    "it: no transmission lowers its error",
                    stacklevel=2,
                )
                return

    @property
    def unmoved(self) -> tuple[str, ...]:
        """Options of the true plant that have no effect."""
        every = self.each_step
        still = bool((every.transition == linalg.identity(self.size)).all())
        result = {"true_process_noise": not every.process_factor.any(), "true_transition": still}
        return tuple(name for name, absent in result.items() if absent)


@dataclass(frozen=True)
class LinearPlant(LinearDynamics):
    """x(t+1) = A x(t) + B u(t) + w(t), w ~ N(0, W), x(0) ~ N(initial_mean, initial_covariance).

    With a ``schedule`` A and W depend on t. ``input_matrix`` is B (n, k, 1), and ``feedback`` B L
    (n, n, 1) of a controller u = -L x̂, without which nothing moves but the noise.

    Source: tobit_token_bucket, equation (1).
    """

    schedule: MatrixSchedule | None = None
    input_matrix: Array | None = None
    feedback: Array | None = None

    @classmethod
    def create(
        cls,
        transition: ArrayLike,
        process_covariance: ArrayLike,
        initial_mean: ArrayLike,
        initial_covariance: ArrayLike,
    ) -> LinearPlant:
        """Return a plant from matrices without a batch axis.

        Args:
            transition: A (n, n).
            process_covariance: W (n, n), positive semi-definite.
            initial_mean: mean of x(0) (n,).
            initial_covariance: covariance of x(0) (n, n), positive semi-definite.

        Raises:
            ConfigurationError: a wrong shape, a non-finite entry, or no valid covariance.
        """
        matrix = validation.square("transition", transition)
        size = len(matrix)
        process = validation.covariance("process_covariance", process_covariance, size)
        return cls(
            transition=matrix[..., None],
            process_covariance=process[..., None],
            process_factor=covariance_factor(process)[..., None],
            **initial_law(initial_mean, initial_covariance, size),
        )

    def start(self, mean: Array, noise: Array) -> Array:
        """Draw x(0) (n, N) with the mean ``mean`` (n, N) from standard normals (n, N)."""
        return mean + linalg.matvec(self.initial_factor, noise)

    def advance(
        self,
        state: Array,
        noise: Array,
        departure: Array | None = None,
        control: Array | None = None,
    ) -> Array:
        """Return x(t+1) (n, N).

        Args:
            state: x(t) (n, N).
            noise: standard normals (r, N).
            departure: (4, N), or None; with it the plant moves by I + c (A - I).
            control: u (k, N), or None.
        """
        moved = true_motion(departure, state, linalg.matvec(self.transition, state))
        moved = steer(moved, self.input_matrix, control)
        if not self.noise_channels:
            return moved
        return moved + linalg.matvec(self.process_factor, noise)

    def predict(
        self, mean: Array, covariance: Array, control: Array | None = None
    ) -> tuple[Array, Array]:
        """Return the prior mean (n, N) and covariance A P Aᵀ + W (n, n, N) of the next state.

        Where A P Aᵀ cancels, as after a known start, it is (A F)(A F)ᵀ with a root F of P.

        Args:
            mean: posterior mean (n, N).
            covariance: P (n, n, N).
            control: u (k, N), or None.

        Source: tobit_token_bucket, equations (21) and (29).
        """
        moved = steer(linalg.matvec(self.transition, mean), self.input_matrix, control)
        prior = linalg.congruence(self.transition, covariance) + self.process_covariance
        if not self._known_start:
            return moved, prior
        most = linalg.total(self._cancelling * linalg.diagonal(covariance)[..., None, :, :])
        cancelled = linalg.diagonal(prior) < most
        parts = covariance, self.transition, self.process_covariance
        (prior,) = in_runs(cancelled, _predict_root, parts, (prior,))
        return moved, prior

    @functools.cached_property
    def _known_start(self) -> bool:
        """Whether the start is known in some direction."""
        return bool(np.linalg.matrix_rank(self.initial_covariance[..., 0]) < self.size)

    @functools.cached_property
    def _cancelling(self) -> Array:
        """C (n, n, 1): a variance of A P Aᵀ below C diag(P) has lost digits."""
        return _CANCELLED * self.size * self.transition**2

    def open_loop(self, horizon: int) -> Array:
        """Return the mean error variance (n,) over t = 1..horizon without measurements."""
        return np.array([np.diagonal(moment) for moment in self.moments(horizon)][1:]).mean(0)

    def second_moments(self, horizon: int, random_start: bool = False) -> Array:
        """Return the mean square (horizon + 1, n) of each state at t = 0..horizon.

        A controller of this plant knows the state.
        """
        mean, size, loop = self.initial_mean[:, 0], self.size, self
        start = np.eye(size) * (mean @ mean) / size if random_start else np.outer(mean, mean)
        if self.feedback is not None:
            loop = replace(self, transition=self.transition - self.feedback)
        return np.array([np.diagonal(moment) for moment in loop.moments(horizon, start)])

    def moments(self, horizon: int, square: float | Array = 0.0) -> Iterator[Array]:
        """Yield the error's covariances (n, n) at t = 0..horizon.

        ``square`` m mᵀ of the initial mean m gives the state's second moments instead.
        """
        moment = self.initial_covariance[..., 0] + square
        yield moment
        for step in range(horizon):
            plant = self.at(np.full(1, step))
            transition, process = plant.transition[..., 0], plant.process_covariance[..., 0]
            root, moment = moment, transition @ moment @ transition.T + process
            if (np.diagonal(moment) < 0.0).any():  # it has cancelled
                root = transition @ covariance_factor(root)
                moment = root @ root.T + process
            yield moment


def _predict_root(covariance: Array, transition: Array, process: Array) -> tuple[Array]:
    return (linalg.gram(linalg.matmul(transition, linalg.root(covariance))) + process,)


def typical_magnitude(plant: LinearPlant, horizon: int, random_start: bool) -> Array:
    """Return the root of each state's mean second moment (n,) over t = 0..horizon."""
    magnitude = np.sqrt(plant.second_moments(horizon, random_start).mean(0))
    return np.where(magnitude > 0.0, magnitude, 1.0)


def largest_ratio(moments: Array, rows: Array) -> float:
    """Return a bound of the mean square of ``rows`` (..., n) of states with ``moments`` (T, n)."""
    finest = np.abs(rows).reshape(-1, rows.shape[-1]).max(0)
    return float((np.sqrt(moments) @ finest).max() ** 2)


def variance_loss(
    plant: LinearPlant, horizon: int, packets: Callable[[int], Iterable[tuple[Array, Array]]]
) -> float:
    """Return the largest ratio of predicted variances, with their rounding, to updated variances.

    The update follows silence until one of sixteen times. With G = I - K C and the prediction P,
    the ratio of state i is (Σ |G_ij| √P_jj)² over its updated variance.

    Args:
        plant: the plant.
        horizon: steps of an episode.
        packets: function that returns C (..., m, n) and R (..., m, m) of packets at a time.
    """
    times = np.geomspace(1, horizon, 16).round()
    largest = 0.0
    for time, prior in enumerate(plant.moments(horizon)):
        for rows, noise in packets(time) if time in times else ():
            cross = rows @ prior
            try:
                gain = np.linalg.solve(cross @ rows.swapaxes(-1, -2) + noise, cross)
            except np.linalg.LinAlgError:  # the noise drowns
                return np.inf
            gain = gain.swapaxes(-1, -2)
            keep = np.eye(plant.size) - gain @ rows
            left = ((keep @ prior) * keep).sum(-1) + ((gain @ noise) * gain).sum(-1)
            rounded = (np.abs(keep) @ np.sqrt(np.diagonal(prior))) ** 2
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = np.where(rounded > 0.0, rounded / np.maximum(left, 0.0), 0.0)
            largest = float(np.maximum(largest, ratio.max()))
    return largest
