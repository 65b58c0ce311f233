"""The relaxed problem of a task, without censoring and token limits, and its conditions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.task import Task
from fusion_gym.systems.solvable import LinearEstimator


@dataclass(frozen=True)
class SilenceProblem:
    """The difference between the sensors' and the centre's knowledge, with a price of each packet.

    The difference e starts at 0 and moves as e(t) = A e(t-1) + w(t), w(t) ~ N(0, Σ(t)), for t =
    1..H. A silent step then costs Σᵢ Wᵢ eᵢ². A packet costs ``price`` and leaves the e that is best
    for the future.

    Shapes: ``transition`` A (n, n), ``weights`` W (n,), all > 0, ``noise`` Σ (H, n, n), of any
    rank. :meth:`create` builds a checked problem.
    """

    transition: Array
    weights: Array
    noise: Array
    price: float

    @classmethod
    def create(
        cls, transition: ArrayLike, weights: ArrayLike, noise: ArrayLike, price: float
    ) -> SilenceProblem:
        """Return the checked problem; ``noise`` is one covariance per step."""
        matrix = validation.square("transition", transition)
        size = len(matrix)
        values = np.asarray(noise, dtype=np.float64)
        if values.ndim != 3 or not len(values):
            raise validation.ConfigurationError(
                f"noise of shape {values.shape} is not allowed: it must be (steps, {size}, {size})"
            )
        for covariance in values:
            validation.covariance("noise", covariance, size)
        return cls(
            transition=matrix,
            weights=validation.positive("weights", weights, (size,)),
            noise=values,
            price=validation.number("price", price, above=0.0),
        )

    @property
    def horizon(self) -> int:
        """Number of steps H."""
        return len(self.noise)

    @property
    def size(self) -> int:
        """Number of states n."""
        return len(self.transition)


@dataclass(frozen=True)
class SilenceModel:
    """The task's problem at a price of 1, and the ``floor`` of its error, a mean over steps."""

    problem: SilenceProblem
    floor: float
    sensors: int


def silence_model(task: Task, weights: ArrayLike | None = None) -> SilenceModel:
    """Return the problem of the Kalman filter of all uncensored measurements, the first included.

    Its covariances P(t) are the floor. Its corrections, of covariance P⁻(t) - P(t), are the noise
    of the information that the centre lacks.

    Args:
        task: the task.
        weights: weights of the states (n,); 1 by default.

    Raises:
        ConfigurationError: a task whose centre does not predict with the plant's matrix in silence,
            or weights that are not all above 0.
    """
    task.refuse_control("for the bound")
    problem, estimator = None, task.estimator
    if isinstance(estimator, LinearEstimator):
        problem = estimator.linear_problem(task.plant, "for the bound")
    if problem is None:
        raise validation.ConfigurationError(
            f"plant = {type(task.plant).__name__} is not allowed for the bound: the centre must "
            "estimate a linear plant from all measurements, as in TobitOscillator, LinearFusion "
            "and the biased systems"
        )
    transition, size = problem.transition, len(problem.transition)
    weight = validation.positive("weights", np.ones(size) if weights is None else weights, (size,))
    measured = problem.measurement_matrix, problem.noise_covariance
    covariance, correction = _update(problem.initial_covariance, *measured)
    # The centre starts without the first measurement, but a policy may know it.
    before = transition @ correction @ transition.T
    noise, floor = np.empty((task.horizon, size, size)), 0.0
    for time in range(task.horizon):
        prior = transition @ covariance @ transition.T + problem.process_covariance
        covariance, noise[time] = _update(prior, *measured)
        floor += float(weight @ np.diagonal(covariance)) / task.horizon
    noise[0] += before
    return SilenceModel(SilenceProblem.create(transition, weight, noise, 1.0), floor, task.sensors)


def _update(prior: Array, matrix: Array, noise: Array) -> tuple[Array, Array]:
    """Return the posterior covariance and the covariance of the correction K (y - C x̂), (n, n)."""
    innovation = matrix @ prior @ matrix.T + noise
    gain = np.linalg.solve(innovation, matrix @ prior).T
    keep = np.eye(len(prior)) - gain @ matrix
    posterior = keep @ prior @ keep.T + gain @ noise @ gain.T
    correction = gain @ innovation @ gain.T
    return 0.5 * (posterior + posterior.T), 0.5 * (correction + correction.T)
