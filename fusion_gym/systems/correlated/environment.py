"""Tracking with correlated noises of uncertain variance: numbers, options, environment.

Source: adaptive_innovation, K. Xu, X. Li, J. Wang and Y. Gao, "Robust sequential fusion estimation
based on adaptive innovation event-triggered mechanism for uncertain networked systems", 2022,
Section 6.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.plant import Nature
from fusion_gym.core.reward import equal_weights
from fusion_gym.core.task import PaperOptions, Scenario
from fusion_gym.core.token_bucket import Tokens
from fusion_gym.fusion.table import Structure, choose_rule
from fusion_gym.systems.bases import numbered_states, trigger_parameters
from fusion_gym.systems.correlated import filters, system
from fusion_gym.systems.linear_control import ControlOptions, close_loop
from fusion_gym.systems.linear_plant import LinearPlant, typical_magnitude
from fusion_gym.systems.schedule import read_schedule, scheduled_parts

_T = 0.01  # the paper's sampling time
_SCHEDULED = (
    "transition", "process_gain", "process_variance", "measurement_matrices",
    "measurement_variance", "noise_coupling",
)  # fmt: skip
_STRUCTURE = Structure(common="all contain the same process noise", prediction=True)
_FILTERS = {"": filters.RobustKalmanFilter}  # without a choice


@dataclass(frozen=True)
class CorrelatedTrackingOptions(ControlOptions, PaperOptions):
    """A target whose position, velocity and acceleration are each measured by one sensor.

    One noise drives the three states, sampled every 0.01. Sensor 0 measures the position, sensor 1
    the velocity, sensor 2 the acceleration. Each measurement noise contains a multiple of the noise
    that has just moved the target. Filters know only upper bounds of all variances; ``noise_scale``
    is the ratio of the actual variances to these bounds. Each node runs a robust Kalman filter on
    its granted measurements. The centre fuses its own prediction with the estimates of the granted
    nodes, one after another, without feedback.

    Starting state: x₀ ~ N((0.3, 0.1, 0.2), noise_scale · I). The filters know the mean and the
    bound I; nothing has been measured.

    The defaults are the paper's Section 6. The paper does not give, and we chose: ``horizon`` (the
    paper runs 600 steps), the token bucket (the paper has none, hence ``tokens="unlimited"``) and
    the reward.

    Example:
        >>> import fusion_gym
        >>> from fusion_gym.systems.correlated.environment import CorrelatedTrackingOptions
        >>> options = CorrelatedTrackingOptions(noise_scale=0.5, horizon=50)
        >>> task = fusion_gym.make_task(options)
        >>> task.sensors, task.horizon, task.network.bucket.unlimited
        (3, 50, True)
    """

    filters: ClassVar[Mapping[str, type]] = _FILTERS
    structure: ClassVar[Structure | None] = _STRUCTURE
    transition: ArrayLike = ((1.0, _T, _T * _T / 2), (0.0, 1.0, _T), (0.0, 0.0, 1.0))
    """Φ of equations (1) and (64), (n, n)."""
    process_gain: ArrayLike = ((_T * _T / 2,), (_T,), (1.0,))
    """Γ of equations (1) and (64), (n, noises)."""
    process_variance: ArrayLike = 0.16
    """Bound σ_w² of the process noise's variance, equation (4): one number, or one per noise."""
    initial_mean: ArrayLike = (0.3, 0.1, 0.2)
    """Mean μ₀ of x₀, (n,)."""
    initial_covariance: ArrayLike = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    """Bound P₀ of the covariance of x₀, (n, n)."""
    measurement_matrices: ArrayLike = (((1.0, 0.0, 0.0),), ((0.0, 1.0, 0.0),), ((0.0, 0.0, 1.0),))
    """H of each sensor, equations (2) and (64), (sensors, components, n)."""
    measurement_variance: ArrayLike = (0.64, 0.36, 0.49)
    """Bound σ_η² of each sensor's own noise, equation (4): one number, one per sensor, or (sensors,
    components)."""
    noise_coupling: ArrayLike = (0.2, 0.4, 0.1)
    """β of equation (3), the share of the process noise in a measurement's noise: one number, one
    per sensor, or (sensors, components, noises)."""
    noise_scale: float | Literal["random"] = 1.0
    """Actual variances over their bounds, equation (4): a number in (0, 1]. ``"random"`` draws it
    for each episode, evenly in [0.4, 1]."""
    schedule: Mapping[str, Any] | str | None = None
    """Matrices that vary with the step, in place of the options of these names: a dictionary, or
    the path of a YAML or .npz file. ``transition``, ``process_gain`` and ``process_variance`` are
    stacks over T steps; ``measurement_matrices``, ``measurement_variance`` and ``noise_coupling``
    have a stack for each sensor. Entry k leads from step k to k + 1, or measures at step k. After T
    steps the stacks repeat; with ``end: hold`` the last entry stays."""
    tokens: Tokens = "unlimited"
    token_rate: ArrayLike = 3.0
    fusion: Annotated[str, _STRUCTURE.offered] = "sici"
    """Rule that joins the estimates. ``"sici"`` is sequential inverse covariance intersection
    (47)-(54), the most accurate. ``"sci"`` is sequential covariance intersection (37)-(42), whose
    covariance is a bound. ``"ci"`` joins all at once with a bound. ``"ici"`` needs one sensor."""
    order: ArrayLike | None = None
    """Order of arrival under the sequential rules: a permutation of the sensors."""
    track_actual: bool = False
    """Whether the system tracks the actual covariances of equations (23), (28), (43) and (55), for
    ``task.estimator.actual_covariance(state)``."""
    trigger_threshold: ArrayLike = 0.6
    """a of the policy ``adaptive_innovation``, equations (9)-(11): one number, or one per
    sensor."""
    trigger_offset: ArrayLike = 0.2
    """b of the policy ``adaptive_innovation``, equations (9)-(11): one number, or one per
    sensor."""
    trigger_sensitivity: ArrayLike = 0.9
    """c of the policy ``adaptive_innovation``, equations (9)-(11): one number, or one per
    sensor."""
    horizon: int = 200
    cost_weight: float | Literal["random"] = 0.001

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "schedule", read_schedule(self.schedule))


def build_adaptive(options: CorrelatedTrackingOptions) -> Scenario:
    """Return the scenario of these options."""
    horizon = validation.horizon(options.horizon)
    plant, sensors = scheduled_parts(options, _SCHEDULED, _plant_and_sensors)
    controller, plant = close_loop(options, plant)
    open_loop = plant.open_loop(horizon)
    chosen = options.own_weights(plant.size)
    weights = equal_weights(open_loop) if chosen is None else chosen
    nature = Nature.create(options, (*plant.unmoved, "true_threshold_shift"))
    nature.check_growth(plant.true_radius, horizon)
    names = numbered_states(plant.size, ("position", "velocity", "acceleration"))
    if options.schedule is None:
        plant.warn_of_unseen_growth(sensors.measurement_matrix, names)
    if options.track_actual:
        nature.refuse("with track_actual=True")
    scale = _noise_scale(options.noise_scale)
    truth = system.CorrelatedTrackingPlant(plant, sensors, scale, names, nature)
    scales = names, weights, typical_magnitude(plant, horizon, random_start=False), open_loop
    fusion = choose_rule(options.fusion, _STRUCTURE, sensors.count, options.order, chosen)
    mean_scale = float(np.mean(system.RANDOM_SCALE)) if scale is None else scale
    estimator = system.CorrelatedTrackingEstimator(
        *scales, plant, filters.RobustKalmanFilter(sensors), fusion, mean_scale
    )
    if options.track_actual:
        estimator = estimator.with_actual_covariance()
    trigger = trigger_parameters(options, ("threshold", "offset", "sensitivity"), sensors.count)
    defaults = {"adaptive_innovation": trigger}
    return Scenario(options, truth, estimator, weights, defaults, controller=controller)


def _plant_and_sensors(
    options: CorrelatedTrackingOptions, before: CorrelatedTrackingOptions
) -> tuple[LinearPlant, filters.CorrelatedSensors]:
    """Return plant and sensors at the bounds; both use the same process normals.

    The sensors have the noise that has just moved the plant, by the options of the step before.
    """
    plant, _ = _plant(options)
    moved, deviation = _plant(before)
    return plant, filters.CorrelatedSensors.create(options, deviation, moved)


def _plant(options: CorrelatedTrackingOptions) -> tuple[LinearPlant, Array]:
    """Return the plant, and the deviations Q^½ of its noises."""
    size = len(validation.square("transition", options.transition))
    gain = validation.array("process_gain", options.process_gain, (size, None))
    variance = validation.positive("process_variance", options.process_variance, gain.shape[1:])
    factor = gain * np.sqrt(variance)
    plant = LinearPlant.create(
        options.transition, factor @ factor.T, options.initial_mean, options.initial_covariance
    )
    return replace(plant, process_factor=factor[..., None]), np.sqrt(variance)


def _noise_scale(value: float | str) -> float | None:
    if isinstance(value, str):
        if value == "random":
            return None
        raise validation.refusal("noise_scale", value, "a number > 0 and <= 1, or 'random'")
    return validation.number("noise_scale", value, above=0.0, at_most=1.0)
