"""Remote estimation of scalar sources, the case with a solved optimum: options, environment.

Source: J. Chakravorty and A. Mahajan, "Remote estimation over a packet-drop channel with
Markovian state", IEEE Trans. Automatic Control 65, 2020 (arXiv 1807.09706).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.plant import Nature
from fusion_gym.core.task import PaperOptions, Scenario
from fusion_gym.core.token_bucket import TokenBucket, Tokens
from fusion_gym.declaration import NumpyOnly
from fusion_gym.errors import forbidden
from fusion_gym.systems.bases import numbered_states
from fusion_gym.systems.linear_control import ControlOptions, linear_controller
from fusion_gym.systems.remote import vector
from fusion_gym.systems.remote.system import RemoteEstimator, ScalarSources
from fusion_gym.systems.silence import Silence, Trigger

_FILTERS: dict[str, type] = {"symmetric": RemoteEstimator, "truncated": Silence}


@dataclass(frozen=True)
class RemoteEstimationOptions(ControlOptions, PaperOptions):
    """Scalar sources that a remote estimator tracks at a price for every packet.

    The optimum of this problem is known. Source i follows x(t+1) = a x(t) + w(t), w ~ N(0, σ²), and
    sensor i measures it without noise. The centre's estimate is the delivered value, and a x̂
    without a delivery. A channel may lose granted packets: independently, or as a Gilbert-Elliott
    channel whose last state is fed back and observed (``channel="gilbert_elliott"``). With one
    source, or several that share nothing, the optimal policy is a threshold on the absolute error
    that depends on channel state and tokens. ``fusion_gym.solvers`` computes it.

    Starting state: x(0) ~ N(0, initial_deviation²), by default 0; the centre's estimate is 0.

    With the defaults the reward is the negative of the literature's cost: the squared error plus
    ``cost_weight`` for each transmission.

    Example:
        >>> import fusion_gym
        >>> from fusion_gym.systems.remote.environment import RemoteEstimationOptions
        >>> options = RemoteEstimationOptions(sensors=2, channel="independent")
        >>> task = fusion_gym.make_task(options)
        >>> task.sensors, task.horizon
        (2, 200)
    """

    filters: ClassVar[Mapping[str, type]] = _FILTERS
    sources: Sequence[Any] | None = None
    """Vector sources, each with a sensor whose steady Kalman filter sends its estimate: a list of
    mappings with ``transition`` A (n, n), ``process_covariance`` W, ``measurement_matrix`` C
    (m, n) and ``measurement_covariance`` R. A pair (count, seed) draws sources of a growing and a
    decaying state. ``None`` is ``sensors`` scalar sources."""
    sensors: int = 1
    """Number of scalar sources, each with one sensor."""
    coefficient: ArrayLike = 1.0
    """Coefficient a of a source: one number, or one per source."""
    noise_deviation: ArrayLike = 1.0
    """Deviation σ of a source's noise: one number, or one per source."""
    initial_deviation: ArrayLike = 0.0
    """Deviation of x(0) about 0: one number, or one per source."""
    error_scale: ArrayLike | None = None
    """Divisor of the observed errors: one number, or one per source. By default about the optimal
    threshold of a random walk at a price of 5, or at the rate that the tokens allow."""
    filter: Annotated[str, _FILTERS, NumpyOnly("truncated")] = "symmetric"
    """Estimator of the centre. ``"symmetric"`` repeats its prediction in silence. ``"truncated"``
    uses the silence of the policy ``trigger``, and other policies raise an error."""
    trigger: Trigger | None = None
    """Policy whose silence ``filter="truncated"`` uses."""
    trigger_threshold: ArrayLike | None = None
    """Threshold or reportable change of the policy ``trigger``: one number, or one per source."""
    tokens: Tokens = "unlimited"
    token_rate: ArrayLike = 0.25
    token_capacity: ArrayLike = 5.0
    initial_tokens: ArrayLike = 1.0
    token_cost: ArrayLike = 1.0
    horizon: int = 200
    cost_weight: float | Literal["random"] = 5.0

    def nominal(self) -> RemoteEstimationOptions:
        """Return the options whose simulation scales the reward, equal for all filters."""
        return replace(super().nominal(), filter="symmetric", trigger=None, trigger_threshold=None)


_OF_SCALARS = (
    "sensors", "coefficient", "noise_deviation", "initial_deviation", "error_scale", "filter",
    "trigger", "trigger_threshold",
)  # fmt: skip
_SILENCE = 3  # steps of silence whose deviation scales observed differences, at least
_WHERE = "with filter='symmetric'"
_USUAL_PRICE = 5.0  # of a packet, in squared deviations of the noise


def build_remote(options: RemoteEstimationOptions) -> Scenario:
    """Return the scenario of these options."""
    if options.sources is not None:
        return _build_vector(options)
    most = validation.MOST_SENSORS
    sensors = validation.integer("sensors", options.sensors, at_least=1, at_most=most)
    chosen = options.own_weights(sensors)
    weights = np.ones(sensors) if chosen is None else chosen
    deviation = validation.positive("noise_deviation", options.noise_deviation, (sensors,))
    coefficient = validation.spread("coefficient", options.coefficient, (sensors,))
    initial = validation.not_negative("initial_deviation", options.initial_deviation, (sensors,))
    law = coefficient, deviation, initial
    controller, matrix = linear_controller(options, np.diag(coefficient))
    nature = _nature(options, coefficient)
    sources = ScalarSources(numbered_states(sensors), *law, nature, matrix)
    silence = _silence(options, sensors)
    return Scenario(
        options,
        sources,
        RemoteEstimator(sources, _error_scale(options, deviation), weights, silence),
        weights,
        controller=controller,
        nodes_have_memory=True,  # a source's value is all that there is to know of it
        no_estimates="a packet carries the source's value",
        policy_defaults={} if silence is None else silence.policy_defaults,
        required_policy=options.trigger,
    )


def _build_vector(options: RemoteEstimationOptions) -> Scenario:
    for name in _OF_SCALARS:
        if getattr(options, name) != getattr(RemoteEstimationOptions, name):
            reason = "it belongs to scalar sources"
            raise forbidden(name, getattr(options, name), reason, "with sources")
    model = vector.VectorSources.create(
        vector.make_sources(options.sources), options, validation.horizon(options.horizon)
    )
    size, sensors = len(model.state_names), model.sensor_count
    whole = model.whole(model.transition)[..., 0]
    controller, matrix = linear_controller(options, whole)
    model = replace(model, input_matrix=matrix)
    chosen = options.own_weights(size)
    weights = np.ones(size) if chosen is None else chosen
    steps = max(_SILENCE, round(float(_steps(options, sensors).max())))
    estimator = vector.VectorEstimator(model, vector.vector_scale(model, steps), weights)
    return Scenario(
        options,
        model,
        estimator,
        weights,
        controller=controller,
        nodes_have_memory=True,  # a node's estimate has all its measurements
        no_estimates="a packet carries the node's estimate",
    )


def _silence(options: RemoteEstimationOptions, sensors: int) -> Silence | None:
    """Return the silence that the estimator uses."""
    validation.choice("filter", options.filter, _FILTERS)
    if options.filter == "truncated":
        return Silence.create(options, sensors, 1)
    for name in ("trigger", "trigger_threshold"):
        if getattr(options, name) is not None:
            raise validation.refusal(name, getattr(options, name), "left out", _WHERE)
    return None


def _nature(options: RemoteEstimationOptions, coefficient: Array) -> Nature:
    """Return the departure of the truth: a source moves by c a instead of a."""
    absent = ("true_measurement_noise", "true_threshold_shift")
    nature = Nature.create(options, absent if coefficient.any() else (*absent, "true_transition"))
    largest = float(np.abs(coefficient).max())
    nature.check_growth(lambda factor: factor * largest, validation.horizon(options.horizon))
    return nature


def _error_scale(options: RemoteEstimationOptions, deviation: Array) -> Array:
    """Return the divisor (n,) of observed errors: about a random walk's optimal threshold.

    For unlimited tokens it is (6 price)^1/4 at unit noise and the environment's default price, and
    else σ/√r at a rate r of transmissions. Options of the price do not change it.
    """
    sensors = len(deviation)
    if options.error_scale is not None:
        return validation.positive("error_scale", options.error_scale, (sensors,))
    bucket = TokenBucket(options, sensors)
    if bucket.unlimited:
        single = (6.0 * _USUAL_PRICE) ** 0.25
        shared = math.sqrt(sensors) if options.access != "any" else 1.0
        return deviation * max(single, shared)
    return deviation * np.sqrt(_steps(options, sensors))


def _steps(options: RemoteEstimationOptions, sensors: int) -> Array:
    """Return the steps between two packets of a sensor, at least 1, that the network sustains."""
    bucket = TokenBucket(options, sensors)
    least = float(sensors) if options.access != "any" else 1.0
    steps = 0.0 if bucket.unlimited else bucket.round_cost / np.maximum(bucket.rate, 1e-3)
    return np.maximum(np.ravel(steps), least)
