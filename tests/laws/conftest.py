"""The user's environment is registered while this folder's tests run, and no longer."""

from collections.abc import Iterator

import gymnasium
import own_system
import pytest

import fusion_gym
from fusion_gym.envs.registration import ENVIRONMENTS
from fusion_gym.errors import ConfigurationError


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Skip a law that branches runs where the plant's states cannot branch."""
    try:
        yield
    except ConfigurationError as error:
        if "states cannot branch" in str(error):
            pytest.skip(str(error))
        raise


@pytest.fixture(autouse=True, scope="module")
def users_environment() -> Iterator[None]:
    """``mine/RandomWalk-v0`` through the public door."""
    fusion_gym.register(own_system.OWN_ID, own_system.build)
    yield
    del ENVIRONMENTS[own_system.OWN_ID], gymnasium.registry[own_system.OWN_ID]
