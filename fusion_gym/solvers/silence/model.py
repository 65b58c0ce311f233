"""The relaxed problem of a task, without censoring and token limits, and its conditions."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.task import Task
from fusion_gym.solvers.silence.problem import SilenceProblem
from fusion_gym.systems.solvable import LinearEstimator, LinearProblem


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
    problem = _problem(task)
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


def _problem(task: Task) -> LinearProblem:
    """Return the task's plant and measurements, if the bound applies to them."""
    plant, estimator = task.plant, task.estimator
    problem = None
    if isinstance(estimator, LinearEstimator):
        problem = estimator.linear_problem(plant, "for the bound")
    if problem is None:
        raise validation.ConfigurationError(
            f"plant = {type(plant).__name__} is not allowed for the bound: the centre must "
            "estimate a linear plant from all measurements, as in TobitOscillator and the biased "
            "systems"
        )
    return problem
