"""Settings for all tests."""

from __future__ import annotations

import pytest
import torch

from fusion_gym.policies import registry

# Two test processes share two cores: more threads would only wait for each other.
torch.set_num_threads(1)


@pytest.fixture
def own_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test registers as a policy is gone after it."""
    monkeypatch.setattr(registry, "_ROWS", dict(registry._ROWS))
