"""Settings for all tests."""

import os
import zlib
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
def small_studies(monkeypatch: pytest.MonkeyPatch) -> None:
    """Studies of a log end within seconds."""
    from fusion_gym.recordings import field_study

    few = {"_TRIALS": 2, "_EPISODES": 4, "_CLOSE": 0.3, "FACTORS": (0.5, 1.0, 2.0), "RESAMPLES": 20}
    for name, value in few.items():
        monkeypatch.setattr(field_study, name, value)


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


def aspects(item: Any) -> set[str]:
    """The values that parameters have in a test, and what a case of laws is a case of."""
    test, values = item.nodeid.partition("[")[0], item.callspec.params.values()
    result = {f"{test} {place} {value}" for place, value in enumerate(item.callspec._idlist)}
    for case in (value for value in values if hasattr(value, "aspects")):
        result = {aspect for aspect in result if str(case) not in aspect}
        result |= {f"{test} {part}" if each else part for part, each in case.aspects.items()}
    return result


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark as slow what a product of parameters repeats: quick tests have each value once."""
    covered: set[str] = set()
    drawn = [i for i in items if hasattr(i, "callspec") and not i.get_closest_marker("slow")]
    for item in sorted(drawn, key=lambda item: zlib.crc32(item.nodeid.encode())):
        if aspects(item) <= covered:
            item.add_marker(pytest.mark.slow)
        covered |= aspects(item)
