"""Settings for all tests."""

import os
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import pytest
import torch

from fusion_gym.envs.registration import ENVIRONMENTS
from fusion_gym.policies import registry

# Two test processes share two cores: more threads would only wait for each other.
torch.set_num_threads(1)
os.environ["OMP_NUM_THREADS"] = "1"  # of the commands that tests start


@pytest.fixture
def own_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test registers as a policy is gone after it."""
    monkeypatch.setattr(registry, "_ROWS", dict(registry._ROWS))


@pytest.fixture
def registries() -> Iterator[None]:
    """What a test registers, environments too, is gone after it."""
    tables: tuple[dict[str, Any], ...] = (ENVIRONMENTS, gym.registry, registry._ROWS)
    stored = [(table, dict(table)) for table in tables]
    yield
    for table, before in stored:
        table.clear()
        table.update(before)
