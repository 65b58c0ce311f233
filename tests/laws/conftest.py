"""The users' environments are registered while this folder's tests run, and no longer."""

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
def users_environments() -> Iterator[None]:
    """They come through the public door."""
    for env_id, build in own_system.OWN_IDS.items():
        fusion_gym.register(env_id, build)
    yield
    for env_id in own_system.OWN_IDS:
        del ENVIRONMENTS[env_id], gymnasium.registry[env_id]
