"""Worker processes end with the process that they work for, and a pool keeps the order."""

import contextlib
import os
import signal
import subprocess
import sys

import pytest
from paths import ROOT

from agents.workers import Call, Pool, run_parallel
from fusion_gym.validation import ConfigurationError

# A parent that waits for its worker, which says its number and would work for a minute.
PARENT = """
import subprocess, sys
worker = "import os, sys, time; from agents.workers import end_with; "
worker += "end_with(os.getppid()); print(os.getpid(), flush=True); time.sleep(60)"
subprocess.run([sys.executable, "-c", worker])
"""


def end_of(process: subprocess.Popen[bytes]) -> None:
    """Read on until nobody holds the process's output any more, which its workers share.

    Raises:
        subprocess.TimeoutExpired: somebody still does after 20 seconds.
    """
    process.communicate(timeout=20.0)


def kill_all(process: subprocess.Popen[bytes]) -> None:
    """The process and its workers, which are a session of their own."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


def test_a_worker_ends_soon_after_its_parent_was_killed() -> None:
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT], cwd=ROOT, stdout=subprocess.PIPE, start_new_session=True
    )
    try:
        assert parent.stdout is not None
        assert int(parent.stdout.readline()) != parent.pid
        parent.kill()
        end_of(parent)
    finally:
        kill_all(parent)


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
