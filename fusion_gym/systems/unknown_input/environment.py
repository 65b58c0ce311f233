"""Two carts under an unknown force, or the paper's example: numbers, options, environment.

Source: unknown_input, Y. Sun, M. Fu, J. Mao and G. Wei, "Recursive filtering of multi-rate
cyber-physical systems with unknown inputs under adaptive event-triggered mechanisms", Frontiers of
Information Technology & Electronic Engineering 24, 2023, Section 4.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal, get_args

import numpy as np
import scipy
from numpy.typing import ArrayLike

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.plant import LARGEST_ERROR, Nature
from fusion_gym.core.task import PaperOptions, Scenario
from fusion_gym.core.token_bucket import Tokens
from fusion_gym.errors import forbidden, refusal
from fusion_gym.fusion.table import Structure, choose_rule
from fusion_gym.systems.bases import numbered_states
from fusion_gym.systems.unknown_input import filters
from fusion_gym.systems.unknown_input.nodes import NodeFusion, Nodes, RunNodes, TableNodes
from fusion_gym.systems.unknown_input.plant import (
    SHAPE,
    InputSensors,
    UnknownInputPlant,
    make_signal,
)
from fusion_gym.systems.unknown_input.system import DrivenPlant, UnknownInputEstimator


def two_carts(step: float = 0.25) -> tuple[Array, Array, Array]:
    """Two carts of 1 kg in a row: transition, input matrix and process covariance of one step.

    States: position and velocity of cart 1 and of cart 2, in m and m/s. A spring of 1 N/m with a
    damper of 0.6 N s/m ties cart 1 to a wall and another such pair ties the carts together. The
    unknown input is a force on cart 1, in N; white forces of the spectral density 0.02 N² s shake
    both carts. ``step`` is in seconds, the discretisation exact.
    """
    stiffness, damping, density = 1.0, 0.6, 0.02
    drift = np.array(
        [
            [0.0, 1.0, 0.0, 0.0],
            [-2 * stiffness, -2 * damping, stiffness, damping],
            [0.0, 0.0, 0.0, 1.0],
            [stiffness, damping, -stiffness, -damping],
        ]
    )
    force = np.array([[0.0], [1.0], [0.0], [0.0]])
    noise = density * np.diag([0.0, 1.0, 0.0, 1.0])
    moved = scipy.linalg.expm(np.block([[drift, force], [np.zeros((1, 5))]]) * step)
    # Van Loan's integral of exp(F t) G exp(F t)ᵀ
    pair = scipy.linalg.expm(np.block([[-drift, noise], [np.zeros((4, 4)), drift.T]]) * step)
    process = pair[4:, 4:].T @ pair[:4, 4:]
    return moved[:4, :4], moved[:4, 4:], (process + process.T) / 2


def _examples() -> dict[str, dict[str, Any]]:
    transition, inputs, process = two_carts()
    carts = {
        "transition": transition.tolist(),
        "input_matrix": inputs.tolist(),
        "process_covariance": process.tolist(),
        "initial_mean": (0.0, 0.0, 0.0, 0.0),
        "initial_covariance": np.diag([0.1, 0.1, 0.1, 0.1]).tolist(),
        # Cart 1; the velocity of cart 1 with the position of cart 2; the damper with cart 2
        "measurement_matrices": (
            ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0)),
            ((0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)),
            ((0.0, 1.0, 0.0, -1.0), (0.0, 0.0, 1.0, 0.0)),
        ),
        "measurement_covariance": ((0.0009, 0.0064), (0.0036, 0.0036), (0.0064, 0.0009)),
        "filter": "random_walk",
        "young_factor": 0.2,
        "input_memory": 0.9,
        "input_change": 0.3,
        "input_deviation": 0.7,
        "rho_bar": 0.09,
        "rho_initial": 0.04,
        "adaptation": 0.04,
        "signals": {
            "sinusoids": (((0.8, 0.6),), ((60.0, 25.0),), "random"),
            "steps": (0.7, 20.0, "random"),
            "random_walk": (0.7, 10.0, "random"),
        },
    }
    paper = {
        "transition": ((0.26, 0.3), (0.2, 0.1)),
        "input_matrix": ((1.10, 1.12), (1.15, 1.13)),
        "process_covariance": ((0.001, 0.0), (0.0, 0.001)),
        "initial_mean": (0.17, 0.17),
        "initial_covariance": ((0.01, 0.0), (0.0, 0.01)),
        "initial_half_width": 0.01,
        "measurement_matrices": (((1.12, 1.13), (1.10, 1.12)), ((1.31, 1.13), (1.31, 1.21))),
        "measurement_covariance": 0.001,
        "filter": "paper",
        "young_factor": 1.0,
        "input_memory": 1.0,
        "input_change": 0.02,
        "input_deviation": 0.1,
        "rho_bar": 0.05,
        "rho_initial": 0.01,
        "adaptation": 0.01,
        "signals": {
            "sinusoids": (0.1, ((50.0,), (35.0,)), ((0.0,), (1.0,))),
            "steps": (0.1, 20.0, "random"),
            "random_walk": (0.1, 10.0, "random"),
        },
    }
    return {"two_carts": carts, "paper": paper}


EXAMPLES = _examples()


_STRUCTURE = Structure(common="all contain the same process noise", holds=("tracked weights",))
Signal = Literal["sinusoids", "steps", "random_walk"]


FILTERS: dict[str, type] = {
    "random_walk": filters.RandomWalkInputFilter,
    "predict": filters.ExactInputStateFilter,
    "paper": filters.BoundTables,
}


@dataclass(frozen=True)
class UnknownInputOptions(PaperOptions):
    """Two carts, tied by springs, under an unknown force, measured in part by three sensors.

    The state is the positions and velocities of two carts. The force on the first is unknown to
    filters and policies; every episode draws it. The carts are sampled every second small step.
    Each node estimates the state and, one sampling instant late, the force from the deliveries of
    its sensor. The centre fuses the nodes by covariance intersection. Nothing is fed back.
    ``example="paper"`` gives the paper's system instead: two states, two inputs, two sensors, and
    its own filter. Lists of states end with the inputs, and the reward weighs the inputs' errors by
    ``input_weight``.

    Starting state: x₀ ~ N(0, 0.1 I), or, in the paper's example, uniform on [0.16, 0.18]. The
    measurement at time 0 has been delivered.

    ``None`` stands for the number of the chosen ``example``, which
    :mod:`fusion_gym.systems.unknown_input.environment` lists.

    Example:
        >>> import fusion_gym
        >>> from fusion_gym.systems.unknown_input.environment import UnknownInputOptions
        >>> options = UnknownInputOptions(input_signal="steps")
        >>> task = fusion_gym.make_task(options)
        >>> task.sensors, task.plant.state_names
        (3, ('position_1', 'velocity_1', 'position_2', 'velocity_2', 'force'))
    """

    filters: ClassVar[Mapping[str, type]] = FILTERS
    structure: ClassVar[Structure | None] = _STRUCTURE
    example: Annotated[str, EXAMPLES] = "two_carts"
    """Example that gives the numbers of all options that are ``None``."""
    transition: ArrayLike | None = None
    """A of one small step, equation (1), (n, n)."""
    input_matrix: ArrayLike | None = None
    """B of one small step, equation (1), (n, q)."""
    process_covariance: ArrayLike | None = None
    """Covariance W of the process noise of one small step, equation (1), (n, n)."""
    sampling_period: int = 2
    """Small steps a ≥ 1 of a sampling interval."""
    initial_mean: ArrayLike | None = None
    """Mean of x₀ that the filters assume, (n,)."""
    initial_covariance: ArrayLike | None = None
    """Covariance of x₀ that the filters assume, (n, n)."""
    initial_half_width: ArrayLike | None = None
    """Half width of a uniform distribution of x₀ about its mean; without it x₀ is normal. The
    example's does not hold beside a ``transition`` or an ``initial_mean``."""
    input_signal: Signal | ArrayLike = "sinusoids"
    """Unknown input. ``"steps"`` is a level that jumps with the probability 1/period,
    ``"random_walk"`` reverts to its mean with the correlation time period. An array
    (horizon + 1, q) is the same in every episode."""
    input_amplitude: ArrayLike | None = None
    """Amplitudes of the sinusoids: one number, (q, terms), or (terms,) with one input. Of steps and
    random walk: the standard deviation, one number, or one per input."""
    input_period: ArrayLike | None = None
    """Period in sampling instants, in the shape of the amplitude."""
    input_phase: ArrayLike | str | None = None
    """Phases of the sinusoids at time 0 in radians. ``"random"`` draws them in every episode."""
    measurement_matrices: ArrayLike | None = None
    """C of each sensor, equation (2), (sensors, m, n). Every C_i ℬ must have the rank q."""
    measurement_covariance: ArrayLike | None = None
    """Covariance V of the measurement noise, equation (2): one number, one per sensor, variances
    (sensors, m), or matrices (sensors, m, m)."""
    filter: Annotated[str | None, FILTERS] = None
    """Filter of the nodes. ``"random_walk"`` models the input as a random walk, ``"predict"``
    leaves it open. ``"paper"`` is the paper's, equations (8)-(20)."""
    young_factor: ArrayLike | None = None
    """ε of the paper's filter: one number, or one per sensor. The spectral radius of √(1+ε)
    (I - N C) 𝒜 must be below 1."""
    input_memory: ArrayLike | None = None
    """r of the random walk d(k) = r d(k-1) + η that a filter assumes: one number, or one per
    input."""
    input_change: ArrayLike | None = None
    """Deviation of η: one number, or one per input."""
    input_deviation: ArrayLike | None = None
    """Standard deviation of the input for a filter without any measurement."""
    hold_variance: ArrayLike | None = None
    """h of ``filter="random_walk"``: one number, or one per sensor. With it a silent node updates
    with the last measurement and the added variance h."""
    fusion: Annotated[str, _STRUCTURE.offered] = "ci"
    """Rule that joins the nodes' estimates. ``"ci"`` is equations (24) and (25). ``"sci"`` joins
    two estimates at a time. ``"sici"`` and, for two sensors, ``"ici"`` are no bounds."""
    rho_bar: ArrayLike | None = None
    """ρ̄ of the policy ``adaptive_threshold`` and of the paper's filter, equations (5)-(7): one
    number, or one per sensor."""
    rho_initial: ArrayLike | None = None
    """ρ₀ of the policy ``adaptive_threshold``, equations (5)-(7): one number, or one per sensor."""
    adaptation: ArrayLike | None = None
    """λ of the policy ``adaptive_threshold``, equations (5)-(7): one number, or one per sensor."""
    tokens: Tokens = "unlimited"
    input_weight: float = 1.0
    """Weight of an input's error in the reward, where a state's is 1."""
    intersample_error: bool = False
    """Reward the states' mean squared error over the a small steps from each sampling instant. The
    centre predicts them from its estimates of state and input; process noise is left out."""


def build_unknown(choice: UnknownInputOptions) -> Scenario:
    """Return the scenario of these options."""
    options = _with_example(choice)
    horizon = validation.horizon(options.horizon)
    plant = UnknownInputPlant.create(options)
    signal = make_signal(options, plant.inputs, horizon)
    sensors = InputSensors.create(options, plant)
    trigger = _trigger(options, sensors.count)
    open_loop = plant.open_loop(signal, horizon)
    if np.any(open_loop[plant.size :] <= 0.0):
        where = f"with input_amplitude = {validation.display(options.input_amplitude)}"
        reason = "every input must differ from zero at some step before the horizon"
        raise forbidden("input_signal", options.input_signal, reason, where)
    if np.any(open_loop <= 0.0):
        reason = "every state must have an input or noise before the horizon, or an uncertain start"
        raise forbidden("process_covariance", options.process_covariance, reason)
    weights = _weights(options, open_loop, plant.inputs)
    nature = Nature.create(options, (*plant.unmoved, "true_threshold_shift"))
    nature.check_growth(plant.true_radius, horizon)
    names = _state_names(options, plant)
    plant.warn_of_unseen_growth(sensors.measurement_matrix, names)
    truth = DrivenPlant(plant, signal, sensors, names, nature)
    scales = names, weights, plant.magnitude(signal, horizon), open_loop
    estimator = UnknownInputEstimator(*scales, _nodes(options, plant, sensors, horizon))
    # The paper's filter minimises a bound; its memory has the random walk's.
    kind, memory = options.memory_filter, None
    if kind is None and options.filter == "paper":
        kind = "random_walk"
    if kind is not None:
        validation.choice("memory_filter", kind, FILTERS)
        other = replace(options, filter=kind, hold_variance=None)
        memory = replace(estimator, nodes=_nodes(other, plant, sensors, horizon))
    return Scenario(
        options,
        truth,
        estimator,
        weights,
        policy_defaults={"adaptive_threshold": trigger},
        error=_intersample(options, weights),
        memory_estimator=memory,
        no_estimates="the centre computes each estimate from the packets of the nodes",
    )


def _intersample(options: Any, weights: Array) -> Any:
    """Return the cost of the errors of the small steps x' = A x + B d, ``None`` if not chosen."""
    if not options.intersample_error:
        return None
    if options.error != "squared":
        raise refusal("error", options.error, "'squared'", "with intersample_error=True")
    if options.reward_scale is not None:
        weights = options.reward_scale * weights
    small, inputs = np.asarray(options.transition), np.asarray(options.input_matrix)
    steps, size = [np.eye(len(small), len(weights))], len(small)
    for _ in range(1, options.sampling_period):
        steps.append(small @ steps[-1] + np.pad(inputs, ((0, 0), (size, 0))))
    return _IntersampleCost(np.array(steps), weights)


@dataclass(frozen=True, repr=False)
class _IntersampleCost:
    """Mean weighted square of the small steps' errors, from those (n, N) of state and input."""

    steps: Array
    weights: Array

    def __repr__(self) -> str:
        return "intersample_error"

    def __call__(self, error: Array, covariance: Array) -> Array:
        states = np.square((self.steps[..., None] * error).sum(2)).mean(0)
        parts = np.concatenate((states, np.square(error[len(states) :])))
        return (self.weights[:, None] * parts).sum(0)


def _with_example(options: UnknownInputOptions) -> Any:
    """Return the options with the example's numbers in place of ``None``."""
    example = EXAMPLES[validation.choice("example", options.example, EXAMPLES)]
    numbers = {name: value for name, value in example.items() if name != "signals"}
    kind = options.input_signal
    if isinstance(kind, str):
        validation.choice("input_signal", kind, get_args(Signal))
        numbers |= zip(SHAPE, example["signals"][kind], strict=True)
    if options.transition is not None or options.initial_mean is not None:
        numbers.pop("initial_half_width", None)
    missing = {name: value for name, value in numbers.items() if getattr(options, name) is None}
    return replace(options, **missing)


def _nodes(options: Any, plant: UnknownInputPlant, sensors: InputSensors, horizon: int) -> Nodes:
    kind = validation.choice("filter", options.filter, FILTERS)
    validation.positive("young_factor", options.young_factor, (sensors.count,))
    model = filters.InputModel.create(plant, options)
    joint = filters.JointGain.create(plant, sensors)
    rule = choose_rule(options.fusion, _STRUCTURE, sensors.count)
    weights = options.own_weights(plant.size + plant.inputs)
    fusion = NodeFusion(rule, plant.size, options.fusion == "ci", weights)
    hold = options.hold_variance
    if hold is not None and kind != "random_walk":
        reason = "it belongs to filter='random_walk'"
        raise forbidden("hold_variance", hold, reason, f"with filter={kind!r}")
    if kind == "paper":
        tables = filters.BoundTables.create(joint, model, options, horizon)
        return TableNodes.create(model, sensors, tables, fusion)
    if kind == "predict":
        exact = filters.ExactInputStateFilter(model, joint)
        for sensor in np.flatnonzero(~(exact.growth(horizon) <= LARGEST_ERROR)):
            raise validation.ConfigurationError(
                f"horizon = {horizon} is not allowed with filter='predict' and sensor {sensor}: "
                f"the input hides a direction whose variance grows by more than {LARGEST_ERROR:g}; "
                "use a smaller horizon, another sensor, or filter='random_walk'"
            )
        return RunNodes(model, sensors, exact, fusion)
    if hold is not None:
        hold = validation.not_negative("hold_variance", hold, (sensors.count,))
        hold = hold[:, None, None, None]
    return RunNodes(model, sensors, filters.RandomWalkInputFilter(model, sensors), fusion, hold)


def _trigger(options: Any, sensors: int) -> dict[str, tuple[float, ...]]:
    """Return the parameters of the adaptive threshold trigger, one number per sensor."""
    names = ("rho_bar", "rho_initial", "adaptation")
    each = [validation.spread(name, getattr(options, name), (sensors,)) for name in names]
    values = [tuple(own.tolist()) for own in each]
    validation.adaptive_thresholds(*values)
    return dict(zip(names, values, strict=True))


def _weights(options: UnknownInputOptions, open_loop: Array, inputs: int) -> Array:
    """w_i = g_i/(Σ g · open loop of i), g = 1 for states and ``input_weight`` for inputs."""
    chosen = options.own_weights(len(open_loop))
    if chosen is not None:
        return chosen
    share, weight = np.ones(len(open_loop)), options.input_weight
    share[len(share) - inputs :] = validation.number("input_weight", weight, at_least=0.0)
    return share / (share.sum() * open_loop)


def _state_names(options: UnknownInputOptions, plant: UnknownInputPlant) -> tuple[str, ...]:
    if options.example == "two_carts" and (plant.size, plant.inputs) == (4, 1):
        return ("position_1", "velocity_1", "position_2", "velocity_2", "force")
    return numbered_states(plant.size) + tuple(f"d{i + 1}" for i in range(plant.inputs))
