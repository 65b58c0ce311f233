"""Earlier values are accepted with a warning, those of files without one."""

import warnings
from types import SimpleNamespace
from typing import Any

import pytest

import fusion_gym
from fusion_gym.core.memory import Memory
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.system import Block, Signal, covers
from fusion_gym.deprecation import VALUES, replace_value
from fusion_gym.policies.base import owner_of


def test_earlier_values_mean_the_present_ones() -> None:
    task: Any = fusion_gym.make_task("fusion_gym/TobitOscillator-v1", memory=True)
    old: Any = "coordinator"
    with pytest.warns(DeprecationWarning, match="knower = 'coordinator_memory'"):
        assert covers("coordinator_memory", "scheduler")  # type: ignore[arg-type]
    with pytest.warns(DeprecationWarning, match="remember = 'coordinator' is deprecated"):
        assert owner_of(SimpleNamespace(remember=old)) == "scheduler"  # type: ignore[arg-type]
    with pytest.warns(DeprecationWarning, match="owner = 'coordinator' is deprecated"):
        assert Memory(task, old).owner == "scheduler"
    with pytest.warns(DeprecationWarning, match="owner = 'coordinator' is deprecated"):
        assert ObservationLayout(task, old).names == ObservationLayout(task).names
    with pytest.warns(DeprecationWarning, match="node = 'told' is deprecated"):
        assert Block("x", "x", lambda state: state, node="told").node == "broadcast"  # type: ignore[arg-type]
    with pytest.warns(DeprecationWarning, match="knowledge = 'coordinator' is deprecated"):
        assert Signal("x", old, "(N)", "x").knowledge == "scheduler"


def test_values_of_files_are_read_without_a_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert [replace_value(v) for v in VALUES] == list(VALUES.values())
        assert replace_value("own") == "own"
