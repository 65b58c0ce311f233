"""Worker processes end with the process that they work for, also where that was killed."""

import contextlib
import os
import signal
import subprocess
import sys

from paths import ROOT

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
