"""The communication model: content of packets, broadcasts, memory."""

from collections.abc import Sequence
from typing import Any, NamedTuple, get_args

from fusion_gym import validation
from fusion_gym.core.estimator import Estimator
from fusion_gym.core.options import Feature, Scenario

FEATURES: tuple[str, ...] = get_args(Feature)


class Communication(NamedTuple):
    """The checked communication model of a scenario.

    Attributes:
        broadcast: ``"none"``, ``"estimate"`` or ``"packets"``.
        memory_estimator: Estimator of the memory, or ``None`` without memory.
        features: Observation entries of the memory, ``"difference"`` and ``"value"``.
    """

    broadcast: str
    memory_estimator: Estimator[Any] | None
    features: tuple[str, ...]


def communication(scenario: Scenario, delayed: bool = False) -> Communication:
    """Return the checked communication model of a scenario, with or without delays."""
    options = scenario.options
    has_memory, memory_estimator = options.memory, scenario.memory_estimator
    if memory_estimator is None and not scenario.nodes_have_memory:
        memory_estimator = scenario.estimator
    if has_memory and options.information == "centre":
        allowed = "False, because the centre stores only deliveries"
        raise validation.refusal("memory", True, allowed, "with information='centre'")
    if options.memory_filter is not None and not has_memory:
        raise validation.refusal("memory_filter", options.memory_filter, "None unless memory=True")
    features = _features(options.belief_features, has_memory, delayed)
    if features and options.information == "centre":
        allowed = "None or empty with information='centre'"
        raise validation.refusal("belief_features", options.belief_features, allowed)
    if options.memory_filter is not None and scenario.memory_estimator is None:
        allowed = "None here, because this system has one filter"
        raise validation.refusal("memory_filter", options.memory_filter, allowed)
    if options.packet == "estimate":
        _check_estimates(scenario, has_memory)
    return Communication(_broadcast(scenario), memory_estimator if has_memory else None, features)


def _check_estimates(scenario: Scenario, has_memory: bool) -> None:
    reason = scenario.no_estimates
    if not has_memory:
        reason = "an estimate needs memory=True"
    elif type(scenario.estimator).adopt is Estimator.adopt:
        reason = reason or "this system's centre cannot continue from a delivered estimate"
    if reason is not None:
        raise validation.refusal("packet", "estimate", f"'measurement', because {reason}", "here")


def _broadcast(scenario: Scenario) -> str:
    value = scenario.options.broadcast
    if value is None:
        return "estimate" if scenario.feedback else "none"
    if value == "none" and scenario.feedback:
        allowed = "'estimate' or 'packets', because the nodes receive the centre's estimate"
        raise validation.refusal("broadcast", "none", allowed, "here")
    return value


def _features(value: Any, has_memory: bool, delayed: bool) -> tuple[str, ...]:
    """Return the observation entries of the memory, by default all with memory."""
    if value is None:
        usual = ("difference",) if delayed else FEATURES
        return usual if has_memory else ()
    if value is True:
        return FEATURES
    values = (value,) if isinstance(value, str) else value
    if not isinstance(values, Sequence):
        raise validation.refusal("belief_features", value, f"a list of some of {FEATURES}, or true")
    for name in values:
        validation.choice("belief_features", name, FEATURES)
    return tuple(name for name in FEATURES if name in values)
