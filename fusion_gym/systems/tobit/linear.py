"""A linear system of your own: any plant, any number of sensors, a network and a fusion centre."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, cast

import numpy as np
import scipy
from numpy.typing import ArrayLike

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.task import Scenario
from fusion_gym.declaration import NumpyOnly, plain_options
from fusion_gym.systems.bases import numbered_states
from fusion_gym.systems.linear_plant import LinearPlant
from fusion_gym.systems.schedule import read_schedule, scheduled_parts
from fusion_gym.systems.silence import Trigger
from fusion_gym.systems.tobit import centres, system
from fusion_gym.systems.tobit.filters import TobitKalmanFilter
from fusion_gym.systems.tobit.sensors import CensoredSensors

_JOINT = "joint_measurement_covariance"
_HELD = "a centre that holds values cannot hold an estimate"
_SCHEDULED = (
    "transition", "process_covariance", "measurement_matrices", "measurement_covariances",
)  # fmt: skip
_STEP = 0.1  # seconds between two samples of the default target
_REFERENCE_HORIZON = 10


_FILTERS = {
    "kalman": centres.FILTERS["kalman"],
    "tobit": centres.at_the_nodes(TobitKalmanFilter),
    "adf": centres.FILTERS["adf"],
    "stochastic": centres.FILTERS["stochastic"],
    "joint": centres.Filter(centres.JointCentre, centres.joint_centre),
    "local": centres.Filter(
        centres.LocalCentre, partial(centres.joint_centre, kind=centres.LocalCentre)
    ),
    "hold": centres.Filter(
        centres.HoldCentre,
        lambda options, sensors: centres.hold_centre(sensors, _system(options)[0]),
    ),
    "truncated": centres.Filter(
        centres.TruncatedCentre, centres.truncated_centre, own=("trigger", "trigger_threshold")
    ),
}
# Observed variances are relative to those after so many silent steps: a target that nobody sees
# drifts far beyond what is ever unknown of it.


@dataclass(frozen=True)
class LinearFusionOptions(system.FeedbackOptions):
    """Any linear plant x' = A x + w and any sensors y = C x + v, each of its own size.

    Every sensor has a Kalman filter; the centre fuses them and feeds the result back. If a sensor
    is censored, the default is one assumed-density filter at the centre. At every step the policy
    requests transmissions, and the token bucket grants or denies them.

    A sensor whose covariance R is not diagonal reports the equivalent R^(-1/2) y.

    Noises of different sensors are independent, unless you replace ``measurement_covariances`` by
    ``joint_measurement_covariance``, the covariance of all channels of all sensors in their order.
    The centre then processes the deliveries in one filter (``"joint"``), or covariance intersection
    joins the nodes' estimates.

    Starting state: x₀ ~ N(``initial_mean``, ``initial_covariance``), by default zero and the
    identity. The centre receives the first measurement without charge, and the first estimate uses
    it.

    The defaults are a target in one dimension, sampled every 0.1 s, with white acceleration. One
    sensor measures its position in metres, one its velocity in metres per second.

    v2: ``reward_scale`` multiplies the state weights: by default requests at an even pace have
    errors that cost 1 a step. These errors scale the entries of beliefs. The price of a token is
    0.5.

    Example:
        >>> import fusion_gym
        >>> from fusion_gym.systems.tobit.linear import LinearFusionOptions
        >>> options = LinearFusionOptions(transition=[[0.9]], process_covariance=[[1.0]],
        ...     measurement_matrices=[[1.0]])
        >>> task = fusion_gym.make_task(options)
        >>> task.sensors, task.plant.state_names
        (1, ('x1',))
    """

    filters: ClassVar[Mapping[str, type]] = centres.classes(_FILTERS)
    transition: ArrayLike = ((1.0, _STEP), (0.0, 1.0))
    """A of x(t+1) = A x(t) + w(t), (n, n)."""
    process_covariance: ArrayLike = ((_STEP**3 / 3.0, _STEP**2 / 2.0), (_STEP**2 / 2.0, _STEP))
    """Covariance W of the process noise w, (n, n)."""
    initial_mean: ArrayLike | None = None
    """Mean of x₀, (n,). By default 0."""
    initial_covariance: ArrayLike | None = None
    """Covariance of x₀, (n, n). By default I."""
    state_names: Sequence[str] | None = None
    """Names of the states in tables, figures and the observation. By default x1, x2, …"""
    measurement_matrices: Sequence[ArrayLike] = ((1.0, 0.0), (0.0, 1.0))
    """C of each sensor, y = clip(C x + v, τ, υ): a matrix (channels, n), or one row (n,)."""
    measurement_covariances: ArrayLike | Sequence[ArrayLike] = 0.25
    """Covariance R of each sensor's noise v: a matrix or a variance per sensor, or one variance for
    all channels."""
    joint_measurement_covariance: ArrayLike | None = None
    """Covariance of all channels of all sensors, in place of ``measurement_covariances``, where
    noises of different sensors are correlated."""
    censoring_threshold: ArrayLike | Sequence[ArrayLike] = -np.inf
    """Lower limit τ: one number, one per sensor, or a list for each sensor with one per channel."""
    censoring_upper: ArrayLike | Sequence[ArrayLike] = np.inf
    """Upper limit υ: one number, one per sensor, or a list for each sensor with one per channel."""
    schedule: Mapping[str, Any] | str | None = None
    """Matrices that vary with the step, in place of the options of these names: a dictionary, or
    the path of a YAML or .npz file. ``transition`` and ``process_covariance`` are stacks (T, n, n);
    ``measurement_matrices`` and ``measurement_covariances`` have a stack for each sensor, (T, m, n)
    or (T, n), and (T, m, m) or (T,). Entry k leads from step k to k + 1, or measures at step k.
    After T steps the stacks repeat; with ``end: hold`` the last entry stays. Observed differences
    are relative to the noise of step 0."""
    reward_scale: float | Literal["auto"] | None = "auto"
    cost_weight: float | Literal["random"] = 0.5
    token_rate: ArrayLike = 1.0
    token_capacity: ArrayLike = 15.0
    initial_tokens: ArrayLike = 6.0
    filter: Annotated[str | None, _FILTERS, NumpyOnly("hold", "local", "truncated")] = None
    """Filter of the nodes, by default ``"kalman"``. With correlated noises the default is
    ``"joint"``, one Kalman filter at the centre. ``"local"`` is that filter without feedback: a
    sensor predicts from its own deliveries. With censored sensors the default is ``"adf"``, one
    assumed-density filter at the centre. ``"tobit"`` is the Tobit Kalman filter. ``"stochastic"``
    is the Kalman filter for the policy ``stochastic_event``. ``"hold"`` is the state that fits the
    last delivered values best, weighted by their noises, without a filter. ``"truncated"`` is one
    Kalman filter at the centre that uses the silence of the policy ``trigger``, so that other
    policies raise an error."""
    trigger: Trigger | None = None
    """Policy whose silence ``filter="truncated"`` uses."""
    trigger_threshold: ArrayLike | None = None
    """Threshold or reportable change of the policy ``trigger``: one number, or one per sensor, in
    the unit of the measurement."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "schedule", read_schedule(self.schedule))

    def nominal(self) -> LinearFusionOptions:
        """Return the options whose simulation scales the reward, equal for all filters."""
        own = ("filter", "fusion", "information_shares", "order", "stochastic_weight", "trigger")
        left_out: dict[str, Any] = dict.fromkeys((*own, "trigger_threshold"))
        return replace(super().nominal(), **left_out)


def build_linear(choice: LinearFusionOptions) -> Scenario:
    """Return the scenario of these options."""
    validation.horizon(choice.horizon)
    plant, sensors = _system(choice)
    correlated = sensors.noise_correlation is not None
    if choice.filter is None:
        default = "joint" if correlated else "kalman"
        choice = replace(choice, filter=default if sensors.unlimited else "adf")
    if correlated:
        _check_rules(choice)
    holds = choice.filter == "hold"
    scenario = system.feedback_scenario(
        choice,
        _FILTERS,
        system.CensoredPlant(plant, sensors, _names(choice.state_names, plant.size)),
        _REFERENCE_HORIZON,
        memory_filter="kalman" if holds else None,
        known_start=True,
        no_estimates=_HELD if holds else None,
        required_policy=choice.trigger,
    )
    centre = cast(Any, scenario.estimator).centre
    if isinstance(centre, centres.TruncatedCentre):
        scenario.policy_defaults.update(centre.silence.policy_defaults)
    return scenario


def _system(options: LinearFusionOptions) -> Sequence[Any]:
    """Return plant and sensors."""
    return scheduled_parts(options, _SCHEDULED, _parts)


def _parts(options: LinearFusionOptions, _: object) -> tuple[LinearPlant, CensoredSensors]:
    transition = validation.array("transition", options.transition, (None, None))
    size = len(transition)
    mean = np.zeros(size) if options.initial_mean is None else options.initial_mean
    start = np.eye(size) if options.initial_covariance is None else options.initial_covariance
    plant = LinearPlant.create(transition, options.process_covariance, mean, start)
    return plant, _sensors(options, size)


def _sensors(options: LinearFusionOptions, states: int) -> CensoredSensors:
    """Return sensors with the channels of the largest; the last channels of the others are absent.

    A sensor whose own covariance R is not diagonal reports F⁻¹ y with F Fᵀ = R.

    Args:
        options: options of the environment.
        states: number of states n.

    Raises:
        ConfigurationError: a value that is not allowed, or censoring of correlated sensors.
    """
    joint, covariances = options.joint_measurement_covariance, options.measurement_covariances
    default = LinearFusionOptions.measurement_covariances
    if joint is not None and plain_options(covariances) != default:
        allowed = "left out with joint_measurement_covariance"
        raise validation.refusal("measurement_covariances", covariances, allowed)
    rows = _matrices(options.measurement_matrices, states)
    sizes = [len(row) for row in rows]
    shape = (len(sizes), max(sizes))
    low = _limits("censoring_threshold", options.censoring_threshold, sizes, -np.inf)
    high = _limits("censoring_upper", options.censoring_upper, sizes, np.inf)
    present = np.arange(shape[1]) < np.array(sizes)[:, None]
    whole = None
    if joint is None:
        own = _covariances(covariances, sizes)
    else:
        whole = validation.covariance(_JOINT, joint, sum(sizes), definite=True)
        ends = np.cumsum(sizes)
        own = [whole[end - n : end, end - n : end] for n, end in zip(sizes, ends, strict=True)]
    limited = [bool(np.isfinite(ends).any()) for ends in np.concatenate([low, high], axis=1)]
    matrix, variance, factors = np.zeros((*shape, states)), np.ones(shape), []
    for place, (size, covariance) in enumerate(zip(sizes, own, strict=True)):
        factor: Array = np.eye(size)
        variances = np.diagonal(covariance)
        if np.count_nonzero(covariance - np.diag(variances)):
            if limited[place]:
                name = f"measurement_covariances[{place}]" if whole is None else _JOINT
                allowed = f"diagonal for the censored sensor {place}"
                raise validation.refusal(name, covariance, allowed)
            factor, variances = linalg.cholesky(covariance[..., None])[..., 0], np.ones(size)
        matrix[place, :size] = np.linalg.solve(factor, rows[place])
        variance[place, :size] = variances
        factors.append(factor)
    sensors = CensoredSensors.create(matrix, variance, low, states, high, present)
    if whole is None or not np.count_nonzero(whole - scipy.linalg.block_diag(*own)):
        return sensors
    if any(limited):
        allowed = "without correlations between sensors, because some are censored"
        raise validation.refusal(_JOINT, joint, allowed)
    scale = scipy.linalg.block_diag(*factors) * np.sqrt(variance[present])
    factor, places = np.eye(present.size), np.flatnonzero(present)
    factor[np.ix_(places, places)] = np.linalg.solve(scale, np.linalg.cholesky(whole))
    return replace(sensors, noise_correlation=factor[..., None])


def _matrices(value: Any, states: int) -> list[Array]:
    result = []
    for place, item in enumerate(validation.entries("measurement_matrices", value, "a matrix")):
        name = f"measurement_matrices[{place}]"
        row = len(validation.array_shape(item) or ()) == 1
        matrix = validation.array(name, item, (states,) if row else (None, states))
        result.append(matrix[None] if row else matrix)
    return result


def _each(name: str, value: Any, kind: str, sensors: int) -> list[tuple[str, Any]]:
    """Return field and value of each sensor, from one number for all or one entry for each."""
    if validation.array_shape(value) == ():
        return [(name, value)] * sensors
    entries = validation.entries(name, value, kind, count=sensors)
    return [(f"{name}[{place}]", entry) for place, entry in enumerate(entries)]


def _covariances(values: Any, sizes: Sequence[int]) -> list[Array]:
    each = _each("measurement_covariances", values, "a covariance or a variance", len(sizes))
    result = []
    for size, (full, value) in zip(sizes, each, strict=True):
        if validation.array_shape(value) == ():
            value = validation.number(full, value, at_least=validation.SMALLEST**2) * np.eye(size)
        result.append(validation.covariance(full, value, size, definite=True))
    return result


def _limits(name: str, values: Any, sizes: Sequence[int], none: float) -> Array:
    """Return limits (sensors, m); absent channels have the limit ``none``."""
    each = _each(name, values, "a number or a list", len(sizes))
    result = np.full((len(sizes), max(sizes)), none)
    for place, (size, (full, value)) in enumerate(zip(sizes, each, strict=True)):
        result[place, :size] = validation.spread(full, value, (size,), infinity=int(np.sign(none)))
    return result


def _names(value: Any, states: int) -> tuple[str, ...]:
    """Return the states' names, by default x1, x2 and so on."""
    if value is None:
        return numbered_states(states)
    listed = isinstance(value, (list, tuple)) and len(value) == len(set(map(repr, value))) == states
    if not listed or not all(isinstance(name, str) and name.isidentifier() for name in value):
        words = f"a list of {states} different words of letters, digits and '_'"
        raise validation.refusal("state_names", value, words)
    return tuple(value)


def _check_rules(options: LinearFusionOptions) -> None:
    """Refuse a filter or a fusion that would count the sensors' common noise several times."""
    why = "because the sensors' noises are correlated"
    for name in ("filter", "memory_filter"):
        kind = getattr(options, name)
        if kind not in (None, "joint", "local", "kalman"):
            raise validation.refusal(name, kind, f"'joint', 'local' or 'kalman', {why}")
        if kind == "kalman" and options.fusion not in ("ci", "sci"):
            allowed = f"'ci' or 'sci' with {name}='kalman', {why}"
            raise validation.refusal("fusion", options.fusion, allowed)
