"""Worker processes end with the process that they work for, also where that was killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from small_suite import small_suite

ROOT = Path(__file__).parent.parent
# A parent that waits for its worker, which says its number and would work for a minute.
PARENT = """
import subprocess, sys
worker = "import os, sys, time; from agents.suite.workers import end_with; "
worker += "end_with(os.getppid()); print(os.getpid(), flush=True); time.sleep(60)"
subprocess.run([sys.executable, "-c", worker])
"""


def is_running(number: int) -> bool:
    try:
        state = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"  # nobody may be there to ask how it ended


def all_end(numbers: list[int], seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while any(is_running(number) for number in numbers):
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes in /proc")
def test_a_worker_ends_soon_after_its_parent_was_killed() -> None:
    parent = subprocess.Popen([sys.executable, "-c", PARENT], cwd=ROOT, stdout=subprocess.PIPE)
    assert parent.stdout is not None
    worker = int(parent.stdout.readline())
    assert is_running(worker)
    parent.kill()
    parent.wait()
    try:
        assert all_end([worker], 20.0)
    finally:
        if is_running(worker):
            os.kill(worker, signal.SIGKILL)


def children(number: int) -> list[int]:
    return [
        int(word) for word in Path(f"/proc/{number}/task/{number}/children").read_text().split()
    ]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes in /proc")
def test_workers_of_a_killed_benchmark_train_no_longer(tmp_path: Path) -> None:
    config = small_suite(tmp_path, timesteps=50_000_000, modes=["sensors"], training_seeds=2)
    work = tmp_path / "work"
    words = ["--config", str(config), "--results", str(tmp_path / "results"), "--work", str(work)]
    command = [sys.executable, "-m", "agents.benchmark", *words, "--workers", "2"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as run:
        workers: list[int] = []
        try:
            deadline = time.monotonic() + 300
            while not list(work.glob("small/*/config.yaml")) and time.monotonic() < deadline:
                time.sleep(0.1)
            workers = children(run.pid)
            assert len(workers) >= 2
            run.kill()
            run.wait()
            assert all_end(workers, 20.0)
        finally:
            run.kill()
            for worker in workers:
                if is_running(worker):
                    os.kill(worker, signal.SIGKILL)
