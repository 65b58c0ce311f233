"""The benchmark on a cluster: dask's scheduler and workers, one of which is ended in the middle."""

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from small_suite import small_suite

from agents.workers import Pool
from fusion_gym.validation import ConfigurationError

ROOT = Path(__file__).resolve().parent.parent
PATIENCE = 240.0


@contextlib.contextmanager
def started(folder: Path, name: str, *words: str) -> Iterator[subprocess.Popen[bytes]]:
    """A process of the cluster, which is killed in the end."""
    with (folder / f"{name}.log").open("wb") as log:
        process = subprocess.Popen([sys.executable, "-m", *words], cwd=ROOT, stdout=log, stderr=log)
        try:
            yield process
        finally:
            process.kill()
            process.wait()


@contextlib.contextmanager
def cluster(folder: Path, workers: int) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler's address, and its workers."""
    received = folder / "scheduler.json"
    with contextlib.ExitStack() as stack:
        words = ["distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard"]
        stack.enter_context(started(folder, "scheduler", *words, "--scheduler-file", str(received)))
        deadline = time.monotonic() + PATIENCE
        while not received.exists():
            assert time.monotonic() < deadline
            time.sleep(0.1)
        words = ["distributed.cli.dask_worker", "--nthreads", "1", "--no-nanny", "--no-dashboard"]
        words += ["--scheduler-file", str(received), "--local-directory", str(folder)]
        begun = [
            stack.enter_context(started(folder, f"worker{number}", *words))
            for number in range(workers)
        ]
        yield json.loads(received.read_text())["address"], begun


def benchmark(suite: Path, folder: Path, *words: str) -> list[str]:
    places = ["--results", str(folder / "results"), "--work", str(folder / "work")]
    given = ["--parts", "agents", "--config", str(suite), *places, *words]
    return [sys.executable, "-m", "fusion_gym.commands", "benchmark", *given]


def find(folder: Path) -> dict[str, str]:
    """Return all tables but the one with the seconds that it took."""
    paths = (folder / "results").glob("*/*.csv")
    return {path.name: path.read_text() for path in paths if path.stem != "runs"}


@pytest.mark.slow
def test_a_worker_that_ends_in_the_middle_loses_nothing(tmp_path: Path) -> None:
    suite = small_suite(tmp_path, timesteps=8_000, classes=["sensors"])
    single, many = tmp_path / "alone", tmp_path / "many"
    subprocess.run(benchmark(suite, single, "--workers", "2"), cwd=ROOT, check=True)
    with cluster(tmp_path, 2) as (address, workers):
        run = subprocess.Popen(
            benchmark(suite, many, "--backend", "dask", "--address", address), cwd=ROOT
        )
        try:
            deadline = time.monotonic() + PATIENCE
            while len(list(many.glob("work/small/sensors_*/config.yaml"))) < 2:
                assert run.poll() is None
                assert time.monotonic() < deadline
                time.sleep(0.05)
            workers[0].kill()
            assert run.wait(PATIENCE) == 0
        finally:
            run.kill()
            run.wait()
        assert workers[1].poll() is None
    assert find(many) == find(single)
    assert {"policies.csv", "points.csv", "verdict.csv"} <= find(many).keys()


@pytest.mark.slow
def test_ray_gives_the_work_of_a_lost_worker_to_another(tmp_path: Path) -> None:
    pytest.importorskip("ray")

    def ends_its_first_worker(folder: Path) -> float:
        """Of each folder. It stands here, for ray's workers do not find this file."""
        try:
            folder.mkdir()
        except FileExistsError:
            return float(folder.name)
        os._exit(1)

    def is_wrong(_: object) -> float:
        raise ConfigurationError("filter = 'x' is not allowed")

    pool = Pool(2, "ray")
    with pool.connect():
        folders = [tmp_path / str(n) for n in range(3)]
        done = list(pool.map_unordered(ends_its_first_worker, folders))
        assert sorted(done) == [0.0, 1.0, 2.0]
        with pytest.raises(ConfigurationError, match=r"^filter = 'x' is not allowed$"):
            list(pool.map_unordered(is_wrong, [0]))


def test_a_team_that_is_not_there_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"address = 'tcp://x' .*backend='loky'"):
        Pool(2, "loky", "tcp://x")
    with (
        pytest.raises(ConfigurationError, match=r"address = 'nowhere' .*backend='dask'"),
        Pool(2, "dask", "nowhere").connect(),
    ):
        pass
