"""The contract of systems: what a class may define, and what an instance offers."""

from typing import Any

import numpy as np
import pytest

import fusion_gym
from fusion_gym.core.memory import Memory
from fusion_gym.core.options import CommonOptions, Scenario
from fusion_gym.core.system import CAPABILITIES, Block, Signal, System
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import present_id
from fusion_gym.systems.nonlinear import NonlinearSystem
from fusion_gym.validation import ConfigurationError

IMAGINED = {"imagine", "imagination_channels"}
OFFERED: list[tuple[str, dict[str, Any], set[str]]] = [
    ("TobitOscillator", {}, {"adopt"}),
    ("TobitOscillator", {"filter": "tobit"}, {"adopt", "single_deliveries"}),
    ("TobitOscillator", {"filter": "adf"}, {"adopt"}),
    ("LinearFusion", {}, {"adopt", "covariance_cycle", "single_deliveries"}),
    ("MarkovJumpTracking", {}, {"covariance_cycle"}),
    ("MarkovJumpTracking", {"filter": "imm"}, set()),
    ("UnknownInput", {"filter": "predict"}, {"covariance_cycle"}),
    ("RemoteEstimation", {"channel": "independent"}, {"arriving", "arrival_probability"}),
    ("RemoteEstimation", {}, {"arriving"}),
]


def system_of(name: str, options: dict[str, Any]) -> System[Any]:
    return fusion_gym.make_task(present_id(name), **options).system


@pytest.mark.parametrize(("name", "options", "expected"), OFFERED)
def test_an_instance_offers_what_its_structure_allows(
    name: str, options: dict[str, Any], expected: set[str]
) -> None:
    system = system_of(name, options)
    offered = {capability for capability in CAPABILITIES if system.offers(capability)}
    assert offered == expected | IMAGINED


def test_what_is_not_offered_raises() -> None:
    system = system_of("MarkovJumpTracking", {})
    with pytest.raises(NotImplementedError, match="MarkovJumpSystem does not offer 'adopt'"):
        system.adopt(None, np.zeros(1), np.zeros(1), np.zeros(1, dtype=np.bool_))
    with pytest.raises(ValueError, match="capability = 'fused_alon'"):
        system.offers("fused_alon")


def test_a_public_method_that_nothing_declares_is_refused_when_the_class_is_made() -> None:
    methods = {"fused_alon": lambda self, state: None}
    with pytest.raises(TypeError, match="fused_alon is not allowed"):
        type("Misspelt", (NonlinearSystem,), methods)
    type("Listed", (NonlinearSystem,), methods | {"extensions": ("fused_alon",)})


@pytest.mark.parametrize("name", ["MarkovJumpTracking", "UnknownInput"])
def test_estimates_are_refused_where_the_centre_cannot_adopt_them(name: str) -> None:
    with pytest.raises(fusion_gym.ConfigurationError, match="packet = 'estimate'"):
        system_of(name, {"packet": "estimate", "memory": True})


def test_a_task_takes_systems_of_the_base_class_only() -> None:
    system: Any = object()
    with pytest.raises(fusion_gym.ConfigurationError, match="system = "):
        Task.create(Scenario(CommonOptions(), system))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Signal("x", "coordinator", "(N)", "x"), "knowledge = 'coordinator' is not"),  # type: ignore[arg-type]
        (lambda: Block("x", "x", np.copy, knowledge="coordinator"), "knowledge = 'coordinator'"),  # type: ignore[arg-type]
        (lambda: Block("x", "x", np.copy, node="told"), "node = 'told' is not allowed: it must be"),  # type: ignore[arg-type]
        (
            lambda: Memory(fusion_gym.make_task("fusion_gym/LinearFusion-v2"), "coordinator"),
            "owner = 'coordinator' is not allowed",
        ),  # type: ignore[arg-type]
    ],
)
def test_an_unknown_class_or_owner_is_refused(make: Any, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        make()
