"""Two carts under an unknown force, or the paper's example: numbers, options, environment.

Source: unknown_input, Y. Sun, M. Fu, J. Mao and G. Wei, "Recursive filtering of multi-rate
cyber-physical systems with unknown inputs under adaptive event-triggered mechanisms", Frontiers of
Information Technology & Electronic Engineering 24, 2023.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.options import CommonOptions, Nature, Scenario
from fusion_gym.fusion.table import Structure, choose_rule
from fusion_gym.systems.unknown_input.bound_filter import BoundTables
from fusion_gym.systems.unknown_input.examples import EXAMPLES
from fusion_gym.systems.unknown_input.filters import ExactInputStateFilter, RandomWalkInputFilter
from fusion_gym.systems.unknown_input.fusion import NodeFusion
from fusion_gym.systems.unknown_input.input_state import InputModel, JointGain
from fusion_gym.systems.unknown_input.nodes import Nodes, RunNodes, TableNodes
from fusion_gym.systems.unknown_input.plant import UnknownInputPlant
from fusion_gym.systems.unknown_input.sensors import InputSensors
from fusion_gym.systems.unknown_input.signals import (
    GivenInput,
    InputSignal,
    MeanRevertingWalk,
    Sinusoids,
    Steps,
)
from fusion_gym.systems.unknown_input.system import UnknownInputSystem
from fusion_gym.validation import ConfigurationError

_STRUCTURE = Structure(common="all contain the same process noise", holds=("tracked weights",))
SIGNALS = ("sinusoids", "steps", "random_walk")


class Filter(NamedTuple):
    """A filter's class, whose docstring declares it, and the nodes that it makes."""

    kind: type
    make: Callable[[UnknownInputOptions, _Parts], Nodes]


FILTERS = {
    "random_walk": Filter(RandomWalkInputFilter, lambda chosen, parts: _random_walk(chosen, parts)),
    "predict": Filter(ExactInputStateFilter, lambda chosen, parts: _predict(parts)),
    "paper": Filter(BoundTables, lambda chosen, parts: _paper(chosen, parts)),
}


@dataclass(frozen=True)
class UnknownInputOptions(CommonOptions):
    """Two carts, tied by springs, under a force that nobody knows, seen in part by three sensors.

    The state is the positions and velocities of two carts; the force on the first is unknown to
    filters and policies and drawn anew in every episode. The carts are sampled every second small
    step. Each node estimates the state and, one sampling instant late, the force, from what its
    sensor transmitted; the centre fuses the nodes by covariance intersection. Nothing is fed back.
    ``example="paper"`` gives the paper's system instead: two states, two inputs, two sensors, and
    its own filter. The inputs stand behind the states wherever states are listed, and the reward
    weighs their errors by ``input_weight``.

    Starting state: x₀ ~ N(0, 0.1 I), or, in the paper's example, uniform on [0.16, 0.18]. The
    measurement at time 0 has been delivered.

    ``None`` stands for the number of the chosen ``example``, which
    :mod:`fusion_gym.systems.unknown_input.examples` lists; a number that is given goes before it.
    """

    filters: ClassVar[Mapping[str, type]] = {name: row.kind for name, row in FILTERS.items()}
    structure: ClassVar[Structure | None] = _STRUCTURE
    example: str = "two_carts"
    # Plant, equation (1)
    transition: ArrayLike | None = None
    input_matrix: ArrayLike | None = None
    process_covariance: ArrayLike | None = None
    sampling_period: int = 2
    initial_mean: ArrayLike | None = None
    initial_covariance: ArrayLike | None = None
    initial_half_width: ArrayLike | None = None
    # The unknown input
    input_signal: str | ArrayLike = "sinusoids"
    input_amplitude: ArrayLike | None = None
    input_period: ArrayLike | None = None
    input_phase: ArrayLike | str | None = None
    # Sensors, equation (2)
    measurement_matrices: ArrayLike | None = None
    measurement_covariance: ArrayLike | None = None
    # Nodes and fusion, equations (8)-(25)
    filter: str | None = None
    young_factor: ArrayLike | None = None
    input_memory: ArrayLike | None = None
    input_change: ArrayLike | None = None
    input_deviation: ArrayLike | None = None
    hold_variance: ArrayLike | None = None
    fusion: str = "ci"
    # Adaptive threshold trigger, equations (5)-(7)
    rho_bar: ArrayLike | None = None
    rho_initial: ArrayLike | None = None
    adaptation: ArrayLike | None = None
    # Network, episode and reward
    tokens: str = "unlimited"
    input_weight: float = 1.0


def build(chosen: UnknownInputOptions) -> Scenario:
    """The scenario of these options, checked before anything runs.

    Raises:
        ConfigurationError: a value that is not allowed.
    """
    chosen = _with_example(chosen)
    horizon = validation.horizon(chosen.horizon)
    plant = _plant(chosen)
    signal = _signal(chosen, plant.inputs, horizon)
    sensors = InputSensors.create(
        _given(chosen.measurement_matrices), _given(chosen.measurement_covariance), plant
    )
    trigger = _trigger(chosen, sensors.count)
    open_loop = plant.open_loop(signal, horizon)
    if np.any(open_loop[plant.size :] <= 0.0):
        raise ConfigurationError(
            f"input_signal = {validation.shown(chosen.input_signal)} is not allowed with "
            f"input_amplitude = {validation.shown(chosen.input_amplitude)}: every input must "
            "differ from zero somewhere before the horizon, or there is nothing to estimate"
        )
    if np.any(open_loop <= 0.0):
        raise ConfigurationError(
            f"process_covariance = {validation.shown(chosen.process_covariance)} is not "
            "allowed: every state must be moved by the input or by noise before the horizon, or "
            "be uncertain at the start"
        )
    weights = _weights(chosen, open_loop, plant.inputs)
    nature = Nature.create(chosen, (*plant.unmoved, "true_threshold_shift"))
    nature.check_growth(plant.true_radius, horizon)
    system = UnknownInputSystem(
        plant=plant,
        signal=signal,
        nodes=_nodes(chosen, plant, sensors, horizon),
        state_names=_state_names(chosen, plant),
        state_weights=weights,
        magnitude=plant.magnitude(signal, horizon),
        reference=open_loop,
        nature=nature,
    )
    return Scenario(
        chosen,
        system,
        weights,
        {"adaptive_threshold": trigger},
        memory_system=_remembering(chosen, system, sensors, horizon),
        no_estimates="the centre makes its estimate anew from what each node sent",
    )


def _remembering(
    chosen: UnknownInputOptions, system: UnknownInputSystem, sensors: InputSensors, horizon: int
) -> UnknownInputSystem | None:
    """The system with the filter of ``memory_filter``; ``None`` is its own.

    With the paper's filter, which minimises a bound, the random walk's.
    """
    kind = chosen.memory_filter
    if kind is None:
        if chosen.filter != "paper":
            return None
        kind = "random_walk"
    validation.choice("memory_filter", kind, FILTERS)
    other = replace(chosen, filter=kind, hold_variance=None)
    return replace(system, nodes=_nodes(other, system.plant, sensors, horizon))


def _with_example(chosen: UnknownInputOptions) -> UnknownInputOptions:
    """The options with the example's numbers where none were given."""
    example = EXAMPLES[validation.choice("example", chosen.example, EXAMPLES)]
    numbers = {name: value for name, value in example.items() if name != "signals"}
    kind = chosen.input_signal
    if isinstance(kind, str):
        validation.choice("input_signal", kind, SIGNALS)
        shape = zip(
            ("input_amplitude", "input_period", "input_phase"),
            example["signals"][kind],
            strict=True,
        )
        numbers |= dict(shape)
    if chosen.transition is not None or chosen.initial_mean is not None:
        numbers.pop("initial_half_width", None)
    missing = {
        field.name: numbers[field.name]
        for field in fields(chosen)
        if field.name in numbers and getattr(chosen, field.name) is None
    }
    return replace(chosen, **missing)


def _plant(chosen: UnknownInputOptions) -> UnknownInputPlant:
    half = chosen.initial_half_width
    return UnknownInputPlant.create(
        _given(chosen.transition),
        _given(chosen.input_matrix),
        _given(chosen.process_covariance),
        chosen.sampling_period,
        _given(chosen.initial_mean),
        _given(chosen.initial_covariance),
        half,
    )


def _given(value: ArrayLike | None) -> ArrayLike:
    """A number that the example has filled in."""
    assert value is not None, "the examples give every number"
    return value


def _signal(chosen: UnknownInputOptions, inputs: int, horizon: int) -> InputSignal:
    kind = chosen.input_signal
    shape = {
        name: getattr(chosen, name) for name in ("input_amplitude", "input_period", "input_phase")
    }
    if not isinstance(kind, str):
        for name, value in shape.items():
            if value is not None:
                raise ConfigurationError(
                    f"{name} = {validation.shown(value)} is not allowed with an array as "
                    "input_signal: it must be None"
                )
        return GivenInput.create(inputs, kind, horizon)
    amplitude, period, phase = shape.values()
    if kind == "sinusoids":
        return Sinusoids.create(inputs, amplitude, period, phase)
    if not (isinstance(phase, str) and phase == "random"):
        raise ConfigurationError(
            f"input_phase = {validation.shown(phase)} is not allowed with "
            f"input_signal={kind!r}: phases belong to 'sinusoids'"
        )
    if kind == "steps":
        return Steps.create(inputs, amplitude, period)
    return MeanRevertingWalk.create(inputs, amplitude, period)


def _nodes(
    chosen: UnknownInputOptions, plant: UnknownInputPlant, sensors: InputSensors, horizon: int
) -> Nodes:
    kind = validation.choice("filter", chosen.filter, FILTERS)
    factor = validation.positive("young_factor", _given(chosen.young_factor), (sensors.count,))
    model = InputModel.create(
        plant,
        _given(chosen.input_memory),
        _given(chosen.input_change),
        _given(chosen.input_deviation),
    )
    joint = JointGain.create(plant, sensors)
    rule = choose_rule(chosen.fusion, _STRUCTURE, sensors.count)
    fusion = NodeFusion(rule, plant.size, tracked=chosen.fusion == "ci")
    if chosen.hold_variance is not None and kind != "random_walk":
        raise ConfigurationError(
            f"hold_variance = {validation.shown(chosen.hold_variance)} is not allowed with "
            f"filter={kind!r}: it belongs to filter='random_walk'"
        )
    return FILTERS[kind].make(chosen, _Parts(model, sensors, joint, fusion, factor, horizon))


class _Parts(NamedTuple):
    """What nodes are made of; ``factor`` (sensors,) is that of Young's inequality."""

    model: InputModel
    sensors: InputSensors
    joint: JointGain
    fusion: NodeFusion
    factor: Array
    horizon: int


def _random_walk(chosen: UnknownInputOptions, parts: _Parts) -> Nodes:
    hold = None
    if chosen.hold_variance is not None:
        shape = (parts.sensors.count,)
        hold = validation.not_negative("hold_variance", chosen.hold_variance, shape)
        hold = hold[:, None, None, None]
    node = RandomWalkInputFilter(parts.model, parts.sensors)
    return RunNodes(parts.model, parts.sensors, node, parts.fusion, hold)


def _predict(parts: _Parts) -> Nodes:
    node = ExactInputStateFilter(parts.model, parts.joint)
    return RunNodes(parts.model, parts.sensors, node, parts.fusion)


def _paper(chosen: UnknownInputOptions, parts: _Parts) -> Nodes:
    bound = _given(chosen.rho_bar)
    tables = BoundTables.create(parts.joint, parts.model, bound, parts.factor, parts.horizon)
    return TableNodes.create(parts.model, parts.sensors, tables, parts.fusion)


def _trigger(chosen: UnknownInputOptions, sensors: int) -> dict[str, tuple[float, ...]]:
    """Parameters of the adaptive threshold trigger, one number a sensor."""
    names = ("rho_bar", "rho_initial", "adaptation")
    spread = {
        name: tuple(validation.spread(name, _given(getattr(chosen, name)), (sensors,)).tolist())
        for name in names
    }
    validation.adaptive_thresholds(*spread.values())
    return spread


def _weights(chosen: UnknownInputOptions, open_loop: Array, inputs: int) -> Array:
    """w_i = g_i/(Σ g · open loop of i), g = 1 for states and ``input_weight`` for inputs."""
    if chosen.state_weights is not None:
        return validation.not_negative("state_weights", chosen.state_weights, open_loop.shape)
    share = np.ones(len(open_loop))
    share[len(share) - inputs :] = validation.number(
        "input_weight", chosen.input_weight, at_least=0.0
    )
    weights: Array = share / (share.sum() * open_loop)
    return weights


def _state_names(chosen: UnknownInputOptions, plant: UnknownInputPlant) -> tuple[str, ...]:
    if chosen.example == "two_carts" and (plant.size, plant.inputs) == (4, 1):
        return ("position_1", "velocity_1", "position_2", "velocity_2", "force")
    states = tuple(f"x{i + 1}" for i in range(plant.size))
    return states + tuple(f"d{i + 1}" for i in range(plant.inputs))
