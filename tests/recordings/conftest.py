"""Logs that several tests read."""

import pytest

from fusion_gym.recordings import Recording


@pytest.fixture(scope="session")
def mast() -> Recording:
    """The packaged log of a mast, which is long."""
    return Recording.read("mast")
