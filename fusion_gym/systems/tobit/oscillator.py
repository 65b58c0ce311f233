"""The oscillator with censored sensors and a token bucket: numbers, options, environment.

Source: tobit_token_bucket, X. Chen, F. Han, Y. Song and J. Zhang, "Tobit Kalman fusion filtering
under dynamic event-triggering protocol with token bucket specification", Complex Engineering
Systems 4:19, 2024, Section 4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import validation
from fusion_gym.core.options import choose, finish
from fusion_gym.core.task import Task
from fusion_gym.envs.registered import RegisteredEnv, RegisteredVectorEnv
from fusion_gym.systems.linear_plant import LinearPlant, typical_magnitude
from fusion_gym.systems.tobit.bound_filter import BoundConstants, BoundTobitFilter, EventError
from fusion_gym.systems.tobit.centre import Centre
from fusion_gym.systems.tobit.filters import KalmanFilter
from fusion_gym.systems.tobit.options import (
    FeedbackOptions,
    assumed_density_centre,
    feedback_centre,
    stochastic_centre,
    stochastic_defaults,
)
from fusion_gym.systems.tobit.sensors import CensoredSensors
from fusion_gym.systems.tobit.system import CensoredSystem
from fusion_gym.systems.tobit.tobit_filter import TobitKalmanFilter
from fusion_gym.validation import ConfigurationError

_ANGLE = 0.052 * math.pi
_COS, _SIN = math.cos(_ANGLE), math.sin(_ANGLE)
_IDENTITY = ((1.0, 0.0), (0.0, 1.0))


@dataclass(frozen=True)
class TobitOscillatorOptions(FeedbackOptions):
    """Every option of the environment; the defaults are the paper's Section 4.

    Not given in the paper, our choice: ``initial_covariance``, ``information_shares`` (equal),
    ``horizon``. The text gives x₀ = (5, 0), which we take as the mean. The trigger's thresholds
    (0.1, 0.2, 0.3) and decays (0.1, 0.2, 0.1) are repeated in turn for other numbers of sensors.
    """

    # Plant, equation (1)
    transition: ArrayLike = ((_COS, _SIN), (-_SIN, _COS))
    process_noise: str = "scalar"
    process_gain: ArrayLike = (0.16, 0.18)
    process_variance: float = 0.05
    initial_mean: ArrayLike = (5.0, 0.0)
    initial_covariance: ArrayLike = ((0.1, 0.0), (0.0, 0.1))
    random_start: bool = False
    # Sensors, equations (1) and (2)
    measurement_matrices: ArrayLike = (_IDENTITY, _IDENTITY, _IDENTITY)
    measurement_variance: ArrayLike = 0.5
    censoring_threshold: ArrayLike = 0.0
    # Network, equations (16)-(18)
    sharing: str = "equal"
    # Filters, equations (21)-(37)
    filter: str = "paper"
    silent: str | None = None
    event_error: bool | None = None
    bound_epsilon: ArrayLike = (0.05,) * 5 + (0.7,) * 8 + (1.0,)
    bound_young: tuple[float, float] = (1.5, 2.0)
    # Dynamic event trigger, equations (11)-(15): the defaults of the policy, and Ξ of the filter
    trigger_threshold: ArrayLike | None = None
    trigger_decay: ArrayLike | None = None
    trigger_divisor: ArrayLike = 5.0
    trigger_initial: ArrayLike = 1.5


def build(**options: Any) -> Task:
    """The task for these options, checked before anything runs.

    Raises:
        ConfigurationError: an unknown option, or a value that is not allowed.
    """
    chosen, limit = choose(TobitOscillatorOptions, "fusion_gym/TobitOscillator-v0", options)
    horizon = validation.integer("horizon", chosen.horizon, at_least=1)
    plant = _plant(chosen)
    sensors = CensoredSensors.create(
        chosen.measurement_matrices,
        chosen.measurement_variance,
        chosen.censoring_threshold,
        plant.size,
    )
    random_start = validation.boolean("random_start", chosen.random_start)
    trigger = _trigger(chosen, sensors.count)
    system = CensoredSystem(
        plant=plant,
        model=plant,
        centre=_centre(chosen, sensors, trigger),
        random_start=random_start,
        state_names=tuple(f"x{i + 1}" for i in range(plant.size)),
        scale=typical_magnitude(plant, horizon, random_start),
        reference=plant.open_loop(horizon),
    )
    defaults = {"dynamic_event": trigger} | stochastic_defaults(chosen, chosen.filter)
    return finish(chosen, system, limit, None, policy_defaults=defaults)


def _plant(chosen: TobitOscillatorOptions) -> LinearPlant:
    transition = validation.array("transition", chosen.transition, (None, None))
    size = len(transition)
    variance = validation.number("process_variance", chosen.process_variance, above=0.0)
    reading = validation.choice("process_noise", chosen.process_noise, ("scalar", "full"))
    if reading == "scalar":
        gain = validation.array("process_gain", chosen.process_gain, (size,))
        covariance = variance * np.outer(gain, gain)
    else:
        covariance = variance * np.eye(size)
    return LinearPlant.create(
        transition, covariance, chosen.initial_mean, chosen.initial_covariance
    )


def _centre(
    chosen: TobitOscillatorOptions, sensors: CensoredSensors, trigger: dict[str, tuple[float, ...]]
) -> Centre:
    kind = validation.choice(
        "filter", chosen.filter, ("paper", "tobit", "kalman", "adf", "stochastic")
    )
    constants = BoundConstants.create(chosen.bound_epsilon)
    error = EventError.create(**trigger, young=chosen.bound_young, sensors=sensors.count)
    silent, with_error = chosen.silent, chosen.event_error
    if silent is not None:
        validation.choice("silent", silent, ("hold", "predict"))
    if with_error is not None:
        validation.boolean("event_error", with_error)
    if kind == "paper":
        bound = BoundTobitFilter(
            sensors, constants, None if with_error is False else error, hold=silent != "predict"
        )
        return feedback_centre(chosen, bound)
    for name, value, refused in (("silent", silent, "hold"), ("event_error", with_error, True)):
        if value == refused:
            raise ConfigurationError(
                f"{name} = {value!r} is not allowed with filter={kind!r}: it belongs to "
                "filter='paper' (the others predict when nothing arrives and know no event error)"
            )
    if kind == "adf":
        return assumed_density_centre(chosen, sensors)
    if kind == "stochastic":
        return stochastic_centre(chosen, sensors)
    tobit = kind == "tobit"
    return feedback_centre(chosen, TobitKalmanFilter(sensors) if tobit else KalmanFilter(sensors))


def _trigger(chosen: TobitOscillatorOptions, sensors: int) -> dict[str, tuple[float, ...]]:
    """Parameters of the dynamic event trigger, one number a sensor."""
    given: dict[str, Any] = {
        "threshold": chosen.trigger_threshold,
        "decay": chosen.trigger_decay,
        "divisor": chosen.trigger_divisor,
        "initial": chosen.trigger_initial,
    }
    paper = {"threshold": (0.1, 0.2, 0.3), "decay": (0.1, 0.2, 0.1)}
    result = {}
    for name, value in given.items():
        if value is None and name in paper:
            value = np.resize(paper[name], sensors)
        values = validation.not_negative(f"trigger_{name}", value, (sensors,))
        result[name] = tuple(values.tolist())
    return result


_PAGE = """
    An oscillator measured by three sensors that see nothing below a threshold, over a network
    with a token bucket: which sensor should transmit, and when?

    ## Description
    A two-dimensional rotation by 0.052 π a step, driven by noise. Three sensors measure both
    states with noise of variance 0.5 and report max(z, 0) of each component. At every step the
    policy requests transmissions; the bucket (5 tokens a step, 30 at most, 3 a transmission)
    grants or denies; each node runs a Tobit Kalman filter on what got through, and the centre
    fuses the three and feeds the result back.

    ## Action space
    ``MultiBinary(sensors)``: 1 requests a transmission of that sensor's measurement. With
    ``action="discrete"`` it is ``Discrete(2**sensors)``, the bits as one number, sensor 0 lowest.

    ## Observation space
    A ``Box`` of float32; ``env.unwrapped.observation_names`` names every entry. Entries marked *
    are missing with ``information="centre"``.

    | entries | meaning | range |
    |---|---|---|
    | whitened_innovation[sensor,component] * | innovation over its predicted deviation | -5..5 |
    | censored[sensor,component] * | whether the component is at its threshold | 0, 1 |
    | held_difference[sensor,component] * | (measurement - last delivered) / 2√R | -5..5 |
    | uncensored_probability[sensor,component] | predicted | 0..1 |
    | age[sensor] | a/(a + 10), a steps since the last delivery | 0..1 |
    | log_variance[state] | ln of the predicted variance over its open-loop mean | -5..5 |
    | estimate[state] | prediction over the state's root mean square | -5..5 |
    | tokens | over the capacity | 0..1 |

    ## Reward
    -(error_weight · Σ wᵢ eᵢ² + cost_weight · tokens spent), e the fused estimate's error at the
    time of the request. By default all wᵢ are equal and never transmitting costs about 1 a step.
    ``error="trace"`` takes the claimed covariance instead; under the paper's filter a delivery
    can raise it, so such an agent learns silence. ``info["rewards"]`` has the two terms.

    ## Starting state
    x₀ ~ N((5, 0), 0.1 I), or with ``random_start=True`` about a random point at the same
    distance, known to the filters. The first measurement is known to the centre free of charge.

    ## Episode end
    Truncation after ``horizon`` steps, never termination.

    ## Info
    ``cost`` = ``cost_tokens`` (tokens spent, >= 0), ``rewards`` (``error``, ``cost``),
    ``granted`` and ``denied`` (one a sensor), ``squared_error`` (one a state), ``diverged``
    (a squared error above 100 times its open-loop mean, or not finite).

    ## Arguments
    The fields of :class:`TobitOscillatorOptions`; docs/tobit_oscillator.md explains each, and
    what the paper's text gets wrong.

    ## Version history
    - v0: first version.
"""


class TobitOscillatorEnv(RegisteredEnv):
    __doc__ = _PAGE
    build = staticmethod(build)


class TobitOscillatorVectorEnv(RegisteredVectorEnv):
    __doc__ = _PAGE
    build = staticmethod(build)
