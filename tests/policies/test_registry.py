"""The registry: policies of one's own, and what is wrong with a name, a maker or a parameter."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from refusals import refused

import fusion_gym
from fusion_gym.core.knowledge import Signals
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Policy, Rule
from fusion_gym.policies.registry import (
    make_policy,
    policy_maker,
    policy_names,
    policy_parameters,
    register_policy,
)
from fusion_gym.validation import ConfigurationError

ENV = "fusion_gym/TobitOscillator-v1"


@pytest.fixture(scope="module")
def task() -> Task:
    return fusion_gym.make_task(ENV, filter="tobit", random_start=True)


class Steady(Rule):
    """Requests always or never, and declares whatever it likes."""

    def __init__(self, declared: Any, number: float = 1.0) -> None:
        self.declared, self.number = declared, number

    @property
    def knowledge(self) -> Any:
        return self.declared

    def __call__(self, signals: Signals) -> Any:
        shape = (len(signals["token_cost"]), len(signals["tokens"]))
        return np.broadcast_to(self.number, shape) > 0.0


@dataclasses.dataclass
class Mine(Rule):
    threshold: float = 0.5
    knowledge = "own"

    def __call__(self, signals: Signals) -> Any:
        return signals["measurement"][:, 0] > self.threshold


@pytest.mark.usefixtures("own_table")
def test_a_policy_of_ones_own_is_in_every_list(task: Task) -> None:
    fusion_gym.register_policy("mine", Mine)
    assert "mine" in fusion_gym.policy_names()
    assert fusion_gym.policy_names("rule") == sorted([*policy_names("rule")])
    policy: Any = fusion_gym.evaluation.make_policy("mine:threshold=0.2", task)
    assert policy.threshold == 0.2
    results = fusion_gym.evaluation.run_episodes(task, policy, 4, 0)
    assert 0.0 < results.requests.mean() < 1.0
    names = "maximum_age, mine, model"
    refused(lambda: make_policy("mien", task), "policy 'mien': did you mean 'mine'?", names)
    unknown = "unknown parameter of policy 'mine' 'treshold': "
    refused(lambda: make_policy("mine:treshold=1", task), unknown, "'threshold'")
    centre = fusion_gym.make_task(ENV, filter="tobit", information="centre")
    refused(lambda: make_policy("mine", centre), "policy 'mine': signal 'measurement'")


@pytest.mark.usefixtures("own_table")
def test_a_maker_is_given_the_task_and_says_what_is_missing(task: Task) -> None:
    value = task

    def make(task: Task, gain: float) -> Policy:
        assert task is value
        return Steady("clock", gain)

    register_policy("gains", make, "reference")
    assert "gains" in policy_names("reference")
    policy: Any = make_policy("gains:gain=2", task)
    assert policy.number == 2
    refused(lambda: make_policy("gains", task), "policy 'gains' needs a parameter 'gain'")
    register_policy("shapeless", lambda: Steady("clock"))
    register_policy("undeclared", lambda: Steady(None))
    refused(lambda: make_policy("undeclared", task), "knowledge = None: it must be ", "'clock'")

    class Flat(Mine):
        def __call__(self, signals: Signals) -> Any:
            return signals["measurement"][:, 0, 0] > 0.0

    register_policy("flat", Flat)
    refused(lambda: make_policy("flat", task), "an array of bool (3,): ", "(3, 1)")


@pytest.mark.parametrize("value", ["high", float("nan"), {}, (1.0, float("inf")), -1.0])
@pytest.mark.parametrize("name", policy_names("rule"))
def test_a_parameter_that_a_rule_cannot_have_is_refused_by_name(name: str, value: Any) -> None:
    for parameter in policy_parameters(name):
        if (parameter, value) != ("m", -1.0):
            with pytest.raises(ConfigurationError, match=f"^{parameter} = "):
                policy_maker(name)(**{parameter: value})


@pytest.mark.usefixtures("own_table")
@pytest.mark.parametrize(
    ("name", "maker", "message"),
    [
        ("always", Mine, "a policy has this name"),
        ("my-rule", Mine, "name = 'my-rule'"),
        ("mine", "module:Mine", "'module:Mine' .* must be a callable"),
        ("mine", lambda *values: Mine(), "named parameters"),
    ],
)
def test_what_cannot_be_registered(name: Any, maker: Any, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        register_policy(name, maker)
    assert "mine" not in policy_names()
