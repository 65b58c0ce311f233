"""The benchmark's pieces on a dask cluster."""

import pytest

from agents.workers import Call, Pool, run_parallel
from fusion_gym.validation import ConfigurationError


def test_a_pool_that_is_not_there_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"address = 'tcp://x' .*backend='loky'"):
        Pool(2, "loky", "tcp://x")
    with (
        pytest.raises(ConfigurationError, match=r"address = 'nowhere' .*backend='dask'"),
        Pool(2, "dask", "nowhere").connect(),
    ):
        pass


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["loky", "dask"])
def test_a_pool_returns_results_in_their_order(backend: str) -> None:
    calls = [Call(1.0, pow, (2, exponent)) for exponent in range(6)]
    assert run_parallel(calls, Pool(2, backend), "powers") == [1, 2, 4, 8, 16, 32]  # type: ignore[arg-type]
