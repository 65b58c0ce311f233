"""The contracts of plant and estimator: what an instance offers."""

from types import FunctionType
from typing import Any

import numpy as np
import pytest

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.estimator import Estimator
from fusion_gym.core.knowledge import Block, Signal
from fusion_gym.core.memory import Memory
from fusion_gym.core.network import Network
from fusion_gym.core.plant import Plant
from fusion_gym.core.task import CommonOptions, Scenario, Task
from fusion_gym.envs.registration import present_id
from fusion_gym.validation import ConfigurationError

OFFERED: list[tuple[str, dict[str, Any], set[str]]] = [
    ("TobitOscillator", {}, {"adopt"}),
    ("TobitOscillator", {"filter": "tobit"}, {"adopt", "single_deliveries"}),
    ("TobitOscillator", {"filter": "adf"}, {"adopt"}),
    ("LinearFusion", {}, {"adopt", "covariance_cycle", "single_deliveries"}),
    ("MarkovJumpTracking", {}, {"covariance_cycle"}),
    ("MarkovJumpTracking", {"filter": "imm"}, set()),
    ("UnknownInput", {"filter": "predict"}, {"covariance_cycle"}),
    ("RemoteEstimation", {"channel": "independent"}, {"arrival_probability"}),
    ("RemoteEstimation", {}, set()),
]


@pytest.mark.parametrize("contract", [Plant, Estimator, Network])
def test_a_contract_has_at_most_twelve_methods(contract: type) -> None:
    kinds = (FunctionType, property)
    public = [n for n, v in vars(contract).items() if n[0] != "_" and isinstance(v, kinds)]
    assert 8 <= len(public) <= 12, public


def task_of(name: str, options: dict[str, Any]) -> Task:
    return fusion_gym.make_task(present_id(name), **options)


@pytest.mark.parametrize(("name", "options", "expected"), OFFERED)
def test_an_instance_offers_what_its_structure_allows(
    name: str, options: dict[str, Any], expected: set[str]
) -> None:
    task = task_of(name, options)
    batch, estimator = EpisodeBatch.seeded(task, 2, 0), task.estimator
    offered = {
        "draw": task.plant.draw_channels is not None,
        "adopt": type(estimator).adopt is not Estimator.adopt,
        "covariance_cycle": estimator.covariance_cycle is not None,
        "single_deliveries": estimator.single_deliveries(batch.state.estimate) is not None,
        "arrival_probability": batch.arrival_probability() is not None,
    }
    assert {name for name, has in offered.items() if has} == expected | {"draw"}


def test_what_is_not_offered_raises() -> None:
    estimator = task_of("MarkovJumpTracking", {}).estimator
    with pytest.raises(NotImplementedError, match="MarkovJumpEstimator does not offer 'adopt'"):
        estimator.adopt(None, np.zeros(1), np.zeros(1), np.zeros(1, dtype=np.bool_))


@pytest.mark.parametrize("name", ["MarkovJumpTracking", "UnknownInput"])
def test_estimates_are_refused_where_the_centre_cannot_adopt_them(name: str) -> None:
    with pytest.raises(ConfigurationError, match="packet = 'estimate'"):
        task_of(name, {"packet": "estimate", "memory": True})


@pytest.mark.parametrize("part", ["plant", "estimator"])
def test_a_task_takes_parts_of_the_base_classes_only(part: str) -> None:
    task, thing = task_of("LinearFusion", {}), object()
    parts: dict[str, Any] = {"plant": task.plant, "estimator": task.estimator, part: thing}
    with pytest.raises(ConfigurationError, match=f"{part} = "):
        Task.create(Scenario(CommonOptions(), **parts))


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
