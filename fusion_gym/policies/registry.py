"""Policies by name: ``NAME`` or ``NAME:key=value,key=value``."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
from typing import Any

from fusion_gym import validation
from fusion_gym.policies.base import Policy, Trigger
from fusion_gym.policies.rules.adaptive_innovation import AdaptiveInnovation
from fusion_gym.policies.rules.adaptive_threshold import AdaptiveThreshold
from fusion_gym.policies.rules.centre_variance import CentreVariance
from fusion_gym.policies.rules.constant import Always, Never
from fusion_gym.policies.rules.dynamic_event import DynamicEvent
from fusion_gym.policies.rules.information_gain import InformationGain
from fusion_gym.policies.rules.innovation_threshold import InnovationThreshold
from fusion_gym.policies.rules.local_variance import LocalVariance
from fusion_gym.policies.rules.paced import Paced
from fusion_gym.policies.rules.periodic import Periodic, RoundRobin
from fusion_gym.policies.rules.random import Random
from fusion_gym.policies.rules.send_on_delta import SendOnDelta
from fusion_gym.policies.rules.stochastic_event import StochasticEvent
from fusion_gym.policies.rules.variance_threshold import VarianceThreshold
from fusion_gym.validation import ConfigurationError

TRIGGERS: dict[str, type[Trigger]] = {
    "adaptive_innovation": AdaptiveInnovation,
    "adaptive_threshold": AdaptiveThreshold,
    "always": Always,
    "centre_variance": CentreVariance,
    "dynamic_event": DynamicEvent,
    "information_gain": InformationGain,
    "innovation_threshold": InnovationThreshold,
    "local_variance": LocalVariance,
    "never": Never,
    "paced": Paced,
    "periodic": Periodic,
    "random": Random,
    "round_robin": RoundRobin,
    "send_on_delta": SendOnDelta,
    "stochastic_event": StochasticEvent,
    "variance_threshold": VarianceThreshold,
}


def parse_value(text: str) -> Any:
    """A number, true, false, none, inf, or a list as Python writes it; all else stays text.

    Values for several sensors may also be written with slashes: ``0.1/0.2/0.3``.
    """
    plain = {"true": True, "false": False, "none": None, "null": None}
    if text.strip().lower() in plain:
        return plain[text.strip().lower()]
    if "/" in text:
        parts = tuple(parse_value(part) for part in text.split("/"))
        if all(isinstance(part, (int, float)) for part in parts):
            return parts
    for read in (ast.literal_eval, float):
        with contextlib.suppress(ValueError, SyntaxError):
            return read(text)
    return text


def parse_settings(kind: str, entries: list[str]) -> dict[str, Any]:
    """``["key=value", …]`` as a dictionary, with :func:`parse_value`.

    Raises:
        ConfigurationError: an entry without ``=``, or a key given twice.
    """
    result: dict[str, Any] = {}
    for entry in entries:
        key, equals, value = entry.partition("=")
        key = key.strip()
        if not equals or not key:
            raise ConfigurationError(f"{kind} {entry!r} is not allowed: write key=value")
        if key in result:
            raise ConfigurationError(f"{kind} {key!r} is given twice")
        result[key] = parse_value(value)
    return result


def make_trigger(spec: str, defaults: dict[str, dict[str, Any]] | None = None) -> Policy:
    """The analytic policy that ``NAME`` or ``NAME:key=value,key=value`` stands for.

    ``defaults`` are a scenario's own parameters by policy name
    (:attr:`fusion_gym.envs.Task.policy_defaults`); what the text says goes before them.

    Raises:
        ConfigurationError: an unknown policy or parameter, or a value that is not allowed.
    """
    name, _, text = spec.partition(":")
    if name == "model":
        raise ConfigurationError(
            f"policy {spec!r} is no analytic trigger: use fusion_gym.policies.make.make_policy"
        )
    validation.keys("policy", [name], [*TRIGGERS, "model"])
    kind = TRIGGERS[name]
    parameters = parse_settings(f"parameter of policy {name!r}", text.split(",") if text else [])
    known = [field.name for field in dataclasses.fields(kind)]  # type: ignore[arg-type]
    validation.keys(f"parameter of policy {name!r}", parameters, known)
    try:
        return kind(**((defaults or {}).get(name, {}) | parameters))
    except ConfigurationError as error:
        raise ConfigurationError(f"policy {spec!r}: {error}") from None
