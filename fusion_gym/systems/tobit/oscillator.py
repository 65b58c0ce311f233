"""The oscillator with censored sensors and a token bucket: numbers, options, environment.

Source: tobit_token_bucket, X. Chen, F. Han, Y. Song and J. Zhang, "Tobit Kalman fusion filtering
under dynamic event-triggering protocol with token bucket specification", Complex Engineering
Systems 4:19, 2024, Section 4.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import validation
from fusion_gym.core.task import Scenario
from fusion_gym.core.token_bucket import SharingRule
from fusion_gym.systems.bases import numbered_states, trigger_parameters
from fusion_gym.systems.linear_plant import LinearPlant
from fusion_gym.systems.tobit import centres, filters, system
from fusion_gym.systems.tobit.sensors import CensoredSensors

_ANGLE = 0.052 * math.pi
_COS, _SIN = math.cos(_ANGLE), math.sin(_ANGLE)
_SMALLEST_EPSILON = 1e-9
_LARGEST_EVENT_ERROR = 1e120  # its square must be a float64
_HELD = "the silent filter continues from the last delivered measurement (silent='hold')"
_IDENTITY = ((1.0, 0.0), (0.0, 1.0))
_FILTERS = {
    "paper": centres.Filter(
        filters.BoundTobitFilter,
        lambda options, sensors: centres.feedback_centre(options, _bound_filter(options, sensors)),
    ),
    "tobit": centres.at_the_nodes(filters.TobitKalmanFilter),
    **centres.FILTERS,
}


@dataclass(frozen=True)
class TobitOscillatorOptions(system.FeedbackOptions):
    """An oscillator measured by three sensors that are censored below a threshold.

    The plant is a rotation by 0.052 π a step, driven by noise. Three sensors measure both states
    with noise of variance 0.5 and report max(z, 0) of each component. At every step the policy
    requests transmissions. The bucket (5 tokens per step, 30 at most, 3 a transmission) grants or
    denies. Each node runs a Tobit Kalman filter on its deliveries; the centre fuses the three and
    feeds the result back.

    Starting state: x₀ ~ N((5, 0), 0.1 I), or with ``random_start=True`` about a random point at the
    same distance, known to the filters. The centre receives the first measurement without charge.

    The defaults are the paper's Section 4. The paper does not give, and we chose:
    ``initial_covariance``, ``information_shares`` (equal), ``horizon``. The text gives x₀ = (5, 0),
    which we use as the mean. Other numbers of sensors repeat the trigger's thresholds
    (0.1, 0.2, 0.3) and decays (0.1, 0.2, 0.1).

    Example:
        >>> import fusion_gym
        >>> from fusion_gym.systems.tobit.oscillator import TobitOscillatorOptions
        >>> options = TobitOscillatorOptions(filter="tobit", token_rate=2.0)
        >>> task = fusion_gym.make_task(options)
        >>> task.sensors, task.plant.state_names
        (3, ('x1', 'x2'))
    """

    filters: ClassVar[Mapping[str, type]] = centres.classes(_FILTERS)
    transition: ArrayLike = ((_COS, _SIN), (-_SIN, _COS))
    """A of equation (1), (n, n). By default a rotation by 0.052 π."""
    process_noise: Literal["scalar", "full"] = "scalar"
    """Covariance W of the process noise: ``"scalar"`` is ``process_variance`` · B Bᵀ, ``"full"`` is
    ``process_variance`` · I."""
    process_gain: ArrayLike = (0.16, 0.18)
    """B of equation (1), (n,)."""
    process_variance: float = 0.05
    """Variance of the process noise, equation (1)."""
    initial_mean: ArrayLike = (5.0, 0.0)
    """Mean of x₀, (n,)."""
    initial_covariance: ArrayLike = ((0.1, 0.0), (0.0, 0.1))
    """Covariance of x₀, (n, n)."""
    random_start: bool = False
    """Whether the initial mean has a random direction, which the filters know."""
    measurement_matrices: ArrayLike = (_IDENTITY, _IDENTITY, _IDENTITY)
    """C of each sensor, equation (1), (sensors, components, n)."""
    measurement_variance: ArrayLike = 0.5
    """Variance R of the measurement noise, equation (1): one number or (sensors, components)."""
    censoring_threshold: ArrayLike = 0.0
    """Threshold τ of equation (2), below which a sensor reports τ: one number or (sensors,
    components). Minus infinity never censors."""
    sharing: SharingRule = "equal"
    filter: Annotated[str, _FILTERS] = "paper"
    """Filter of the nodes. ``"paper"`` minimises the bound of equations (30) and (37). ``"tobit"``
    is the Tobit Kalman filter. ``"kalman"`` ignores censoring. ``"adf"`` is one assumed-density
    filter at the centre. ``"stochastic"`` is the Kalman filter for the policy
    ``stochastic_event``."""
    silent: Literal["hold", "predict"] | None = None
    """Update of the paper's filter without a delivery: with the last measurement (``"hold"``, its
    default), or none. The other filters always predict."""
    event_error: bool | None = None
    """Whether the paper's filter adds κ₆ Ξ to the noise of a delivery, by default ``True``."""
    bound_epsilon: ArrayLike = (0.05,) * 5 + (0.7,) * 8 + (1.0,)
    """ε₁, …, ε₁₄ of the bound, below equation (30)."""
    bound_young: tuple[float, float] = (1.5, 2.0)
    """Factors (d, e) of Young's inequality in the bound, equations (33) and (34)."""
    trigger_threshold: ArrayLike | None = None
    """σ of the policy ``dynamic_event`` and of Ξ, equations (11)-(15). By default 0.1, 0.2, 0.3 in
    turn."""
    trigger_decay: ArrayLike | None = None
    """λ of the policy ``dynamic_event`` and of Ξ, equations (11)-(15). By default 0.1, 0.2, 0.1 in
    turn."""
    trigger_divisor: ArrayLike = 5.0
    """χ of the policy ``dynamic_event`` and of Ξ, equations (11)-(15)."""
    trigger_initial: ArrayLike = 1.5
    """η₀ of the policy ``dynamic_event`` and of Ξ, equations (11)-(15)."""


def build_tobit(options: TobitOscillatorOptions) -> Scenario:
    """Return the scenario of these options."""
    horizon = validation.horizon(options.horizon)
    plant = _plant(options)
    sensors = CensoredSensors.create(
        options.measurement_matrices,
        options.measurement_variance,
        options.censoring_threshold,
        plant.size,
    )
    trigger = _trigger(options, sensors.count)
    for name, refused in (("silent", "hold"), ("event_error", True)):
        if options.filter != "paper" and getattr(options, name) == refused:
            raise validation.ConfigurationError(
                f"{name} = {refused!r} is not allowed with filter={options.filter!r}: it belongs "
                "to filter='paper' (the others predict in silence, without an event error)"
            )
    holds = options.filter == "paper" and options.silent != "predict"
    return system.feedback_scenario(
        options,
        _FILTERS,
        system.CensoredPlant(plant, sensors, numbered_states(plant.size), options.random_start),
        horizon,
        # The paper's minimises a bound; with every measurement it errs thrice.
        memory_filter="adf" if options.filter == "paper" else None,
        policy_defaults={"dynamic_event": trigger},
        no_estimates=_HELD if holds else None,
    )


def _plant(options: TobitOscillatorOptions) -> LinearPlant:
    transition = validation.array("transition", options.transition, (None, None))
    size = len(transition)
    variance = validation.number("process_variance", options.process_variance, above=0.0)
    if options.process_noise == "scalar":
        gain = validation.array("process_gain", options.process_gain, (size,))
        covariance = variance * np.outer(gain, gain)
    else:
        covariance = variance * np.eye(size)
    return LinearPlant.create(
        transition, covariance, options.initial_mean, options.initial_covariance
    )


def _bound_filter(options: TobitOscillatorOptions, sensors: CensoredSensors) -> filters.NodeFilter:
    """Return the paper's filter, with its constants and the trigger's Ξ."""
    constants = filters.BoundConstants.create(options.bound_epsilon)
    if np.min(options.bound_epsilon) < _SMALLEST_EPSILON:
        allowed = f"at least {_SMALLEST_EPSILON:g} everywhere: its inverse multiplies the bound"
        raise validation.refusal("bound_epsilon", options.bound_epsilon, allowed)
    trigger = _trigger(options, sensors.count)
    error = filters.EventError.create(trigger, options.bound_young, sensors.count)
    with_error = options.event_error is None or options.event_error
    hold = options.silent != "predict"
    if with_error and options.filter == "paper":
        _refuse_explosion(options, error)
    return filters.BoundTobitFilter(sensors, constants, error if with_error else None, hold=hold)


def _refuse_explosion(options: TobitOscillatorOptions, error: filters.EventError) -> None:
    """Refuse a horizon over which the bound of the event error overflows."""
    reached = error.at(np.array([float(options.horizon)]))
    if not np.all(reached <= _LARGEST_EVENT_ERROR):
        names = ("trigger_threshold", "trigger_decay", "trigger_divisor", "trigger_initial")
        args = {name: getattr(options, name) for name in (*names, "bound_young", "horizon")}
        listed = ", ".join(f"{name} = {validation.display(value)}" for name, value in args.items())
        raise validation.ConfigurationError(
            f"{listed} are not allowed together: the bound of the event error must stay below "
            f"{_LARGEST_EVENT_ERROR:g}; use a smaller decay, a larger divisor or event_error=False"
        )


def _trigger(options: TobitOscillatorOptions, sensors: int) -> dict[str, tuple[float, ...]]:
    """Return the parameters of the dynamic event trigger, one number per sensor."""
    usual = {"threshold": (0.1, 0.2, 0.3), "decay": (0.1, 0.2, 0.1)}
    return trigger_parameters(options, (*usual, "divisor", "initial"), sensors, usual)
