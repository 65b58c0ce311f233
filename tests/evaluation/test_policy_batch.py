"""Policies beside each other in one batch."""

from dataclasses import fields
from typing import Any

import numpy as np
import pytest

import fusion_gym
from fusion_gym.evaluation.episodes import run_episodes, run_several
from fusion_gym.policies.registry import make_policy

ENV = "fusion_gym/TobitOscillator-v1"
VALUE, OWN = "value_of_information", "estimate_difference:own=true"


@pytest.mark.parametrize(
    ("options", "policies"),
    [
        ({}, ["innovation_threshold:threshold=0.5", "stochastic_event:weight=2", "always"]),
        ({"memory": True}, [f"{VALUE}:threshold=0.01", VALUE]),
        ({"memory": True}, [OWN, f"{OWN},whitened=true"]),
    ],
)
def test_policies_beside_each_other_do_what_each_does_alone(
    options: dict[str, Any], policies: list[str]
) -> None:
    task = fusion_gym.make_task(ENV, filter="tobit", horizon=15, **options)
    built = [make_policy(name, task) for name in policies]
    several = run_several(task, [*built, make_policy("never", task)], 7, 3)
    for name, whole in zip(policies, several, strict=False):
        single = run_episodes(task, make_policy(name, task), 7, 3)
        for field in fields(single):
            np.testing.assert_array_equal(getattr(whole, field.name), getattr(single, field.name))
