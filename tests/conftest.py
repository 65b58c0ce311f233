"""Settings for all tests."""

import os
from collections.abc import Iterator
from typing import Any

import pytest

# Two test processes share two cores: more threads would only wait for each other. NumPy and torch
# read this when they are imported, which is later, and so do the commands that tests start.
os.environ["OMP_NUM_THREADS"] = "1"
# XLA's optimization takes longer than the steps of a test.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")


@pytest.fixture
def own_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test registers as a policy is gone after it."""
    from fusion_gym.policies import registry

    monkeypatch.setattr(registry, "_ROWS", dict(registry._ROWS))


@pytest.fixture
def unsearched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make policies without the search for their schedule, which takes minutes."""
    import numpy as np

    from fusion_gym.policies.periodic_optimum import Schedule

    def optimum(task: Any, packets: int, period: int, *_: Any) -> Schedule:
        return Schedule(np.ones((period, task.sensors), dtype=np.bool_), float(packets))

    monkeypatch.setattr("fusion_gym.policies.periodic_optimum.optimum", optimum)


@pytest.fixture
def registries() -> Iterator[None]:
    """What a test registers, environments too, is gone after it."""
    import gymnasium as gym

    from fusion_gym.envs.registration import ENVIRONMENTS
    from fusion_gym.policies import registry

    tables: tuple[dict[str, Any], ...] = (ENVIRONMENTS, gym.registry, registry._ROWS)
    stored = [(table, dict(table)) for table in tables]
    yield
    for table, before in stored:
        table.clear()
        table.update(before)
