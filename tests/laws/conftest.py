"""The user's environment is registered while this folder's tests run; its quick tests are drawn."""

import zlib
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import own_system
import pytest
from cases import CASES, COMMON, NETWORK_CASES, Case

import fusion_gym
from fusion_gym.envs.registration import ENVIRONMENTS


@pytest.fixture(autouse=True, scope="module")
def users_environment() -> Iterator[None]:
    """``mine/RandomWalk-v0`` through the public door."""
    fusion_gym.register(own_system.OWN_ID, own_system.build)
    yield
    del ENVIRONMENTS[own_system.OWN_ID], gymnasium.registry[own_system.OWN_ID]


def aspects(item: pytest.Function) -> set[str]:
    """What a test is one of: a value of a parameter of its law, a case of all laws."""
    law, result = item.originalname, set()
    for name, value in item.callspec.params.items():
        if isinstance(value, Case):
            result.add(f"{law} {value.env_id}")
            result |= {str(value)} if value in (*CASES, *NETWORK_CASES) else set()
            result |= {f"{law} {value.options}"} if value.options in COMMON else set()
        else:
            result.add(f"{law} {name} {value}")
    return result


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark as slow what adds no aspect: of a product of parameters, a sample is quick."""
    laws = [i for i in items if i.path.parent == Path(__file__).parent and hasattr(i, "callspec")]
    covered: set[str] = set()
    for item in sorted(laws, key=lambda item: zlib.crc32(item.nodeid.encode())):
        if item.get_closest_marker("slow") is None:
            if aspects(item) <= covered:
                item.add_marker(pytest.mark.slow)
            covered |= aspects(item)
