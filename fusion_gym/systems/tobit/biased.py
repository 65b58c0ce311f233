"""Stochastic bias under two-sided censoring: an oscillator and a tracked target.

Source: round_robin_tobit, H. Geng, Z. Wang, F. E. Alsaadi, K. H. Alharbi and Y. Cheng, "Federated
Tobit Kalman filtering fusion with dead-zone-like censoring and dynamical bias under the
Round-Robin protocol", IEEE Transactions on Signal and Information Processing over Networks 7,
2021, Section IV.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike

from fusion_gym import validation
from fusion_gym.core.access import AccessRule
from fusion_gym.core.reward import equal_weights
from fusion_gym.core.task import Scenario
from fusion_gym.core.token_bucket import Tokens
from fusion_gym.systems.bases import numbered_states
from fusion_gym.systems.linear_plant import LinearPlant
from fusion_gym.systems.tobit import centres, system
from fusion_gym.systems.tobit.filters import TobitKalmanFilter
from fusion_gym.systems.tobit.sensors import CensoredSensors

_ANGLE = 0.052 * math.pi
_COS, _SIN = math.cos(_ANGLE), math.sin(_ANGLE)
_FILTERS = {"paper": centres.at_the_nodes(TobitKalmanFilter), **centres.FILTERS}
_PERIOD = 0.1  # seconds between two samples of the tracking example
# Observed variances are relative to those after so many silent steps: over a whole episode the
# target, a double integrator of a random walk, drifts thousands of times as far as it is known.
_REFERENCE_HORIZON = 10


@dataclass(frozen=True)
class BiasedOscillatorOptions(system.FeedbackOptions):
    """An oscillator driven by a stochastic bias, observed by two sensors that saturate at ±5.

    The bias drives the state and no sensor measures it. Each sensor measures one component of the
    state and clips it to an interval. One sensor may transmit per step. The nodes run Tobit Kalman
    filters on state and bias together. The centre fuses them and feeds the result back.

    Starting state: x₀ ~ N((5, 0), 0.1 I), b₀ ~ N(0, 0.1). The centre receives the first measurement
    without charge.

    The defaults are the oscillator of the paper's Section IV.A. The paper does not give, and we
    chose: ``information_shares`` (equal) and the reward.

    v2: by default requests at an even pace have errors that cost 1 a step, and the price of a token
    is 0.3. In v1 it was 0.01, so that a learner saw little but the error's noise.

    Example:
        >>> import fusion_gym
        >>> from fusion_gym.systems.tobit.biased import BiasedOscillatorOptions
        >>> options = BiasedOscillatorOptions(censoring_upper=8.0)
        >>> task = fusion_gym.make_task(options)
        >>> task.sensors, task.options.access, task.horizon
        (2, 'single', 100)
    """

    filters: ClassVar[Mapping[str, type]] = centres.classes(_FILTERS)
    transition: ArrayLike = ((_COS, -_SIN), (_SIN, _COS))
    """A of equation (1), (n, n)."""
    process_covariance: ArrayLike = ((0.0025, 0.0), (0.0, 0.0025))
    """Covariance Q of the process noise ω, equation (1), (n, n)."""
    initial_mean: ArrayLike = (5.0, 0.0)
    """Mean of x₀, (n,)."""
    initial_covariance: ArrayLike = ((0.1, 0.0), (0.0, 0.1))
    """Covariance of x₀, (n, n)."""
    bias_gain: ArrayLike = ((0.1,), (0.15,))
    """B of equation (1), (n, biases)."""
    bias_transition: ArrayLike = ((1.0,),)
    """H of equation (3), (biases, biases)."""
    bias_noise_covariance: ArrayLike = ((0.25,),)
    """Covariance Ξ of the bias's noise ε, equation (3), (biases, biases)."""
    bias_initial_mean: ArrayLike = (0.0,)
    """Mean of b₀, (biases,)."""
    bias_initial_covariance: ArrayLike = ((0.1,),)
    """Covariance of b₀, (biases, biases)."""
    random_start: bool = False
    """Whether the initial mean has a random direction, which the filters know."""
    measurement_matrices: ArrayLike = (((1.0, 0.0),), ((0.0, 1.0),))
    """C of each sensor on x, equation (2), (sensors, components, n)."""
    measurement_variance: ArrayLike = 0.6
    """Variance R of the measurement noise, equation (2): one number or (sensors, components)."""
    censoring_threshold: ArrayLike = -5.0
    """Lower limit τ of equation (6): one number or (sensors, components). Minus infinity never
    censors."""
    censoring_upper: ArrayLike = 5.0
    """Upper limit υ of equation (6): one number or (sensors, components). Infinity never
    censors."""
    reward_scale: float | Literal["auto"] | None = "auto"
    cost_weight: float | Literal["random"] = 0.3
    access: AccessRule = "single"
    tokens: Tokens = "unlimited"
    token_rate: ArrayLike = 1.0
    token_capacity: ArrayLike = 15.0
    initial_tokens: ArrayLike = 6.0
    filter: Annotated[str, _FILTERS] = "paper"
    """Filter of the nodes. ``"paper"`` is the Tobit Kalman filter of equations (18)-(25),
    corrected. ``"kalman"`` ignores censoring. ``"adf"`` is one assumed-density filter at the
    centre. ``"stochastic"`` is the Kalman filter for the policy ``stochastic_event``."""
    bias_aware: bool = True
    """Whether the filters know that the bias acts on x."""


@dataclass(frozen=True)
class BiasedTrackingOptions(BiasedOscillatorOptions):
    """A target with an unknown acceleration, whose position and velocity are measured.

    The state is position in metres and velocity in metres per second, sampled every 0.1 s; the bias
    is the acceleration. Sensor 0 measures the position, sensor 1 the velocity, practically
    uncensored. One of them may transmit per step. The nodes run Tobit Kalman filters on state and
    bias together. The centre fuses them and feeds the result back.

    Starting state: x₀ ~ N((10, 0), I), b₀ ~ N(0, 0.1). The centre receives the first measurement
    without charge.

    The defaults are the target of the paper's Section IV.B. The paper does not give, and we chose:
    ``information_shares`` (equal) and the reward.

    Example:
        >>> import fusion_gym
        >>> from fusion_gym.systems.tobit.biased import BiasedTrackingOptions
        >>> options = BiasedTrackingOptions(horizon=50)
        >>> task = fusion_gym.make_task(options)
        >>> task.sensors, task.options.access, task.horizon
        (2, 'single', 50)
    """

    reward_scale: float | Literal["auto"] | None = None
    cost_weight: float | Literal["random"] = 0.01
    transition: ArrayLike = ((1.0, _PERIOD), (0.0, 1.0))
    process_covariance: ArrayLike = ((0.0025, 0.0), (0.0, 0.0025))
    initial_mean: ArrayLike = (10.0, 0.0)
    initial_covariance: ArrayLike = ((1.0, 0.0), (0.0, 1.0))
    bias_gain: ArrayLike = ((0.5 * _PERIOD**2,), (_PERIOD,))
    measurement_variance: ArrayLike = ((0.1,), (0.3,))
    censoring_threshold: ArrayLike = ((-1000.0,), (-200.0,))
    censoring_upper: ArrayLike = ((1000.0,), (200.0,))


def build_biased_tracking(options: BiasedTrackingOptions) -> Scenario:
    """Return the target's scenario."""
    return build_biased_oscillator(options)


def build_biased_oscillator(options: BiasedOscillatorOptions) -> Scenario:
    """Return the oscillator's scenario."""
    horizon = validation.horizon(options.horizon)
    plant, states = _augmented(options, aware=True)
    model = plant if options.bias_aware else _augmented(options, aware=False)[0]
    shape = (None, None, states)
    matrices = validation.array("measurement_matrices", options.measurement_matrices, shape)
    sensors = CensoredSensors.create(
        np.pad(matrices, ((0, 0), (0, 0), (0, plant.size - states))),
        options.measurement_variance,
        options.censoring_threshold,
        plant.size,
        options.censoring_upper,
    )
    biases = plant.size - states
    own = ("b",) if biases == 1 else tuple(f"b{i + 1}" for i in range(biases))
    names = numbered_states(states) + own
    return system.feedback_scenario(
        options,
        _FILTERS,
        system.CensoredPlant(plant, sensors, names, options.random_start),
        _REFERENCE_HORIZON,
        model=model,
        state_weights=equal_weights(plant.open_loop(horizon)),
    )


def _augmented(options: BiasedOscillatorOptions, aware: bool) -> tuple[LinearPlant, int]:
    """Return the plant of ξ = [x; b], equations (10) and (11), and the number of states in x.

    In the model of a filter that is not bias-aware, b has no effect on x.
    """
    transition = validation.square("transition", options.transition)
    states = len(transition)
    gain = validation.array("bias_gain", options.bias_gain, (states, None))
    biases = gain.shape[1]
    process = validation.covariance("process_covariance", options.process_covariance, states)
    noise = validation.covariance("bias_noise_covariance", options.bias_noise_covariance, biases)
    start = validation.covariance("initial_covariance", options.initial_covariance, states)
    bias_start = validation.covariance(
        "bias_initial_covariance", options.bias_initial_covariance, biases
    )
    inner = validation.array("bias_transition", options.bias_transition, (biases, biases))
    mean = validation.array("initial_mean", options.initial_mean, (states,))
    bias_mean = validation.array("bias_initial_mean", options.bias_initial_mean, (biases,))
    mean, start = np.concatenate([mean, bias_mean]), scipy.linalg.block_diag(start, bias_start)
    joint = np.block([[transition, gain if aware else 0.0 * gain], [np.zeros_like(gain.T), inner]])
    return LinearPlant.create(joint, scipy.linalg.block_diag(process, noise), mean, start), states
