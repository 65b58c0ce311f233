"""The relaxed problem of a task, without censoring and token limits, and its conditions."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.task import Task
from fusion_gym.errors import forbidden
from fusion_gym.solvers.silence.problem import SilenceProblem
from fusion_gym.systems.linear_plant import LinearPlant
from fusion_gym.systems.tobit.centres import Centre, NodeCentre, SequentialCentre
from fusion_gym.systems.tobit.filters import BoundTobitFilter, KalmanFilter
from fusion_gym.systems.tobit.sensors import CensoredSensors
from fusion_gym.systems.tobit.system import CensoredEstimator, CensoredPlant


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
    dynamics, sensors = _parts(task)
    transition, process = dynamics.transition[..., 0], dynamics.process_covariance[..., 0]
    size = dynamics.size
    weight = validation.positive("weights", np.ones(size) if weights is None else weights, (size,))
    matrix, sensed = sensors.stacked_matrix[..., 0], sensors.noise_covariance[..., 0]
    covariance, correction = _update(dynamics.initial_covariance[..., 0], matrix, sensed)
    # The centre starts without the first measurement, but a policy may know it.
    before = transition @ correction @ transition.T
    noise, floor = np.empty((task.horizon, size, size)), 0.0
    for time in range(task.horizon):
        prior = transition @ covariance @ transition.T + process
        covariance, noise[time] = _update(prior, matrix, sensed)
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


def _parts(task: Task) -> tuple[LinearPlant, CensoredSensors]:
    """Return the task's plant and sensors, if the bound applies to them."""
    plant, estimator = task.plant, task.estimator
    if type(plant) is not CensoredPlant or not isinstance(estimator, CensoredEstimator):
        raise validation.ConfigurationError(
            f"plant = {type(plant).__name__} is not allowed for the bound: the centre must "
            "estimate a linear plant from all measurements, as in TobitOscillator and the biased "
            "systems"
        )
    if estimator.model is not plant.dynamics:
        reason = "the filters must predict with the plant's own matrix"
        raise forbidden("bias_aware", False, reason, "for the bound")
    plant.nature.refuse("for the bound")
    for part in (plant.dynamics, plant.sensors):
        part.refuse_schedule("for the bound")
    if not _predicts(estimator.centre):
        raise validation.ConfigurationError(
            "filter is not allowed for the bound: in silence the centre must predict, so neither "
            "hold the last value (filter='paper' with silent='hold') nor use the information of "
            "silence (filter='stochastic')"
        )
    return plant.dynamics, plant.sensors


def _predicts(centre: Centre) -> bool:
    """Return whether the centre only predicts, by A x̂, in a step without deliveries."""
    if isinstance(centre, SequentialCentre):
        return True
    if not isinstance(centre, NodeCentre):
        return False
    if isinstance(centre.filter, BoundTobitFilter):
        return not centre.filter.hold
    return isinstance(centre.filter, KalmanFilter) and centre.filter.silence is None
